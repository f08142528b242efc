"""The posterior of a success rate."""

from __future__ import annotations

from typing import Any

from warmprior.checks import check_between
from warmprior.io.extras import require


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
