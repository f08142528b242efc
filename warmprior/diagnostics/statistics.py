"""Statistics of success rates: posteriors, and how probably one is larger than another."""

from __future__ import annotations

from typing import Any

from warmprior.checks import check_between, check_whole_numbers
from warmprior.io.extras import require


def success_posterior(successes: int, episodes: int) -> Any:
    """Posterior of a success rate under a uniform prior, Beta(k + 1, n - k + 1) (appendix A).

    Args:
        successes: ``k``.
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


def probability_better(successes_a: int, episodes_a: int, successes_b: int, episodes_b: int) -> float:
    r"""Posterior probability that ``a`` succeeds more often than ``b``, both under a uniform prior.

    With :math:`p_a \sim \mathrm{Beta}(\alpha_a, \beta_a)` and likewise :math:`p_b`, as in
    :func:`success_posterior`,

    .. math::
        P(p_a > p_b) = \sum_{i=0}^{\alpha_a - 1} \frac{B(\alpha_b + i, \beta_a + \beta_b)}
            {(\beta_a + i)\, B(1 + i, \beta_a)\, B(\alpha_b, \beta_b)},

    the distribution function of a beta negative binomial. Pooled episodes of several training seeds are not
    quite independent; the probability is then too extreme. Errors are those of :func:`success_posterior`.

    Examples:
        >>> from warmprior.diagnostics import probability_better
        >>> round(probability_better(18, 20, 12, 20), 3), round(probability_better(0, 0, 0, 0), 3)
        (0.984, 0.5)
    """
    (alpha_a, beta_a), (alpha_b, beta_b) = (
        success_posterior(*counts).args for counts in ((successes_a, episodes_a), (successes_b, episodes_b))
    )
    better = require("scipy.stats", "sim").betanbinom(beta_a, beta_b, alpha_b)
    return min(1.0, float(better.cdf(alpha_a - 1)))


def paired_probability_better(wins: int, losses: int) -> float:
    r"""Posterior probability that ``a`` beats ``b`` in an episode that only one of them solves.

    Under a uniform prior the share of ``wins`` (episodes that ``a`` alone solves, :math:`w`) among these and
    ``losses`` (that ``b`` alone solves, :math:`l`) is :math:`\mathrm{Beta}(w + 1, l + 1)`, which exceeds one
    half with probability

    .. math::
        P = 2^{-(w + l + 1)} \sum_{i=0}^{w} \binom{w + l + 1}{i},

    the sign test's Bayesian counterpart. It is sharper than :func:`probability_better` where episodes of the
    same seeds differ in difficulty.

    Raises:
        ValueError: if a count is negative.
        ImportError: if scipy is missing.

    Examples:
        >>> from warmprior.diagnostics import paired_probability_better
        >>> round(paired_probability_better(3, 0), 4), round(paired_probability_better(4, 4), 4)  # 15 / 16
        (0.9375, 0.5)
    """
    check_whole_numbers(0, wins=wins, losses=losses)
    return float(success_posterior(wins, wins + losses).sf(0.5))
