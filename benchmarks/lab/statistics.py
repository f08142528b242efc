"""Statistics of a report: checkpoint averages, and intervals of ratios."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

import numpy as np
import torch
from scipy.stats import bootstrap
from torch import Tensor

RESAMPLES = 2_000
"""Of a bootstrap."""


def top_k_mean(rates: Sequence[float], k: int) -> float:
    """Mean of the ``k`` largest rates (all of them, if there are fewer).

    The paper averages checkpoints like this. Choosing and reporting on the same episodes flatters every
    method alike.

    Examples:
        >>> from lab.statistics import top_k_mean
        >>> top_k_mean([0.1, 0.9, 0.5, 0.7], 3)
        0.7...
    """
    if not rates or k < 1:
        raise ValueError(f"need at least one rate and k >= 1, got {len(rates)} rates and k={k}")
    return fmean(sorted(rates, reverse=True)[:k])


def bootstrap_ratio(
    numerator: Tensor,
    denominator: Tensor,
    groups: Tensor,
    *,
    generator: torch.Generator | None = None,
) -> tuple[float, float, float]:
    """Ratio of two means over the same observations, with a percentile bootstrap interval of 95%.

    It draws whole groups with replacement: neighbouring steps of an episode are alike, and intervals from
    single steps would be far too narrow. Observations where either value is NaN do not count.

    Args:
        numerator: ``[n]``.
        denominator: ``[n]``, of the same observations.
        groups: the group of each, int64 ``[n]``; its episode, usually.
        generator: source of randomness on the CPU; PyTorch's global one by default.

    Returns:
        The ratio, the lower and the upper end of its interval; NaN if nothing counts, and a NaN interval for
        a single group.

    Raises:
        ValueError: if the shapes differ.

    Examples:
        >>> import torch
        >>> from lab.statistics import bootstrap_ratio
        >>> episode = torch.arange(100) // 10
        >>> x = 1.0 + episode.double()
        >>> bootstrap_ratio(2 * x, x, episode)
        (2.0, 2.0, 2.0)
    """
    if numerator.ndim != 1 or not numerator.shape == denominator.shape == groups.shape:
        shapes = [tuple(x.shape) for x in (numerator, denominator, groups)]
        raise ValueError(f"need three tensors [n], got {shapes}")
    both = torch.stack([numerator, denominator], -1).double().cpu()
    counted = ~both.isnan().any(-1)
    if not counted.any():
        return math.nan, math.nan, math.nan
    _, index = groups.cpu()[counted].unique(return_inverse=True)
    sums = torch.zeros(int(index.max()) + 1, 2, dtype=torch.float64)
    sums.index_add_(0, index, both[counted])
    total = sums.sum(0)
    ratio = float(total[0] / total[1])
    if len(sums) == 1:
        return ratio, math.nan, math.nan
    result = bootstrap(
        tuple(sums.T.numpy()),
        lambda above, below, axis: above.sum(axis) / below.sum(axis),
        n_resamples=RESAMPLES,
        confidence_level=0.95,
        paired=True,
        method="percentile",
        rng=np.random.default_rng(int(torch.randint(2**62, (), generator=generator))),
    )
    return ratio, float(result.confidence_interval.low), float(result.confidence_interval.high)
