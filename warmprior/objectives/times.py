"""Distributions of the times of a flow-matching loss, which `flow_matching.py` weights."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from warmprior.checks import given

Times = Callable[[torch.Size, torch.Generator | None, torch.dtype, torch.device], Tensor]
"""A function that draws times in [0, 1]: ``(shape, generator, dtype, device) -> [*shape]``."""

STEEPNESS = 4.0
"""The constant ``a`` of :func:`u_shaped_times`: the ends are 3.8 times as dense as the middle."""


def uniform_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Draw uniformly distributed times, as in Algorithm 1."""
    return torch.rand(shape, dtype=dtype, device=device, **given(generator=generator))


def u_shaped_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    r"""Draw times near both ends more often.

    The density is :math:`p(t) \propto e^{at} + e^{a(1-t)}` with :math:`a = 4` (Lee et al., 2024, "Improving
    the training of rectified flows"). Their text has :math:`e^{-at}` as the second term, which is no U on [0,
    1]; this is what their code draws from, by the inverse of

    .. math::
        F(t) = \frac12 + \frac{\sinh(a(t - \frac12))}{2 \sinh\frac a2}.
    """
    u = uniform_times(shape, generator, dtype, device)
    t = 0.5 + torch.asinh((2 * u - 1) * math.sinh(STEEPNESS / 2)) / STEEPNESS
    return t.clamp(0.0, 1.0)  # rounding may leave the interval


def start_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    r"""Return ``t = 0`` for all: the network regresses :math:`a_1 - a_0`, which one Euler step adds.

    The field is not trained at any other time: build the policy with ``max_nfe=1``.
    """
    return torch.zeros(shape, dtype=dtype, device=device)


TIMES: dict[str, Times] = {
    "uniform": uniform_times,
    "u-shaped": u_shaped_times,
    "start": start_times,
}
"""The distributions of times, by name."""
