"""The path from the source to the action chunk."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.registry import Registered


class Interpolant(Registered):
    r"""The path :math:`a_t = \alpha(t) a_0 + \beta(t) a_1` and its velocity.

    Subclasses define :meth:`coefficients` and, for files, a ``name``. The coefficients must satisfy
    :math:`\alpha(0)=\beta(1)=1` and :math:`\alpha(1)=\beta(0)=0`, so that the flow starts at the source and
    ends at the data.

    Examples:
        >>> import math
        >>> import torch
        >>> from warmprior import Interpolant
        >>> class SineInterpolant(Interpolant):
        ...     name = "sine"
        ...     def coefficients(self, t):
        ...         beta = torch.sin(math.pi / 2 * t) ** 2
        ...         speed = math.pi / 2 * torch.sin(math.pi * t)
        ...         return 1 - beta, beta, -speed, speed
        >>> a_t, velocity = SineInterpolant()(torch.zeros(1, 2, 1), torch.ones(1, 2, 1), torch.tensor([0.5]))
        >>> round(float(a_t[0, 0]), 3), round(float(velocity[0, 0]), 3)
        (0.5, 1.571)
    """

    def coefficients(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        r"""Return :math:`\alpha, \beta, \dot\alpha, \dot\beta` at times ``t`` in [0, 1], each like ``t``."""
        raise NotImplementedError

    def __call__(
        self, a0: Tensor, a1: Tensor, t: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        r"""Return the point on the path and its velocity :math:`\dot\alpha a_0 + \dot\beta a_1`.

        Source, data and both results are ``[*B, P, d_a]``, the times ``[*B]``. Only a path with noise uses
        the generator.
        """
        alpha, beta, d_alpha, d_beta = self.coefficients(t[..., None, None])
        return alpha * a0 + beta * a1, d_alpha * a0 + d_beta * a1


class LinearInterpolant(Interpolant):
    r"""The paper's straight line: :math:`\alpha = 1 - t`, :math:`\beta = t` (Lipman et al., 2023).

    Examples:
        >>> from warmprior import LinearInterpolant
        >>> import torch
        >>> a0, a1 = torch.zeros(1, 2, 1), torch.ones(1, 2, 1)
        >>> a_t, velocity = LinearInterpolant()(a0, a1, torch.tensor([0.25]))
        >>> a_t.flatten().tolist(), velocity.flatten().tolist()
        ([0.25, 0.25], [1.0, 1.0])
    """

    name = "linear"

    def coefficients(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the coefficients of the straight line."""
        one = torch.ones_like(t)
        return 1 - t, t, -one, one
