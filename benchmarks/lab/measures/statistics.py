"""Statistics of a report: intervals and comparisons that count trainings, and intervals of ratios."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import bootstrap, permutation_test
from scipy.stats import t as student_t
from torch import Tensor

RESAMPLES = 2_000
"""Number of draws of a bootstrap."""

ENOUGH_TRAININGS = 6
"""The smallest number of trainings with which :func:`sign_flip_test` can be below 0.05."""


def weights_elsewhere(solved: np.ndarray, count: int = 1) -> np.ndarray:
    """Return the weights that average the best `count` settings, chosen on other episodes.

    Outcomes and weights are ``[settings, episodes]``. The even episodes choose the settings of the odd ones
    and vice versa; among equals the first settings are chosen. So the choice does not bias the success rate.

    Examples:
        >>> import numpy as np
        >>> from lab.measures.statistics import weights_elsewhere
        >>> # The first setting solves even episodes alone: they choose it for the odd ones.
        >>> weights_elsewhere(np.array([[1, 0, 1, 0], [0, 1, 0, 1]])).tolist()
        [[0.0, 1.0, 0.0, 1.0], [1.0, 0.0, 1.0, 0.0]]
    """
    weights = np.zeros(solved.shape)
    for part, other in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        # A single episode chooses for itself: there is no other.
        judge = solved[:, other] if solved[:, other].size else solved
        best = np.argsort(-judge.mean(1), kind="stable")[:count]
        weights[best, part] = 1 / len(best)
    return weights


def chosen_elsewhere(solved: np.ndarray) -> np.ndarray:
    """Return the outcomes of the best setting, see :func:`weights_elsewhere`.

    Examples:
        >>> import numpy as np
        >>> from lab.measures.statistics import chosen_elsewhere
        >>> chosen_elsewhere(np.array([[1, 0, 1, 0], [0, 1, 0, 1]])).tolist()
        [0.0, 0.0, 0.0, 0.0]
    """
    return (weights_elsewhere(solved) * solved).sum(0)


@dataclass(frozen=True)
class Spread:
    """The spread of success rates, in units of the variance of independent episodes.

    A training succeeds more or less often than another, so episodes of one training are alike. The design
    effect of trainings (Kish, 1965) is the variance of their rates over that of independent episodes.
    If all trainings play the same starts, episodes of one start are alike too, and have an effect as well.

    Attributes:
        trainings: the design effect of trainings; 1 if unknown.
        starts: the design effect of shared starts, at least 1; 1 if each training has its own.
        freedom: degrees of freedom of the estimate: trainings minus cells, of cells whose values vary; 0
            without any second training.
    """

    trainings: float
    starts: float
    freedom: int


def spread_of(cells: Sequence[np.ndarray], shared_starts: bool = False) -> Spread:
    """Return the spread of the episodes of several cells together, each ``[trainings, episodes]``.

    A value is the outcome of an episode (1 if solved), or the difference of the outcomes of two methods that
    played the same. Cells with few trainings tell more together than each alone.

    Examples:
        >>> import numpy as np
        >>> from lab.measures.statistics import spread_of
        >>> outcomes = np.array([[1] * 40 + [0] * 10, [1] * 10 + [0] * 40])  # two trainings: 80 and 20%
        >>> spread = spread_of([outcomes])
        >>> round(spread.trainings), spread.freedom  # 50 (0.3^2 + 0.3^2) / 0.25
        (36, 1)
    """
    by_training = by_start = 0.0
    varied = [cell for cell in cells if cell.var() > 0]  # the others say nothing of the spread
    freedom = sum(len(cell) - 1 for cell in varied)
    starts = sum(cell.shape[1] - 1 for cell in varied) if shared_starts else 0
    for cell in varied:
        n, m = cell.shape
        by_training += m * ((cell.mean(1) - cell.mean()) ** 2).sum() / cell.var()
        by_start += n * ((cell.mean(0) - cell.mean()) ** 2).sum() / cell.var()
    return Spread(
        float(by_training / freedom) if freedom else 1.0,
        float(max(1.0, by_start / starts)) if starts else 1.0,
        freedom,
    )


def interval(cells: Sequence[np.ndarray], spread: Spread, confidence: float = 0.95) -> tuple[float, float]:
    """Return an interval of the mean over cells, each ``[trainings, episodes]``, with this spread.

    It is Student's interval for what other trainings and starts would give. Without a second training
    (``spread.freedom = 0``) it is for other episodes of the same trainings alone, and so too narrow.

    Examples:
        >>> import numpy as np
        >>> from lab.measures.statistics import interval, spread_of
        >>> outcomes = np.array([[1] * 20 + [0] * 30, [1] * 25 + [0] * 25, [1] * 30 + [0] * 20])
        >>> low, high = interval([outcomes], spread_of([outcomes]))
        >>> f"{low:.3f} {high:.3f}"  # rates of 0.4, 0.5 and 0.6: 0.5 -+ 4.303 * 0.1 / sqrt(3)
        '0.252 0.748'
    """
    effect = spread.trainings + spread.starts - 1
    # One episode more of each kind, as in Wilson's interval: rates of 0 and 1 are not certain.
    variances = [effect * max(cell.var(), 1 / (cell.size + 2)) / cell.size for cell in cells]
    error = math.sqrt(sum(variances)) / len(cells)
    # Student's distribution with infinite freedom is the normal one.
    quantile = student_t.ppf((1 + confidence) / 2, spread.freedom or math.inf)
    mean = float(np.mean([cell.mean() for cell in cells]))
    return float(mean - quantile * error), float(mean + quantile * error)


def sign_flip_test(*cells: Sequence[float]) -> float:
    """Return the two-sided p-value of a mean difference between two methods, over trainings.

    Each cell has the differences of its trainings, and all cells have the same weight. If the methods are
    equal, a training's difference is as likely to have the other sign. The test compares the mean with those
    of all signs, exactly up to 13 trainings and with 10,000 draws beyond. Three trainings can never be below
    0.25, six reach 0.03, and twelve 0.0005.

    Examples:
        >>> from lab.measures.statistics import sign_flip_test
        >>> sign_flip_test([0.1, 0.2, 0.3]), sign_flip_test([0.1, 0.2, 0.3], [0.1, 0.2, 0.1])
        (0.25, 0.03125)
    """
    # Their sum is the mean over cells of the means over trainings.
    values = np.array([difference / len(cell) for cell in cells for difference in cell], dtype=float)
    if len(values) < 2 or not values.any():
        return 1.0
    result = permutation_test(
        (values,), np.mean, permutation_type="samples", n_resamples=10_000, rng=np.random.default_rng(0)
    )
    return float(result.pvalue)


def bootstrap_ratio(
    numerator: Tensor,
    denominator: Tensor,
    groups: Tensor,
    *,
    generator: torch.Generator | None = None,
) -> tuple[float, float, float]:
    """Return the ratio of two means over the same observations, with a 95% percentile bootstrap interval.

    It draws whole groups with replacement, because neighbouring steps of an episode are similar and intervals
    from single steps would be far too narrow. Observations where either value is NaN are left out.

    Args:
        numerator: ``[n]``.
        denominator: ``[n]``, of the same observations.
        groups: the group of each observation, usually its episode, int64 ``[n]``.
        generator: source of randomness on the CPU; PyTorch's global one by default.

    Returns:
        The ratio, and the lower and upper end of its interval. All are NaN without observations; the interval
        is NaN for a single group.

    Raises:
        ValueError: if the shapes differ.

    Examples:
        >>> import torch
        >>> from lab.measures.statistics import bootstrap_ratio
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
