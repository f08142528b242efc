"""Start points: where samplers start at a later time than the source's."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor, nn

from warmprior.modules.registry import Registered

__all__ = ["StartPoint"]


class StartPoint(Registered, nn.Module):
    r"""Base class of points :math:`a_s` at a time :math:`s` in (0, 1), from which a policy integrates.

    The flow is trained from the prior's source as usual; at decisions integration starts on the way. A start
    point is trained before the flow, and saved with the policy.

    Attributes:
        time: ``s``.
        noise_share: standard deviation of the point for source noise of 1.

    See Also:
        :class:`~warmprior.WarmPriorActor`: takes one as ``start``.

    Examples:
        >>> from warmprior import StartPoint
        >>> class Halved(StartPoint):
        ...     time = noise_share = 0.5
        ...     def centre(self, history, observation):
        ...         return 0.0 * history["forecast"]
        ...     def forward(self, noise, history, observation):
        ...         return self.centre(history, observation) + self.noise_share * noise
        >>> Halved().config()
        {'name': 'Halved'}
    """

    time: float
    noise_share: float

    def centre(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Mean of the point, around which an agent searches, ``[*B, P, d_a]``; arguments as for a prior."""
        raise NotImplementedError

    def forward(self, noise: Tensor, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """The point, ``[*B, P, d_a]``, of a draw of the prior's source, ``[*B, P, d_a]``."""
        raise NotImplementedError
