"""Training times against their densities, written down and integrated here."""

import math
from types import SimpleNamespace

import pytest
import torch

from tests.errors import refuses
from tests.objectives.test_flow_matching import actor_for, loss_of, sample
from warmprior import FlowMatchingLoss, PastPrior
from warmprior.objectives.times import TIMES

N = 200_000
CPU = torch.device("cpu")


def draw(name, *shape, seed=0, dtype=torch.float64):
    return TIMES[name](torch.Size(shape), torch.Generator().manual_seed(seed), dtype, CPU)


def density(name, t):
    if name == "uniform":
        return torch.ones_like(t)
    return torch.exp(4 * t) + torch.exp(4 * (1 - t))


RANDOM = [name for name in TIMES if name != "start"]


@pytest.mark.parametrize("name", RANDOM)
def test_distribution_and_moments(name):
    width = 1e-5
    centres = torch.arange(width / 2, 1, width, dtype=torch.float64)
    mass = density(name, centres)
    mass = mass / mass.sum()
    t = draw(name, N).sort()[0]
    # Kolmogorov-Smirnov: the largest distance of the two distribution functions, at 0.1% of chance.
    exact = mass.cumsum(0)[(t / width).long().clamp_max(len(mass) - 1)]
    empirical = torch.arange(1, N + 1, dtype=torch.float64) / N
    assert (exact - empirical).abs().max() < 1.95 / math.sqrt(N)
    for power in (1, 2, 4):
        assert (t**power).mean() == pytest.approx(float((mass * centres**power).sum()), abs=3e-3)


def test_the_loss_is_given_them():
    prior = PastPrior(3)
    actor, data = actor_for(prior), sample(prior, 6)
    losses = {name: loss_of(actor, data, times=name) for name in RANDOM}
    assert torch.equal(losses["uniform"], loss_of(actor, data))
    assert len({loss.item() for loss in losses.values()}) == 2


def test_a_coupling_with_times_takes_no_others():
    actor, coupling = actor_for(PastPrior(4)), SimpleNamespace(times=TIMES["start"])
    refuses(lambda: FlowMatchingLoss(actor, coupling=coupling, times="u-shaped"), ValueError, "u-shaped")
    assert FlowMatchingLoss(actor, coupling=coupling).times is TIMES["start"]
