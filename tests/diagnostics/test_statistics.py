from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from warmprior.diagnostics import (
    paired_probability_better,
    probability_better,
    success_posterior,
)


def test_posterior_density_is_the_binomial_likelihood_normalised():
    k, n, p = 3, 10, 0.4
    likelihood = math.comb(n, k) * p**k * (1 - p) ** (n - k)
    assert success_posterior(k, n).pdf(p) == pytest.approx((n + 1) * likelihood)


@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 60), st.integers(0, 60))
def test_probability_better_is_the_integral_over_both_posteriors(k_a, n_a, k_b, n_b):
    np, stats = pytest.importorskip("numpy"), pytest.importorskip("scipy.stats")
    k_a, k_b = min(k_a, n_a), min(k_b, n_b)
    a, b = stats.beta(k_a + 1, n_a - k_a + 1), stats.beta(k_b + 1, n_b - k_b + 1)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    p = (nodes + 1) / 2
    expected = float((weights / 2 * a.pdf(p) * b.cdf(p)).sum())
    assert probability_better(k_a, n_a, k_b, n_b) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("wins", "losses"), [(0, 0), (7, 2), (0, 5), (40, 41), (900, 100)])
def test_paired_probability_is_that_of_a_beta(wins, losses):
    stats = pytest.importorskip("scipy.stats")
    found = paired_probability_better(wins, losses)
    assert found == pytest.approx(stats.beta(wins + 1, losses + 1).sf(0.5), abs=1e-12)
    assert found + paired_probability_better(losses, wins) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="at least 0"):
        paired_probability_better(-1, losses)
