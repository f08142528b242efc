"""The integrator against closed forms, and the actor around it."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.errors import raises
from warmprior import ODEActor, integrate

STAGES = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}
"""Evaluations per step, which are the order of convergence as well."""


class Watched(nn.Module):
    """A velocity that depends on time, point and observation, and notes when it is asked."""

    def __init__(self):
        super().__init__()
        self.times = []

    def forward(self, t, a, observation):
        assert t.shape == a.shape[:1] == observation.shape[:1]
        self.times.append(float(t[0]))
        return torch.cos(t)[:, None, None] * a + observation.sum((1, 2))[:, None, None]


def batch(*shape):
    return TensorDict(
        {"prior": {"noise": torch.randn(*shape, 4, 2)}, "observation": torch.randn(*shape, 2, 3)}, shape
    )


@pytest.mark.parametrize("solver", STAGES)
def test_order_of_convergence(solver):
    """On da/dt = (cos t) a the solution is a0 exp(sin t)."""
    a0 = torch.tensor([[1.0], [-2.0]], dtype=torch.float64)
    exact = a0 * math.exp(math.sin(1.0))
    steps = [8, 16, 32, 64]
    errors = []
    for n in steps:
        result = integrate(lambda t, a: torch.cos(t)[:, None] * a, a0, nfe=n * STAGES[solver], solver=solver)
        errors.append((result - exact).abs().max().item())
    slope = (math.log(errors[-1]) - math.log(errors[0])) / (math.log(8) - math.log(64))
    assert slope == pytest.approx(STAGES[solver], abs=0.15)


def path_of(data, **options):
    network, observation = Watched(), data["observation"]
    return integrate(
        lambda t, a: network(t, a, observation), data["prior", "noise"], return_path=True, **options
    )


@pytest.mark.parametrize("solver", STAGES)
def test_path(solver):
    data, steps = batch(3), 3
    path = path_of(data, nfe=steps * STAGES[solver], solver=solver)
    assert path.shape == (3, steps + 1, 4, 2)
    assert torch.equal(path[:, 0], data["prior", "noise"])
    out = ODEActor(Watched(), nfe=steps * STAGES[solver], solver=solver)(data)
    assert torch.equal(path[:, -1], out["vla_action", "chunk"])


@pytest.mark.parametrize("clip", [0.5, (0.5, 0.0)])
def test_clip_applies_to_the_chunk_and_not_to_the_path(clip):
    data, bound = batch(50), torch.tensor(clip).expand(2)
    last = path_of(data, nfe=2)[:, -1]
    chunk = ODEActor(Watched(), nfe=2, clip=clip)(data)["vla_action", "chunk"]
    assert last.abs().max() > 0.5
    assert torch.equal(chunk, last.clamp(-bound, bound))


def test_bad_options():
    for options, *facts in (
        *(({"solver": "dopri5"}, "'dopri5'", "euler", "rk4"), ({"nfe": 0}, "nfe", 0)),
        ({"nfe": 3, "solver": "heun"}, "heun", 3),
        ({"start_time": 1.0}, "start_time", 1.0),
        *(({"clip": clip}, "clip") for clip in (0.0, (1.0, -1.0), ())),
    ):
        with raises(ValueError, *facts):
            ODEActor(Watched(), **options)


def test_missing_key():
    for missing in (("prior", "noise"), "observation"):
        with raises(KeyError, "missing"):
            ODEActor(Watched())(batch(3).exclude(missing))
