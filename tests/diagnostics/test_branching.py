"""Branching cost against closed forms, and its bound on random mixtures."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.diagnostics.fields import H, batch, policy, remember
from warmprior import PastPrior, PreviewPrior
from warmprior.diagnostics import branching_bound, branching_cost


def windows(mean, target):
    """Warm windows with the given means and targets, each ``[n, P, d_a]``."""
    data = batch(len(target), target.shape[1], target.shape[2])
    remember(data, mean)
    data["vla_action", "chunk"] = target
    return data


@pytest.mark.parametrize(("s", "sigma"), [(0.5, 1.0), (0.5, 0.5), (1.0, 0.1)])
def test_gaussian_residual_has_the_closed_form(s, sigma):
    """A1 = mu + R, R ~ N(0, s^2 I): the optimal field is linear and B = (pi / 2) s sigma d."""
    torch.manual_seed(0)
    mu, d_a = torch.randn(1, H, 2), 2
    target = mu + s * torch.randn(20_000, H, d_a)

    def optimal(t, a, o):
        variance = (1 - t) ** 2 * sigma**2 + t**2 * s**2
        return (t * s**2 - (1 - t) * sigma**2) / variance * (a - mu)

    actor = policy(optimal, PastPrior(H, sigma=sigma))
    data = windows(mu.expand_as(target), target)
    cost, bound = branching_cost(actor, data), branching_bound(data, actor.prior)
    d = H * d_a
    assert float(cost["cost"].mean()) == pytest.approx(math.pi / 2 * s * sigma * d, rel=0.02)
    assert torch.equal(cost["cost"], cost["cost_warm"])
    assert float(cost["still"].mean()) == pytest.approx((s**2 + sigma**2) * d, rel=0.02)
    assert float(bound["warm"].mean()) == pytest.approx((s**2 + sigma**2) * d, rel=0.02)
    torch.testing.assert_close(bound["warm"], bound["total"])


@settings(max_examples=25, deadline=None)
@given(
    modes=st.integers(1, 5),
    sigma=st.floats(0.05, 2.0),
    jitter=st.floats(0.05, 0.5),
    spread=st.floats(0.0, 2.0),
    seed=st.integers(0, 10**6),
)
def test_bound_holds_on_random_mixtures(modes, sigma, jitter, spread, seed):
    """The optimal field of a mixture of (mean, target) pairs, by Bayes' rule over its components."""
    generator = torch.Generator().manual_seed(seed)
    mu = spread * torch.randn(modes, 2, 1, generator=generator)
    goal = torch.randn(modes, 2, 1, generator=generator)

    def optimal(t, a, o):
        t = t.unsqueeze(1)
        variance = (1 - t) ** 2 * sigma**2 + t**2 * jitter**2
        rest = a.unsqueeze(1) - ((1 - t) * mu + t * goal)  # [n, K, P, d_a]
        score = -rest.square().sum((-1, -2), keepdim=True) / (2 * variance)
        gain = (t * jitter**2 - (1 - t) * sigma**2) / variance
        return (score.softmax(1) * (goal - mu + gain * rest)).sum(1)

    k = torch.randint(modes, (2000,), generator=generator)
    target = goal[k] + jitter * torch.randn(2000, 2, 1, generator=generator)
    actor = policy(optimal, PastPrior(2, sigma=sigma), seed=seed)
    data = windows(mu[k], target)
    cost = branching_cost(actor, data, draws=4)["cost_warm"]
    bound = branching_bound(data, actor.prior)["warm"]
    slack = (cost - bound).mean() / ((cost - bound).std() / math.sqrt(len(cost)))
    assert slack < 4  # standard errors
    # No field can do better than the optimal one; the one that stands still meets the bound.
    still = branching_cost(actor, data, draws=4)["still"].mean()
    assert float(still) == pytest.approx(float(bound.mean()), rel=0.2, abs=0.02)


def test_bound_counts_cold_and_padded_positions():
    prior = PreviewPrior(H, sigma=0.5)
    data = batch(2, 2 * H, 1)
    remember(data, torch.ones(2, 2 * H, 1))
    data["vla_action", "chunk"] = torch.full((2, 2 * H, 1), 3.0)
    bound = branching_bound(data, prior)
    assert bound["mismatch"].tolist() == [H * 4.0] * 2
    assert bound["noise"].tolist() == [H * 0.25] * 2
    assert bound["total"].tolist() == [H * 4.25 + H * 10.0] * 2
    assert bound["total_executed"].tolist() == [H * 4.25] * 2
    for dtype in (torch.bool, torch.uint8):
        data["action_is_pad"] = (torch.arange(2 * H).expand(2, -1) >= 1).to(dtype)
        assert branching_bound(data, prior)["total"].tolist() == [4.25] * 2
