import math

import pytest

from warmprior.diagnostics import success_posterior


def test_posterior_density_is_the_binomial_likelihood_normalised():
    k, n, p = 3, 10, 0.4
    likelihood = math.comb(n, k) * p**k * (1 - p) ** (n - k)
    assert success_posterior(k, n).pdf(p) == pytest.approx((n + 1) * likelihood)
