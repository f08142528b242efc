"""The integrator against closed forms, and the actor around it."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from warmprior import ODEActor, integrate

STAGES = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}
ORDERS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}


class Counting(nn.Module):
    """A velocity that depends on time, point and observation, and counts its calls."""

    def __init__(self):
        super().__init__()
        self.calls, self.times = 0, []

    def forward(self, t, a, observation):
        assert t.shape == a.shape[:1] == observation.shape[:1]
        self.calls += 1
        self.times.append(float(t[0]))
        return torch.cos(t)[:, None, None] * a + observation.sum((1, 2))[:, None, None]


def batch(*shape):
    return TensorDict(
        {"prior": {"noise": torch.randn(*shape, 4, 2)}, "observation": torch.randn(*shape, 2, 3)}, shape
    )


@pytest.mark.parametrize("solver", ORDERS)
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
    assert slope == pytest.approx(ORDERS[solver], abs=0.15)


@pytest.mark.parametrize("solver", ORDERS)
def test_nfe_is_the_number_of_network_calls(solver):
    network = Counting()
    for steps in (1, 2, 3):
        network.calls, network.times = 0, []
        ODEActor(network, nfe=steps * STAGES[solver], solver=solver)(batch(5))
        assert network.calls == steps * STAGES[solver]
        assert min(network.times) == 0.0 and max(network.times) <= 1.0


def path_of(data, **options):
    network, observation = Counting(), data["observation"]
    return integrate(
        lambda t, a: network(t, a, observation), data["prior", "noise"], return_path=True, **options
    )


@pytest.mark.parametrize("solver", ORDERS)
def test_path(solver):
    data, steps = batch(3), 3
    path = path_of(data, nfe=steps * STAGES[solver], solver=solver)
    assert path.shape == (3, steps + 1, 4, 2)
    assert torch.equal(path[:, 0], data["prior", "noise"])
    out = ODEActor(Counting(), nfe=steps * STAGES[solver], solver=solver)(data)
    assert torch.equal(path[:, -1], out["vla_action", "chunk"])


def test_clip_applies_to_the_chunk_and_not_to_the_path():
    data = batch(50)
    last = path_of(data, nfe=2)[:, -1]
    out = ODEActor(Counting(), nfe=2, clip=0.5)(data)
    assert last.abs().max() > 0.5
    assert torch.equal(out["vla_action", "chunk"], last.clamp(-0.5, 0.5))


def test_every_dimension_may_have_a_bound_of_its_own():
    data = batch(50)
    free = ODEActor(Counting(), nfe=2)(data.clone())["vla_action", "chunk"]
    bound = torch.tensor([0.5, 0.0])
    chunk = ODEActor(Counting(), nfe=2, clip=(0.5, 0.0))(data.clone())["vla_action", "chunk"]
    assert torch.equal(chunk, free.clamp(-bound, bound)) and chunk.abs().max() == 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "dopri5"}, "unknown solver 'dopri5'.*euler.*rk4"),
        ({"nfe": 0}, "nfe must be a whole number of at least 1"),
        ({"nfe": 3, "solver": "heun"}, "multiple of 2 for the heun solver, got 3"),
        ({"clip": 0.0}, "clip"),
        ({"clip": (1.0, -1.0)}, "clip"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        ODEActor(Counting(), **options)


@pytest.mark.parametrize("missing", [("prior", "noise"), "observation"])
def test_missing_key(missing):
    data = batch(3)
    del data[missing]
    with pytest.raises(KeyError, match="missing"):
        ODEActor(Counting())(data)
