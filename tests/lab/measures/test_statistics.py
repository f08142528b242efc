import math
from itertools import product

import numpy as np
import pytest
import torch

pytest.importorskip("scipy")

from scipy import stats
from scipy.special import expit, logit

from lab.measures.statistics import (
    ENOUGH_TRAININGS,
    bootstrap_ratio,
    chosen_elsewhere,
    interval,
    sign_flip_test,
    spread_of,
    weights_elsewhere,
)


def test_bootstrap_agrees_with_the_delta_method():
    """Independent groups of one: the interval is the ratio plus and minus 1.96 standard errors."""
    generator = torch.Generator().manual_seed(0)
    x = 2.0 + 0.3 * torch.randn(4_000, generator=generator).double()
    y = 3.0 + 0.5 * torch.randn(4_000, generator=generator).double() + 0.2 * x
    ratio, low, high = bootstrap_ratio(x, y, torch.arange(4_000), generator=generator)
    expected = float(x.mean() / y.mean())
    error = float((x - expected * y).std() / y.mean()) / math.sqrt(4_000)
    assert ratio == pytest.approx(expected)
    assert high - low == pytest.approx(2 * 1.96 * error, rel=0.1)
    assert (high + low) / 2 == pytest.approx(expected, abs=0.3 * error)


def test_bootstrap_draws_whole_groups():
    """Repeating every observation inside its group tells nothing new; fresh groups would."""
    generator = torch.Generator().manual_seed(1)
    x, y = torch.rand(2, 30, generator=generator).double() + 0.5
    groups = torch.arange(30)

    def width(*args):
        _, low, high = bootstrap_ratio(*args, generator=torch.Generator().manual_seed(2))
        return high - low

    once = width(x, y, groups)
    repeated = width(x.repeat(9), y.repeat(9), groups.repeat(9))
    assert repeated == pytest.approx(once)
    assert width(x.repeat(9), y.repeat(9), torch.arange(270)) < 0.5 * once


def outcomes(rng, trainings=3, episodes=50, rate=0.4, shared=False, gap=0.0):
    """Return outcomes of two methods that play the same starts, each ``[trainings, episodes]``.

    Trainings and starts differ as in the published rows: rates of trainings by 3.5 points, and outcomes of an
    episode correlate by .20 over trainings.
    """
    starts = rng.normal(0, 1, (1 if shared else trainings, episodes))

    def played(rate):
        own = rng.normal(0, 0.16, (trainings, 1))
        chance = expit(logit(rate) * 1.2 + own + starts)
        return (rng.random((trainings, episodes)) < chance).astype(float)

    return played(rate), played(rate + gap)


def expected(rate):
    """Return the mean rate over trainings and starts, by quadrature over their normal sum."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    return float((weights * expit(logit(rate) * 1.2 + math.hypot(1, 0.16) * nodes)).sum() / weights.sum())


def test_an_interval_is_students_over_trainings():
    """With one cell it is scipy's, and with several cells their spread is pooled."""
    rng = np.random.default_rng(0)
    cells = [outcomes(rng, 5, 20, rate)[0] for rate in (0.2, 0.5)]
    rates = [cell.mean(1) for cell in cells]
    alone = stats.ttest_1samp(rates[0], 0).confidence_interval(0.95)
    assert interval(cells[:1], spread_of(cells[:1])) == pytest.approx((alone.low, alone.high))
    # Pooled: each cell's squared deviations in units of its own variance, over 8 degrees of freedom.
    units = [20 * 5 * r.var() / cell.var() for r, cell in zip(rates, cells, strict=True)]
    error = math.sqrt(sum(cell.var() * sum(units) / 8 / 100 for cell in cells)) / 2
    half, centre = stats.t(8).ppf(0.975) * error, np.mean(rates)
    assert interval(cells, spread_of(cells)) == pytest.approx((centre - half, centre + half))


def test_one_training_tells_of_its_episodes_alone_and_certainty_never():
    rng = np.random.default_rng(1)
    (cell, _), z = outcomes(rng, 1, 200), stats.norm.ppf(0.975)
    half = z * math.sqrt(cell.mean() * (1 - cell.mean()) / 200)
    assert spread_of([cell]).freedom == 0
    assert interval([cell], spread_of([cell])) == pytest.approx((cell.mean() - half, cell.mean() + half))
    for perfect in np.ones((1, 50)), np.ones((3, 50)):
        low, high = interval([perfect], spread_of([perfect]))
        assert 0.9 < low < 1 < high
    # Cells without variance say nothing of the spread, neither of its freedom.
    varied, _ = outcomes(rng, 3, 50)
    assert spread_of([varied, perfect, perfect]) == spread_of([varied])


def test_a_p_value_is_the_share_of_signs_that_are_as_far_from_zero():
    differences = np.array([0.1, -0.04, 0.2, 0.06, 0.12, 0.02, 0.0])
    signs = np.array(list(product((1, -1), repeat=7)))
    means = (signs * differences).mean(1)
    one_sided = (means >= differences.mean() - 1e-12).mean()
    assert sign_flip_test(differences) == pytest.approx(2 * one_sided)
    assert sign_flip_test(-differences) == pytest.approx(2 * one_sided)
    # Cells have the same weight, however many trainings they have.
    by_hand = np.array([0.3, -0.1, 0.2, 0.1, 0.15, 0.25]) / np.array([1, 5, 5, 5, 5, 5])
    flipped = (np.array(list(product((1, -1), repeat=6))) * by_hand).sum(1)
    one_sided = (flipped >= by_hand.sum() - 1e-12).mean()
    assert sign_flip_test([0.3], [-0.1, 0.2, 0.1, 0.15, 0.25]) == pytest.approx(2 * one_sided)
    smallest = {3: 0.25, ENOUGH_TRAININGS: 2**-5, 12: 2**-11}
    for count, p in smallest.items():
        assert sign_flip_test([0.1] * count) == pytest.approx(p)
    assert sign_flip_test([0.0] * 6) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("cells", "trainings"), [(4, 3), (1, 12), (7, 2)])
def test_intervals_cover_what_other_trainings_would_give(shared, cells, trainings):
    """Within two points of 95 in 100, for rates and for differences; the simulation's own error is 0.7."""
    rng, rates = np.random.default_rng(0), np.linspace(0.2, 0.6, cells)
    truth = np.mean([expected(rate) for rate in rates])
    covered = []
    for _ in range(1_000):
        pairs = [outcomes(rng, trainings, 50, rate, shared) for rate in rates]
        first, differences = [one for one, _ in pairs], [two - one for one, two in pairs]
        for sample, value in (first, truth), (differences, 0.0):
            low, high = interval(sample, spread_of(sample, shared))
            covered.append(low <= value <= high)
    for kind in covered[::2], covered[1::2]:
        assert 0.93 <= np.mean(kind) <= 0.97


@pytest.mark.slow
@pytest.mark.parametrize("cells", [4, 1])
def test_twelve_trainings_of_fifty_find_ten_points_and_raise_few_false_alarms(cells):
    rng = np.random.default_rng(0)

    def found(gap, repeats):
        rejected = []
        for _ in range(repeats):
            pairs = [outcomes(rng, 12 // cells, 50, rate, gap=gap) for rate in np.linspace(0.25, 0.55, cells)]
            rejected.append(sign_flip_test(np.concatenate([(b - a).mean(1) for a, b in pairs])) < 0.05)
        return np.mean(rejected)

    # The share of solved episodes grows by ten points where the rate at an average start grows by 0.1.
    gap = np.mean([expected(rate + 0.1) - expected(rate) for rate in np.linspace(0.25, 0.55, cells)])
    assert gap == pytest.approx(0.1, abs=0.01)
    assert found(0.0, 500) <= 0.06
    assert found(0.1, 200) >= 0.80


def test_what_is_chosen_elsewhere_gains_nothing_by_chance():
    """The best of equally good settings looks better on all episodes; the chosen ones do not."""
    rng = np.random.default_rng(0)
    solved = (rng.random((2_000, 3, 50)) < 0.5).astype(int)
    chosen = np.array([chosen_elsewhere(each).mean() for each in solved])
    assert solved.mean(2).max(1).mean() > 0.54
    assert abs(chosen.mean() - 0.5) < 0.006  # four standard errors
    # The paper averages the best 3 of 10 checkpoints.
    solved = (rng.random((2_000, 10, 50)) < 0.5).astype(int)
    chosen = [(weights_elsewhere(each, 3) * each).sum(0).mean() for each in solved]
    assert np.sort(solved.mean(2), 1)[:, -3:].mean() > 0.54
    assert abs(np.mean(chosen) - 0.5) < 0.006
    # A setting that is better is found.
    better = (rng.random((2_000, 3, 50)) < np.array([0.2, 0.8, 0.2])[:, None]).astype(int)
    assert abs(np.mean([chosen_elsewhere(each).mean() for each in better]) - 0.8) < 0.006
