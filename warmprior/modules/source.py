"""Source distributions: where the flow of an action chunk starts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from warmprior.checks import given


@dataclass(frozen=True)
class Source:
    r"""A source :math:`a_0 = \mu + s \varepsilon`, returned by :meth:`Prior.distribution`.

    Attributes:
        loc: :math:`\mu`, ``[*B, P, d_a]``, normalised action space.
        scale: :math:`s`, broadcastable to ``loc``; a number becomes a tensor.
        warm: True at positions whose mean comes from the history, bool ``[*B, P, 1]``.
        correlation: share of the noise's variance that is common to all warm positions of a dimension.

    Examples:
        >>> import torch
        >>> from warmprior import Source
        >>> warm = torch.ones(1, 2, 1, dtype=torch.bool)
        >>> Source(torch.ones(1, 2, 1), torch.zeros(()), warm).sample().flatten().tolist()
        [1.0, 1.0]
    """

    loc: Tensor
    scale: Tensor
    warm: Tensor
    correlation: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.scale, Tensor):
            object.__setattr__(self, "scale", self.loc.new_tensor(self.scale))

    def sample(self, generator: torch.Generator | None = None, temperature: float = 1.0) -> Tensor:
        """Draw ``a_0 = loc + temperature * scale * eps``, ``[*B, P, d_a]``.

        PyTorch's global generator is the default.
        """
        loc = self.loc
        like = {"dtype": loc.dtype, "device": loc.device, **given(generator=generator)}
        eps = torch.randn(loc.shape, **like)
        if self.correlation:
            common = torch.randn((*loc.shape[:-2], 1, loc.shape[-1]), **like)
            own, shared = math.sqrt(1.0 - self.correlation), math.sqrt(self.correlation)
            eps = torch.where(self.warm, own * eps + shared * common, eps)
        scale = self.scale if temperature == 1.0 else temperature * self.scale
        return loc + scale * eps
