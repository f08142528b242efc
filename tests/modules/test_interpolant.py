import pytest
import torch

from tests.paths import PolynomialInterpolant, TrigonometricInterpolant
from warmprior import LinearInterpolant

ALL = [LinearInterpolant(), TrigonometricInterpolant(), *map(PolynomialInterpolant, (1.0, 2.0, 3.5))]
BY_NAME = pytest.mark.parametrize("interpolant", ALL, ids=lambda i: str(i.config()))


@BY_NAME
def test_starts_at_the_source_and_ends_at_the_data(interpolant):
    a0, a1 = torch.randn(2, 3, 4, 2).double().unbind(0)
    torch.testing.assert_close(interpolant(a0, a1, torch.zeros(3).double())[0], a0)
    torch.testing.assert_close(interpolant(a0, a1, torch.ones(3).double())[0], a1)


@BY_NAME
def test_velocity_is_the_derivative_of_the_path(interpolant):
    a0, a1 = torch.randn(2, 1, 4, 2).double().unbind(0)
    for time in (0.1, 0.37, 0.5, 0.99):
        t = torch.tensor([time]).double()
        derivative = torch.autograd.functional.jacobian(lambda t: interpolant(a0, a1, t)[0], t).squeeze(-1)
        torch.testing.assert_close(interpolant(a0, a1, t)[1], derivative)


def test_linear_is_algorithm_one():
    a0, a1, t = torch.randn(6, 4, 2), torch.randn(6, 4, 2), torch.rand(6)
    a_t, velocity = LinearInterpolant()(a0, a1, t)
    for i in range(6):
        torch.testing.assert_close(a_t[i], (1 - t[i]) * a0[i] + t[i] * a1[i])
        torch.testing.assert_close(velocity[i], a1[i] - a0[i])
