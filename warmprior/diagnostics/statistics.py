"""Statistics of success rates: posteriors, checkpoint averages, seed intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from warmprior._extras import require

__all__ = ["SeedSummary", "exceeds_one_sigma", "success_posterior", "summarize_seeds", "top_k_mean"]


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
        >>> round(float(success_posterior(9, 10).mean()), 3)  # (9 + 1) / (10 + 2)
        0.833
    """
    if not 0 <= successes <= episodes:
        raise ValueError(f"need 0 <= successes <= episodes, got {successes} and {episodes}")
    require("scipy", "sim")
    from scipy.stats import beta

    return beta(successes + 1, episodes - successes + 1)


def top_k_mean(rates: Sequence[float], k: int) -> float:
    """Mean of the ``k`` largest rates (all of them, if there are fewer).

    This is how the paper averages checkpoints. Choosing and reporting on the same episodes flatters
    every method alike.

    Examples:
        >>> top_k_mean([0.1, 0.9, 0.5, 0.7], 3)
        0.7
    """
    if not rates or k < 1:
        raise ValueError(f"need at least one rate and k >= 1, got {len(rates)} rates and k={k}")
    best = sorted(rates, reverse=True)[:k]
    return math.fsum(best) / len(best)


@dataclass(frozen=True)
class SeedSummary:
    """Mean and spread of one result over training seeds.

    Attributes:
        mean: mean over seeds.
        std: sample standard deviation (divisor ``seeds - 1``); NaN for a single seed.
        seeds: number of seeds.
    """

    mean: float
    std: float
    seeds: int


def summarize_seeds(values: Sequence[float]) -> SeedSummary:
    """Mean and sample standard deviation over seeds.

    Raises:
        ValueError: if there is no value.

    Examples:
        >>> summarize_seeds([0.5, 0.7])
        SeedSummary(mean=0.6, std=0.1414..., seeds=2)
    """
    if not values:
        raise ValueError("need at least one seed")
    n = len(values)
    mean = math.fsum(values) / n
    if n == 1:
        return SeedSummary(mean, math.nan, 1)
    variance = math.fsum((value - mean) ** 2 for value in values) / (n - 1)
    return SeedSummary(mean, math.sqrt(variance), n)


def exceeds_one_sigma(method: SeedSummary, base: SeedSummary) -> bool:
    """The paper's rule for a marked gain: non-overlapping one-sigma seed intervals (Table 1).

    Always false with a single seed: it has no spread to compare with.

    Examples:
        >>> exceeds_one_sigma(SeedSummary(0.9, 0.02, 3), SeedSummary(0.8, 0.03, 3))
        True
    """
    return method.mean - base.mean > method.std + base.std
