"""The posterior of a success rate, and ratios."""

from __future__ import annotations

import math
from typing import Any

from warmprior.checks import check_between
from warmprior.io.extras import require


def ratio(value: float, reference: float) -> float:
    """Return a quotient of numbers >= 0: infinite if only the reference is 0, and NaN if both are."""
    if reference:
        return value / reference
    return math.inf if value > 1e-6 else math.nan  # beyond rounding


def success_posterior(successes: float, episodes: float) -> Any:
    """Return the posterior of a success rate under a uniform prior, Beta(k + 1, n - k + 1) (appendix A).

    Args:
        successes: ``k``, or its mean over several checkpoints that played the same episodes.
        episodes: ``n``.

    Returns:
        A frozen ``scipy.stats.beta``: ``.mean()``, ``.pdf(p)``, ``.interval(0.95)``.

    Raises:
        ValueError: if not ``0 <= successes <= episodes``.
        ImportError: if scipy is missing.

    Examples:
        >>> from warmprior.diagnostics import success_posterior
        >>> round(float(success_posterior(9, 10).mean()), 3)  # (9 + 1) / (10 + 2)
        0.833
    """
    check_between(0, episodes, successes=successes)
    return require("scipy.stats", "sim").beta(successes + 1, episodes - successes + 1)
