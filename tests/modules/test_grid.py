from itertools import pairwise

import pytest
import torch

from tests.errors import raises
from tests.modules.test_ode import STAGES, Watched, batch
from warmprior import ODEActor, integrate

JUMPS = ["dense-jump", "dense-jump:0.8"]


def test_dense_jump_by_hand():
    """Three steps of 0.2, then one of 0.4: the published schedule, t = linspace(0, 0.6, 4) and 1."""
    a0, weight = torch.randn(3, 4, 2), torch.randn(2, 2)

    def velocity(t, a):
        return torch.tanh(a @ weight) * (1 + t)[:, None, None]

    a = a0.clone()
    for t, length in ((0.0, 0.2), (0.2, 0.2), (0.4, 0.2), (0.6, 0.4)):
        a = a + length * velocity(torch.full((3,), t), a)
    torch.testing.assert_close(integrate(velocity, a0, nfe=4, grid="dense-jump:0.6"), a)


@pytest.mark.parametrize("solver", STAGES)
@pytest.mark.parametrize("start_time", [0.0, 0.3])
@pytest.mark.parametrize("grid", ["uniform", "dense-jump"])
def test_times_of_every_solver(solver, start_time, grid):
    nodes = {"euler": (0.0,), "midpoint": (0, 0.5), "heun": (0, 1), "rk4": (0, 0.5, 0.5, 1)}[solver]
    network = Watched()
    options = {"solver": solver, "grid": grid, "start_time": start_time}
    ODEActor(network, nfe=4 * STAGES[solver], **options)(batch(5))
    shares = [k / 4 if grid == "uniform" else k / 6 for k in range(4)]
    points = [start_time + share * (1 - start_time) for share in (*shares, 1.0)]
    expected = [b + node * (e - b) for b, e in pairwise(points) for node in nodes]
    assert network.times == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("grid", ["uniform", *JUMPS])
@pytest.mark.parametrize("start_time", [0.0, 0.25])
def test_linear_fields_are_solved_on_every_grid(grid, start_time):
    a0, a1 = torch.randn(2, 6, 3, 2, dtype=torch.float64)

    def to_a_point(t, a):  # straight lines: Euler's method makes no error
        return (a1 - a) / (1 - t)[:, None, None]

    for nfe in (1, 2, 5):
        found = integrate(to_a_point, a0, nfe=nfe, grid=grid, start_time=start_time)
        torch.testing.assert_close(found, a1)

    def speeding_up(t, a):  # of second order in time
        return (2 * t)[:, None, None] * a1

    for solver in ("midpoint", "heun", "rk4"):
        found = integrate(speeding_up, a0, nfe=8, solver=solver, grid=grid, start_time=start_time)
        torch.testing.assert_close(found, a0 + (1 - start_time**2) * a1)


@pytest.mark.parametrize("grid", ["dense", "dense-jump:0", "dense-jump:half"])
def test_bad_grids(grid):
    with raises(ValueError, f"'{grid}'"):
        ODEActor(Watched(), grid=grid)
    with raises(ValueError, f"'{grid}'"):
        integrate(lambda t, a: a, torch.ones(1, 1), nfe=1, grid=grid)
