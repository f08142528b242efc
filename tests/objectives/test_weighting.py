"""Standardised errors: their unit against regression by least squares."""

import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.paths import TrigonometricInterpolant
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    LinearInterpolant,
    PastPrior,
    PreconditionedNetwork,
    SourceMoments,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.history import window_history
from warmprior.modules.network import VelocityNetwork

H, D_A, N = 2, 1, 40_000


class Still(VelocityNetwork):
    """Has learnt nothing."""

    def forward(self, t, a, observation):
        return torch.zeros_like(a)


def batch(n=N, seed=0):
    """Jointly Gaussian past and target, with another correlation and spread at each position."""
    past, noise = torch.randn(2, n, H, D_A, generator=torch.Generator().manual_seed(seed))
    past = past * torch.tensor([[0.5], [1.5]]) + 0.3
    a1 = torch.tensor([[0.9], [0.2]]) * past + torch.tensor([[0.1], [0.7]]) * noise
    history = window_history(past, torch.full((n, 1), H), a1, H)
    data = {"observation": torch.zeros(n, 1, 1), "vla_action": {"chunk": a1}, "history": history}
    return TensorDict({**data, "action_is_pad": torch.zeros(n, H, dtype=torch.bool)}, [n])


def policy(prior, interpolant=None, network=Still):
    windows = batch()
    moments = SourceMoments.fit(windows, prior, generator=torch.Generator().manual_seed(1))
    inside = network(D_A, 1, H, 1)
    return WarmPriorActor(PreconditionedNetwork(inside, moments=moments, interpolant=interpolant), prior)


@pytest.mark.parametrize("path", [LinearInterpolant(), TrigonometricInterpolant()])
@pytest.mark.parametrize("prior", [GaussianPrior(H), PastPrior(H, sigma=0.4)])
@pytest.mark.parametrize("time", [0.0, 0.3, 0.9, 1.0])
def test_the_unit_is_what_least_squares_leave(prior, path, time):
    network = policy(prior, path).network
    windows, g = batch(seed=5), torch.Generator().manual_seed(6)
    a0 = prior.distribution(windows["history"]).sample(g).double()
    a1 = windows["vla_action", "chunk"].double()
    a_t, velocity = path(a0, a1, torch.full((N,), time).double())
    unit = network.remainder(torch.tensor([time]))[0]
    for p in range(H):
        design = torch.stack([torch.ones(N).double(), a_t[:, p, 0]], 1)
        fit = torch.linalg.lstsq(design, velocity[:, p, :]).solution
        left = (velocity[:, p, :] - design @ fit).std()
        assert float(unit[p, 0]) == pytest.approx(float(left), rel=0.03)


def test_errors_are_divided_coordinate_by_coordinate():
    prior = PastPrior(H, sigma=0.4)
    actor = policy(prior, network=lambda *sizes: VelocityMLP(*sizes, hidden_dim=8))
    windows = batch(6)
    windows["action_is_pad"][0, 1] = True
    times = torch.rand(6)

    def errors(**options):
        options |= {"times": lambda shape, *_: times, "generator": torch.Generator().manual_seed(0)}
        return FlowMatchingLoss(actor, reduction="none", **options)(windows)

    unit = actor.network.remainder(times)
    plain, weighed = errors(weighting="velocity"), errors()  # the default of such a network
    key = "loss_flow_matching"
    torch.testing.assert_close(weighed[key], plain[key] / unit.square())
    assert not weighed[key][0, 1].any()
    plain, weighed = (errors(objective="l1", weighting=w) for w in ("velocity", "standardised"))
    torch.testing.assert_close(weighed[key], plain[key] / unit)


def test_networks_without_a_unit_are_refused():
    actor = WarmPriorActor(VelocityMLP(D_A, 1, H, 1, hidden_dim=8), GaussianPrior(H))
    refuses(lambda: FlowMatchingLoss(actor, weighting="standardised"), ValueError, "PreconditionedNetwork")
    with raises(ValueError, "weighting", "velocity, standardised"):
        FlowMatchingLoss(actor, weighting="loud")
