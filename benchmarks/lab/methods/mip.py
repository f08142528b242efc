"""MIP: two supervised steps, from the point 0 or a source, and from near the action, as parts of a flow."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from warmprior import LinearInterpolant

SECOND = 0.9
"""Flow time of the second step."""


class MIPInterpolant(LinearInterpolant):
    """The straight line, except at ``t = 0``, where the point is 0 instead of a source sample.

    Examples:
        >>> import torch
        >>> from lab.methods.mip import MIPInterpolant
        >>> a0, a1, t = torch.ones(2, 1, 1), torch.full((2, 1, 1), 3.0), torch.tensor([0.0, 0.5])
        >>> [end.flatten().tolist() for end in MIPInterpolant()(a0, a1, t)]
        [[0.0, 2.0], [3.0, 2.0]]
    """

    name = "mip"

    def __call__(
        self, a0: Tensor, a1: Tensor, t: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        return super().__call__(torch.where(t[..., None, None] > 0, a0, 0.0), a1, t)


class TwoStepCoupling:
    r"""Pairs in order, at two times: :math:`t = 0`, at a source sample, and :math:`t = 0.9`.

    With :math:`f = a_t + (1 - t) v` the network predicts the action from both points. The policy is Euler's
    method from 0 to 0.9 to 1. If the network is preconditioned, both errors are divided by the standard
    deviation that preconditioning leaves.
    """

    name = "two-steps"

    def config(self) -> dict[str, Any]:
        """Return its name; it has no options."""
        return {"name": self.name}

    def times(
        self, shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """Draw the two times with equal probability."""
        second = torch.rand(shape, generator=generator, dtype=dtype, device=device) < 0.5
        return torch.where(second, SECOND, 0.0).to(dtype)

    def __call__(self, a0: Tensor, a1: Tensor, observation: Any = None) -> tuple[Tensor, Tensor]:
        return a0, a1


class MIPCoupling(TwoStepCoupling):
    r"""Minimal Iterative Policy (Pan et al., 2025, arXiv:2512.01809): two steps, the first from the point 0.

    The second is from :math:`0.9 a + 0.1 \varepsilon`.
    """

    name = "mip"
    interpolant: ClassVar[MIPInterpolant] = MIPInterpolant()
