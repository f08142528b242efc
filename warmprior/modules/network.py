"""The interface and configuration of velocity networks, and their time embedding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from warmprior.modules.checks import check_whole_numbers
from warmprior.modules.registry import Registered

__all__ = ["TimestepEmbedding", "VelocityNetwork", "network_observation", "velocity_field"]


class VelocityNetwork(nn.Module, Registered):
    """Base class of velocity networks ``v(t, a_t, o)`` that can be saved by name and configuration.

    :class:`~warmprior.ODEActor` and :class:`~warmprior.FlowMatchingLoss` take any callable of the same
    signature. This base class adds shape checks and ``config()``, the name of the class and its constructor's
    arguments.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Raises:
        ValueError: if a width or length is not positive.

    See Also:
        - :class:`~warmprior.VelocityMLP`: the small one.
        - :class:`~warmprior.ChiTransformer`: the paper's.
        - :class:`~warmprior.PreconditionedNetwork`: wraps any of them.

    Examples:
        >>> import torch
        >>> from torch import nn
        >>> from warmprior import VelocityNetwork
        >>> class LinearNetwork(VelocityNetwork):
        ...     def __init__(self, action_dim, observation_dim, prediction_length, observation_steps):
        ...         super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        ...         inputs = 1 + prediction_length * action_dim + observation_steps * observation_dim
        ...         self.layer = nn.Linear(inputs, prediction_length * action_dim)
        ...     def forward(self, t, a, observation):
        ...         self.check_shapes(a, observation)
        ...         inputs = torch.cat([t[:, None], a.flatten(1), observation.flatten(1)], -1)
        ...         return self.layer(inputs).view_as(a)
        >>> network = LinearNetwork(2, 5, prediction_length=4, observation_steps=1)
        >>> network(torch.zeros(3), torch.zeros(3, 4, 2), torch.zeros(3, 1, 5)).shape
        torch.Size([3, 4, 2])
        >>> network.config()["name"]  # what a saved policy is loaded by
        'LinearNetwork'
    """

    encodes: bool = False
    """Whether :meth:`encode` does anything."""

    def __init__(
        self, action_dim: int, observation_dim: int, prediction_length: int, observation_steps: int
    ) -> None:
        super().__init__()
        check_whole_numbers(
            action_dim=action_dim,
            observation_dim=observation_dim,
            prediction_length=prediction_length,
            observation_steps=observation_steps,
        )
        self.action_dim = action_dim
        self.observation_dim = observation_dim
        self.prediction_length = prediction_length
        self.observation_steps = observation_steps

    def check_chunk(self, a: Tensor) -> None:
        """A ``ValueError`` if the network was built for other chunks than ``a`` ``[B, P, d_a]``."""
        expected = (self.prediction_length, self.action_dim)
        if tuple(a.shape[1:]) != expected:
            raise ValueError(
                f"{type(self).__name__} was built for chunks [B, P, d_a] with (P, d_a) = {expected}, "
                f"got {tuple(a.shape)}"
            )

    def check_shapes(self, a: Tensor, observation: Tensor | TensorDictBase) -> None:
        """A ``ValueError`` if the network was built for other inputs.

        Those are chunks ``a`` ``[B, P, d_a]`` and observations ``[B, To, d_o]``.
        """
        self.check_chunk(a)
        expected = (self.observation_steps, self.observation_dim)
        built = f"{type(self).__name__} was built for observations [B, To, d_o] with (To, d_o) = {expected}"
        if isinstance(observation, TensorDictBase):
            entries = sorted(map(str, observation.keys(True, True)))
            raise ValueError(f"{built}, got the entries {entries}: write a network that encodes them")
        if tuple(observation.shape[1:]) != expected:
            raise ValueError(f"{built}, got {tuple(observation.shape)}")

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """Encode an observation once, before the field is evaluated at it many times.

        The network takes the result in place of the observation, ``[B, To, d_o]`` or a tensordict ``[B]``. By
        default this does nothing.
        """
        return observation

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        """Optimiser groups: decay on matrix weights, none on biases, norms and embeddings."""
        decay: list[nn.Parameter] = []
        no_decay: list[nn.Parameter] = []
        for name, parameter in self.named_parameters():
            is_matrix = parameter.ndim >= 2 and not name.endswith("position")
            (decay if is_matrix else no_decay).append(parameter)
        return [{"params": decay, "weight_decay": weight_decay}, {"params": no_decay, "weight_decay": 0.0}]


def velocity_field(
    network: nn.Module, observation: Tensor | TensorDictBase
) -> Callable[[Tensor, Tensor], Tensor]:
    """A network's velocity ``(t [B], a [B, P, d_a]) -> v`` at observations, in the dtype of ``a``.

    The observations, ``[B, To, *]`` or a tensordict of such entries, are encoded once. The network computes
    in its own dtype (that of its first parameter): float64 environments and bfloat16 networks need no casts
    elsewhere, and the path is integrated, and its error measured, in the dtype of the actions.
    """
    dtype = _precision(network)
    seen = _encoded(network, observation, dtype)
    if dtype is None:
        return lambda t, a: network(t, a, seen)
    return lambda t, a: network(t.to(dtype), a.to(dtype), seen).to(a.dtype)


def encoded(network: nn.Module, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
    """The observations as the network encodes them (:meth:`VelocityNetwork.encode`), in its own dtype."""
    return _encoded(network, observation, _precision(network))


def _encoded(network: nn.Module, observation: Any, dtype: torch.dtype | None) -> Any:
    def cast(value: Tensor) -> Tensor:
        return value.to(dtype) if value.is_floating_point() else value

    if dtype is not None:
        if isinstance(observation, TensorDictBase):
            observation = observation.apply(cast)
        else:
            observation = cast(observation)
    encode = getattr(network, "encode", None)
    return observation if encode is None else encode(observation)


def _precision(network: nn.Module) -> torch.dtype | None:
    # A frozen network has only buffers.
    return _first_precision(network, "_parameters") or _first_precision(network, "_buffers")


def _first_precision(module: nn.Module, kind: str) -> torch.dtype | None:
    # In the order of parameters(), but faster: that call takes as long as a layer of a small network.
    for value in getattr(module, kind).values():
        if value is not None and value.is_floating_point():
            return value.dtype
    found = (_first_precision(child, kind) for child in module._modules.values() if child is not None)
    return next(filter(None, found), None)


def network_observation(observation: Tensor | TensorDictBase, batch: torch.Size) -> Tensor | TensorDictBase:
    """An observation, ``[*B, To, *]`` or a tensordict ``[*B]``, with one batch dimension for ``*B``."""
    if len(batch) == 1:
        return observation
    if isinstance(observation, TensorDictBase):
        return observation.reshape(batch.numel()) if batch else observation.unsqueeze(0)
    return observation.reshape(-1, *observation.shape[len(batch) :])


class TimestepEmbedding(nn.Module):
    """Sines and cosines of ``t`` at frequencies from 1 to 100, log-spaced.

    The embedding of diffusion models, made for a thousand steps, does not suit flow times in [0, 1]: at
    ``1000 t`` its fastest features are noise to the network, and ``t = 0``, the only time that a one-step
    sampler evaluates, looks unlike every time seen in training.

    Args:
        dim: width of the embedding, even.

    Raises:
        ValueError: if ``dim`` is odd or < 4.
    """

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        if dim < 4 or dim % 2:
            raise ValueError(f"the timestep embedding must be even and >= 4, got {dim}")
        self.register_buffer("frequencies", torch.logspace(0, 2, dim // 2), persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        """Embed times ``t`` ``[B]`` as ``[B, dim]``."""
        angle = t[:, None] * self.frequencies
        return torch.cat([angle.sin(), angle.cos()], dim=-1)
