"""The interface of velocity networks, and how samplers and losses call one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from warmprior.checks import check_positive, check_whole_numbers
from warmprior.modules.registry import Registered


class VelocityNetwork(nn.Module, Registered):
    """The base class of velocity networks ``v(t, a_t, o)`` that can be saved by name and configuration.

    :class:`~warmprior.ODEActor` and :class:`~warmprior.FlowMatchingLoss` take any module with the same
    signature. This class adds shape checks, and ``config()`` with its name and constructor arguments.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Raises:
        ValueError: if a size is not positive.

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
    """True if :meth:`encode` does anything."""

    def __init__(
        self, action_dim: int, observation_dim: int, prediction_length: int, observation_steps: int
    ) -> None:
        super().__init__()
        check_whole_numbers(action_dim=action_dim, observation_dim=observation_dim)
        check_whole_numbers(prediction_length=prediction_length, observation_steps=observation_steps)
        self.action_dim, self.observation_dim = action_dim, observation_dim
        self.prediction_length, self.observation_steps = prediction_length, observation_steps

    def check_sizes(self, *sizes: int) -> None:
        """Raise ValueError if it was not built with the sizes ``d_a``, ``d_o``, ``P`` and ``To``."""
        names = ("action_dim", "observation_dim", "prediction_length", "observation_steps")
        if (built := tuple(getattr(self, name) for name in names)) != sizes:
            raise ValueError(
                f"{type(self).__name__} was built with ({', '.join(names)}) = {built}, but data and prior "
                f"need {sizes}"
            )

    def check_chunk(self, a: Tensor) -> None:
        """Raise ValueError if the network was built for other chunks than ``a`` ``[B, P, d_a]``."""
        expected = (self.prediction_length, self.action_dim)
        if tuple(a.shape[1:]) != expected:
            raise ValueError(
                f"{type(self).__name__} was built for chunks [B, P, d_a] with (P, d_a) = {expected}, "
                f"got {tuple(a.shape)}"
            )

    def check_shapes(self, a: Tensor, observation: Tensor | TensorDictBase) -> None:
        """Raise ValueError unless chunks ``[B, P, d_a]`` and observations ``[B, To, d_o]`` fit."""
        self.check_chunk(a)
        expected = (self.observation_steps, self.observation_dim)
        if isinstance(observation, Tensor) and tuple(observation.shape[1:]) == expected:
            return
        built = f"{type(self).__name__} was built for observations [B, To, d_o] with (To, d_o) = {expected}"
        if isinstance(observation, TensorDictBase):
            entries = sorted(map(str, observation.keys(True, True)))
            raise ValueError(f"{built}, got the entries {entries}: write a network that encodes them")
        hint = ": FlattenObservation makes them vectors" if observation.ndim > 3 else ""
        raise ValueError(f"{built}, got {tuple(observation.shape)}{hint}")

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """Encode an observation once, before the field is evaluated many times; by default return it.

        The network takes the result in place of the observation, ``[B, To, d_o]`` or a tensordict ``[B]``.
        """
        return observation

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        """Return optimiser groups: decay on matrix weights, none on biases, norms and embeddings."""
        decay: list[nn.Parameter] = []
        no_decay: list[nn.Parameter] = []
        for name, parameter in self.named_parameters():
            is_matrix = parameter.ndim >= 2 and not name.endswith("position")
            (decay if is_matrix else no_decay).append(parameter)
        return [{"params": decay, "weight_decay": weight_decay}, {"params": no_decay, "weight_decay": 0.0}]


def velocity_field(
    network: nn.Module, observation: Tensor | TensorDictBase
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a network's velocity ``(t [B], a [B, P, d_a]) -> v`` at observations, in the dtype of ``a``.

    The observations, ``[B, To, *]`` or a tensordict, are encoded once. The network computes in its own dtype;
    the path is integrated, and its error measured, in that of the actions.
    """
    dtype = precision_of(network)
    encoding = _encoded(network, observation, dtype)
    if dtype is None:
        return lambda t, a: network(t, a, encoding)
    return lambda t, a: network(t.to(dtype), a.to(dtype), encoding).to(a.dtype)


def encoded(network: nn.Module, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
    """Return observations encoded by the network (:meth:`VelocityNetwork.encode`), in its own dtype."""
    return _encoded(network, observation, precision_of(network))


def _encoded(
    network: nn.Module, observation: Tensor | TensorDictBase, dtype: torch.dtype | None
) -> Tensor | TensorDictBase:
    encodes = getattr(network, "encodes", False)

    def cast(value: Tensor) -> Tensor:
        # Vectors [B, To, d] may be integers or flags; what is encoded, such as images, stays as it is.
        number = value.is_floating_point() or (value.ndim <= 3 and not encodes)
        return value if dtype is None or not number else value.to(dtype)

    inputs: Any = observation.apply(cast) if isinstance(observation, TensorDictBase) else cast(observation)
    encode = getattr(network, "encode", None)
    return inputs if encode is None else encode(inputs)


def precision_of(module: nn.Module) -> torch.dtype | None:
    """Return the precision of a module's weights, or ``None`` if it has none."""
    return _precision(module, "_parameters") or _precision(module, "_buffers")  # if it is frozen


def _precision(module: nn.Module, kind: str) -> torch.dtype | None:
    # Not parameters(), whose names and sets take a twentieth of a decision.
    for value in getattr(module, kind).values():
        if value is not None and value.is_floating_point():
            return value.dtype
    for part in module._modules.values():
        if part is not None and (found := _precision(part, kind)):
            return found
    return None


def device_of(module: nn.Module, data: Tensor | TensorDictBase | None = None) -> torch.device:
    """Return the device of a module, or that of ``data``, by default the CPU, if it has no weights."""
    usual = None if data is None else data.device
    values = chain(module.parameters(), module.buffers())
    return next((value.device for value in values), usual or torch.device("cpu"))


def network_observation(observation: Tensor | TensorDictBase, batch: torch.Size) -> Tensor | TensorDictBase:
    """Flatten ``*B`` of an observation, ``[*B, To, *]`` or a tensordict ``[*B, ...]``, to one dimension."""
    if len(batch) == 1:
        return observation
    # Not batch.numel(), with which torch.export would fix the number of rows.
    return observation.reshape(math.prod(batch), *observation.shape[len(batch) :])


class TimestepEmbedding(nn.Module):
    """The sines and cosines ``[B, dim]`` of times ``[B]`` in [0, 1], at frequencies from 1 to ``last``.

    The frequencies are log-spaced. The embedding of diffusion models, made for a thousand steps, does not
    suit flows: at ``1000 t`` its fastest features are noise to the network, and ``t = 0``, the only time that
    a one-step sampler evaluates, looks unlike every time in training. Raises ValueError if ``dim`` is odd or
    < 4, or if ``last`` is not > 0.
    """

    def __init__(self, dim: int, last: float = 100.0) -> None:
        super().__init__()
        check_positive(time_frequency=last)
        check_whole_numbers(4, timestep_embedding_dim=dim)
        if dim % 2:
            raise ValueError(f"timestep_embedding_dim must be even, got {dim}")
        self.frequencies = nn.Buffer(torch.logspace(0, math.log10(last), dim // 2), persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        """Embed the times."""
        angle = t[:, None] * self.frequencies
        return torch.cat([angle.sin(), angle.cos()], dim=-1)


_PREFIX = "_orig_mod."


def uncompiled(module: Any) -> Any:
    """Return the module inside a compiled one; any other is returned unchanged."""
    return getattr(module, _PREFIX[:-1], module)


@contextmanager
def compiling() -> Iterator[None]:
    """Raise ValueError, in one sentence, if what is compiled at its first call cannot be."""
    try:
        yield
    except RuntimeError as error:
        from torch._dynamo.exc import TorchDynamoException

        if not isinstance(error, TorchDynamoException):
            raise
        reason = str(getattr(error, "inner_exception", error)).partition("\n")[0]
        raise ValueError(
            f"the network cannot be compiled ({reason}): install a C++ compiler, such as g++, or train "
            "without compile"
        ) from error


def without_compilation(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a state dict with the names of the uncompiled network."""
    return {name.replace(_PREFIX, ""): value for name, value in tensors.items()}
