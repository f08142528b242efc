import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("scipy")

from scipy import stats

from lab.statistics import bootstrap_ratio, chosen_elsewhere, paired_probability_better, probability_better
from tests.errors import raises


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


@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 60), st.integers(0, 60))
def test_probability_better_is_the_integral_over_both_posteriors(k_a, n_a, k_b, n_b):
    k_a, k_b = min(k_a, n_a), min(k_b, n_b)
    a, b = stats.beta(k_a + 1, n_a - k_a + 1), stats.beta(k_b + 1, n_b - k_b + 1)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    p = (nodes + 1) / 2
    expected = float((weights / 2 * a.pdf(p) * b.cdf(p)).sum())
    assert probability_better(k_a, n_a, k_b, n_b) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("wins", "losses"), [(0, 0), (7, 2), (0, 5), (40, 41), (900, 100)])
def test_paired_probability_is_that_of_a_beta(wins, losses):
    found = paired_probability_better(wins, losses)
    assert found == pytest.approx(stats.beta(wins + 1, losses + 1).sf(0.5), abs=1e-12)
    assert found + paired_probability_better(losses, wins) == pytest.approx(1.0)
    with raises(ValueError, "between 0"):
        paired_probability_better(-1, losses)


def test_what_is_chosen_elsewhere_gains_nothing_by_chance():
    """The best of equally good settings looks better on all episodes; the chosen one does not."""
    rng = np.random.default_rng(0)
    solved = (rng.random((2_000, 3, 50)) < 0.5).astype(int)
    chosen = np.array([chosen_elsewhere(each).mean() for each in solved])
    assert solved.mean(2).max(1).mean() > 0.54
    assert abs(chosen.mean() - 0.5) < 0.006  # four standard errors
    # A setting that is better is found.
    better = (rng.random((2_000, 3, 50)) < np.array([0.2, 0.8, 0.2])[:, None]).astype(int)
    assert abs(np.mean([chosen_elsewhere(each).mean() for each in better]) - 0.8) < 0.006
