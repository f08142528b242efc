import math

import pytest
import torch

from lab.methods.bridge import BridgeCoupling, BridgeInterpolant
from tests.errors import raises, refuses
from tests.objectives.test_flow_matching import actor_for
from warmprior import FlowMatchingLoss, GaussianPrior, OTCoupling

pytest.importorskip("scipy")

H = 2


def gaussian_bridge(s0, s1, sigma):
    """Covariance of the ends of the Schroedinger bridge of N(0, s0^2) and N(m, s1^2) (Bunne et al., 2023)."""
    return (math.sqrt(4 * s0**2 * s1**2 + sigma**4) - sigma**2) / 2


def test_a_bridge_of_little_noise_is_the_optimal_assignment():
    generator = torch.Generator().manual_seed(0)
    a0, a1 = (torch.randn(128, 8, 7, generator=generator) for _ in range(2))
    torch.manual_seed(0)
    pairs = [couple(a0, a1, None)[0] for couple in (BridgeCoupling(0.03, 0.0), OTCoupling(0.0))]
    assert (pairs[0] == pairs[1]).all(-1).all(-1).float().mean() > 0.95


@pytest.mark.parametrize("sigma", [0.3, 1.0])
def test_bridge_of_gaussians(sigma):
    """Pairs, path and velocity against the closed form of the bridge."""
    s0, s1, mean = 1.0, 0.5, 2.0
    torch.manual_seed(0)
    a0 = s0 * torch.randn(256 * 50, 1, 1)
    a1 = mean + s1 * torch.randn(256 * 50, 1, 1)
    couple = BridgeCoupling(sigma, observation_weight=0.0)
    source, target = couple(a0, a1)
    assert target is a1
    expected = gaussian_bridge(s0, s1, sigma)
    found = torch.cov(torch.stack([source.flatten(), target.flatten()]))
    # The plan of 256 pairs is close to that of the distributions.
    assert found[0, 1].item() == pytest.approx(expected, abs=0.02)
    assert found[0, 0].item() == pytest.approx(s0**2, abs=0.04)

    # Var(a_t), and the slope of the velocity on a_t, are those of the bridge's own flow.
    def variance(t):
        return (1 - t) ** 2 * s0**2 + t**2 * s1**2 + 2 * t * (1 - t) * expected + sigma**2 * t * (1 - t)

    for t in (0.2, 0.5, 0.9):
        point, velocity = couple.interpolant(source, target, torch.full((len(source),), t))
        both = torch.cov(torch.stack([point.flatten(), velocity.flatten()]))
        slope = (variance(t + 1e-4) - variance(t - 1e-4)) / 2e-4 / 2 / variance(t)
        assert both[0, 0].item() == pytest.approx(variance(t), rel=0.04)
        assert (both[0, 1] / both[0, 0]).item() == pytest.approx(slope, abs=0.05)


def test_the_loss_takes_the_path_of_the_coupling():
    actor = actor_for(GaussianPrior(H))
    loss = FlowMatchingLoss(actor, coupling=BridgeCoupling(0.2, observation_weight=0.0))
    assert loss.interpolant.config() == BridgeInterpolant(0.2).config()
    with raises(ValueError, "straight path"):
        FlowMatchingLoss(actor, coupling=BridgeCoupling(0.2), objective="l1")
    refuses(lambda: BridgeCoupling(0.0), ValueError, "sigma", "got 0.0")
