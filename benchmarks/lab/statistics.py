"""Statistics of a report: comparisons of success rates, and intervals of ratios."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.stats import bootstrap
from torch import Tensor

from warmprior.diagnostics import success_posterior

RESAMPLES = 2_000
"""Number of draws of a bootstrap."""


GRID = np.linspace(0.0, 1.0, 20_001)
"""Success rates over which :func:`probability_better` integrates."""


def probability_better(successes_a: float, episodes_a: int, successes_b: float, episodes_b: int) -> float:
    r"""Return the probability that ``a`` succeeds more often than ``b``, both under a uniform prior.

    With :math:`p_a \sim \mathrm{Beta}(\alpha_a, \beta_a)` and the same for :math:`p_b`, as in
    :func:`~warmprior.diagnostics.success_posterior`, it is :math:`\int f_a(x) F_b(x) \, dx`. Successes may be
    means over several checkpoints that played the same episodes. Pooled episodes of several training seeds
    are not quite independent; the probability is then too extreme.

    Examples:
        >>> from lab.statistics import probability_better
        >>> round(probability_better(18, 20, 12, 20), 3), round(probability_better(0, 0, 0, 0), 3)
        (0.984, 0.5)
    """
    a, b = success_posterior(successes_a, episodes_a), success_posterior(successes_b, episodes_b)
    return float(np.clip(np.trapezoid(b.cdf(GRID) * a.pdf(GRID), GRID), 0.0, 1.0))


def weights_elsewhere(solved: np.ndarray, count: int = 1) -> np.ndarray:
    """Return the weights that average the best `count` settings, chosen on other episodes.

    Outcomes and weights are ``[settings, episodes]``. The even episodes choose the settings of the odd ones
    and vice versa; among equals the first settings are chosen. So the choice does not bias the success rate.

    Examples:
        >>> import numpy as np
        >>> from lab.statistics import weights_elsewhere
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
        >>> from lab.statistics import chosen_elsewhere
        >>> chosen_elsewhere(np.array([[1, 0, 1, 0], [0, 1, 0, 1]])).tolist()
        [0.0, 0.0, 0.0, 0.0]
    """
    return (weights_elsewhere(solved) * solved).sum(0)


def resampled_means(tasks: Sequence[tuple[Sequence[int], int]], rng: np.random.Generator) -> np.ndarray:
    """Return bootstrap draws of a mean success rate over tasks, ``[RESAMPLES]``.

    A draw takes training seeds with replacement, task by task, and then episodes of each. Every task has the
    same weight. With several seeds the draws spread somewhat too far, because the rates of seeds already
    contain the chance of their episodes; with one seed they spread too little, because differences between
    seeds are left out.
    rliable (Agarwal et al. 2021) resamples seeds in the same way, but not episodes.

    Args:
        tasks: per task the number of episodes that each training seed solved, and that each played.
        rng: source of randomness.

    Examples:
        >>> import numpy as np
        >>> from lab.statistics import resampled_means
        >>> means = resampled_means([([25, 25, 25], 50), ([50, 50, 50], 50)], np.random.default_rng(0))
        >>> round(float(means.mean()), 2), round(float(means.std()), 2)  # sqrt(0.5 * 0.5 / 150) / 2
        (0.75, 0.02)
    """
    rates = []
    for solved, episodes in tasks:
        seeds = rng.choice(solved, (RESAMPLES, len(solved)))
        rates.append(rng.binomial(episodes, seeds / episodes).mean(1) / episodes)
    return np.mean(rates, axis=0)


def paired_probability_better(wins: float, losses: float) -> float:
    r"""Return the posterior probability that ``a`` beats ``b`` in an episode that only one of them solves.

    Under a uniform prior the share of ``wins`` (episodes that ``a`` alone solves, :math:`w`) among these and
    ``losses`` (that ``b`` alone solves, :math:`l`) is :math:`\mathrm{Beta}(w + 1, l + 1)`, which exceeds one
    half with probability

    .. math::
        P = 2^{-(w + l + 1)} \sum_{i=0}^{w} \binom{w + l + 1}{i},

    the sign test's Bayesian counterpart. It is sharper than :func:`probability_better` where episodes of the
    same seeds differ in difficulty.

    If several checkpoints played the same episodes, an episode counts once, with the mean of its outcomes.

    Examples:
        >>> from lab.statistics import paired_probability_better
        >>> round(paired_probability_better(3, 0), 4), round(paired_probability_better(4, 4), 4)  # 15 / 16
        (0.9375, 0.5)
    """
    return float(success_posterior(wins, wins + losses).sf(0.5))


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
