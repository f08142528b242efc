from itertools import pairwise

import pytest
import torch

from tests.errors import refuses
from tests.modules.test_ode import STAGES, Watched, batch
from warmprior import ODEActor, integrate

JUMPS = ["dense-jump", "dense-jump:0.8"]


@pytest.mark.parametrize("solver", STAGES)
@pytest.mark.parametrize("start_time", [0.0, 0.3])
@pytest.mark.parametrize(("grid", "jump"), [("uniform", 0.75), ("dense-jump", 0.5), ("dense-jump:0.6", 0.6)])
def test_times_of_every_solver(solver, start_time, grid, jump):
    """Four steps, the last of them from the jump on, as published: t = linspace(0, 0.6, 4) and 1."""
    nodes = {"euler": (0.0,), "midpoint": (0, 0.5), "heun": (0, 1), "rk4": (0, 0.5, 0.5, 1)}[solver]
    network = Watched()
    options = {"solver": solver, "grid": grid, "start_time": start_time}
    ODEActor(network, nfe=4 * STAGES[solver], **options)(batch(5))
    points = [start_time + jump * k / 3 * (1 - start_time) for k in range(4)] + [1.0]
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
    refuses(lambda: ODEActor(Watched(), grid=grid), ValueError, f"'{grid}'")
    refuses(lambda: integrate(lambda t, a: a, torch.ones(1, 1), nfe=1, grid=grid), ValueError, f"'{grid}'")
