"""Velocity networks: the interface, two MLPs, the transformer of Diffusion Policy and a faster one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import MLP

from warmprior.checks import check_whole_numbers
from warmprior.modules.registry import Registered


class VelocityNetwork(nn.Module, Registered):
    """Base class of velocity networks ``v(t, a_t, o)`` that can be saved by name and configuration.

    :class:`~warmprior.ODEActor` and :class:`~warmprior.FlowMatchingLoss` take any callable of the same
    signature. This class adds shape checks and ``config()``, its name and its constructor's arguments.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Raises:
        ValueError: if one of them is not positive.

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
        """A ``ValueError`` for other chunks ``[B, P, d_a]`` or observations ``[B, To, d_o]`` than it has."""
        self.check_chunk(a)
        expected = (self.observation_steps, self.observation_dim)
        built = f"{type(self).__name__} was built for observations [B, To, d_o] with (To, d_o) = {expected}"
        if isinstance(observation, TensorDictBase):
            entries = sorted(map(str, observation.keys(True, True)))
            raise ValueError(f"{built}, got the entries {entries}: write a network that encodes them")
        if tuple(observation.shape[1:]) != expected:
            raise ValueError(f"{built}, got {tuple(observation.shape)}")

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """Encode an observation once, before the field is evaluated at it many times; by default nothing.

        The network takes the result in place of the observation, ``[B, To, d_o]`` or a tensordict ``[B]``.
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

    The observations, ``[B, To, *]`` or a tensordict, are encoded once. The network computes in its own dtype;
    the path is integrated, and its error measured, in that of the actions.
    """
    dtype, seen = _precision(network), encoded(network, observation)
    if dtype is None:
        return lambda t, a: network(t, a, seen)
    return lambda t, a: network(t.to(dtype), a.to(dtype), seen).to(a.dtype)


def encoded(network: nn.Module, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
    """The observations as the network encodes them (:meth:`VelocityNetwork.encode`), in its own dtype."""
    dtype = _precision(network)

    def cast(value: Tensor) -> Tensor:
        return value if dtype is None or not value.is_floating_point() else value.to(dtype)

    seen: Any = observation.apply(cast) if isinstance(observation, TensorDictBase) else cast(observation)
    encode = getattr(network, "encode", None)
    return seen if encode is None else encode(seen)


def _precision(network: nn.Module) -> torch.dtype | None:
    # A frozen network has only buffers.
    values = chain(network.parameters(), network.buffers())
    return next((value.dtype for value in values if value.is_floating_point()), None)


def network_observation(observation: Tensor | TensorDictBase, batch: torch.Size) -> Tensor | TensorDictBase:
    """An observation, ``[*B, To, *]`` or a tensordict ``[*B]``, with one batch dimension for ``*B``."""
    if len(batch) == 1:
        return observation
    if isinstance(observation, TensorDictBase):
        return observation.reshape(batch.numel()) if batch else observation.unsqueeze(0)
    return observation.reshape(-1, *observation.shape[len(batch) :])


class TimestepEmbedding(nn.Module):
    """Sines and cosines of times ``[B]`` in [0, 1], ``[B, dim]``, at frequencies from 1 to 100, log-spaced.

    The embedding of diffusion models, made for a thousand steps, does not suit flows: at ``1000 t`` its
    fastest features are noise to the network, and ``t = 0``, the only time that a one-step sampler evaluates,
    looks unlike every time seen in training. A ``ValueError`` if ``dim`` is odd or < 4.
    """

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        if dim < 4 or dim % 2:
            raise ValueError(f"the timestep embedding must be even and >= 4, got {dim}")
        self.register_buffer("frequencies", torch.logspace(0, 2, dim // 2), persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        """Embed the times."""
        angle = t[:, None] * self.frequencies
        return torch.cat([angle.sin(), angle.cos()], dim=-1)


_PREFIX = "_orig_mod."


def uncompiled(module: nn.Module) -> nn.Module:
    """The module inside a compiled one; any other is returned as it is."""
    return getattr(module, _PREFIX[:-1], module)


def without_compilation(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A state dict under the names of the uncompiled network."""
    return {name.replace(_PREFIX, ""): value for name, value in tensors.items()}


class _Block(nn.Module):
    """Pre-norm residual block of two layers, modulated by the time."""

    def __init__(self, dim: int, time_dim: int) -> None:
        super().__init__()
        # Two layers, because the halves of one layer of twice the width would be strided, and slow to
        # multiply with.
        self.scale, self.shift = nn.Linear(time_dim, dim), nn.Linear(time_dim, dim)
        for layer, effect in ((self.scale, 1.0), (self.shift, 0.0)):
            nn.init.zeros_(layer.weight)
            nn.init.constant_(layer.bias, effect)
        self.norm = nn.LayerNorm(dim, elementwise_affine=False)
        self.layers = nn.Sequential(nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim))

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        return x + self.layers(self.norm(x) * self.scale(time) + self.shift(time))


class VelocityMLP(VelocityNetwork):
    """Residual multi-layer perceptron on the flattened chunk and observation, modulated by the time.

    Time scales and shifts the input of every block (adaptive layer norm, Peebles and Xie, 2023, without their
    gate), from no effect at first. Training at ``t = 0``, the only time that a one-step sampler evaluates,
    then interferes little with other times. The observation has an encoder of its own, which lowers the
    held-out error on robot tasks by 2 to 3 percent. Wrap the network in a
    :class:`~warmprior.PreconditionedNetwork` wherever there are data to fit one.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        hidden_dim: width of the hidden layers.
        num_blocks: number of residual blocks of two layers.
        timestep_embedding_dim: width of the time embedding.

    Examples:
        >>> import torch
        >>> from warmprior import VelocityMLP
        >>> VelocityMLP(7, 23, 8)(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        hidden_dim: int = 384,
        num_blocks: int = 2,
        timestep_embedding_dim: int = 32,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        check_whole_numbers(hidden_dim=hidden_dim, num_blocks=num_blocks)
        self.hidden_dim, self.num_blocks = hidden_dim, num_blocks
        self.timestep_embedding_dim = timestep_embedding_dim
        chunk = prediction_length * action_dim
        self.embed_time = nn.Sequential(
            TimestepEmbedding(timestep_embedding_dim),
            nn.Linear(timestep_embedding_dim, timestep_embedding_dim),
            nn.GELU(),
        )
        self.encode_observation = nn.Sequential(
            nn.Linear(observation_steps * observation_dim, hidden_dim),
            nn.GELU(),
            nn.Linear(hidden_dim, hidden_dim),
        )
        self.embed_chunk = nn.Linear(chunk, hidden_dim)
        self.blocks = nn.ModuleList(_Block(hidden_dim, timestep_embedding_dim) for _ in range(num_blocks))
        self.head = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, chunk))

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        time = self.embed_time(t)
        x = self.embed_chunk(a.flatten(1)) + self.encode_observation(observation.flatten(1))
        for block in self.blocks:
            x = block(x, time)
        return self.head(x).view_as(a)


class PlainMLP(VelocityNetwork):
    """Four layers on time, chunk and observation side by side: the network of the paper's toy (Fig. 5).

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        hidden_dim: width of the three hidden layers.

    Examples:
        >>> import torch
        >>> from warmprior import PlainMLP
        >>> PlainMLP(1, 1, 4, 1)(torch.rand(8), torch.randn(8, 4, 1), torch.randn(8, 1, 1)).shape
        torch.Size([8, 4, 1])
    """

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        hidden_dim: int = 1024,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        check_whole_numbers(hidden_dim=hidden_dim)
        self.hidden_dim = hidden_dim
        chunk = prediction_length * action_dim
        inputs = 1 + chunk + observation_steps * observation_dim
        self.layers = MLP(inputs, chunk, depth=3, num_cells=hidden_dim, activation_class=nn.GELU)

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        return self.layers(t[:, None], a.flatten(1), observation.flatten(1)).view_as(a)


def _check_sizes(num_heads: int, embedding_dim: int, num_layers: int) -> None:
    check_whole_numbers(num_heads=num_heads, embedding_dim=embedding_dim, num_layers=num_layers)
    if embedding_dim % num_heads:
        raise ValueError(f"num_heads must divide embedding_dim, got {num_heads} and {embedding_dim}")


class ChiTransformer(VelocityNetwork):
    """Decoder transformer over action tokens that attends to time and observation tokens.

    The architecture of `Diffusion Policy <https://arxiv.org/abs/2303.04137>`_ (Chi et al., 2023) in the
    paper's sizes (Table 3). Action tokens attend causally to each other and to the memory ``[time, o_{-To+1},
    ..., o_0]``.

    .. note::
        Diffusion Policy starts its chunk at the *oldest* observation, and its mask hides from every action
        the observations after it. Here all ``To`` observations precede index 0, the action at the *current*
        step, and nothing in the memory is masked: with the original mask the first action could not see the
        current one.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        embedding_dim: width of the tokens.
        num_layers: decoder layers.
        num_heads: attention heads, a divisor of ``embedding_dim``.
        timestep_embedding_dim: width of the time embedding before its projection.
        dropout: in attention and feed-forward layers.

    Raises:
        ValueError: if a size is not positive, or ``num_heads`` does not divide ``embedding_dim``.

    Examples:
        >>> import torch
        >>> from warmprior import ChiTransformer
        >>> network = ChiTransformer(7, 23, 8, embedding_dim=24, num_layers=2)
        >>> network(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    causal_mask: Tensor

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        embedding_dim: int = 384,
        num_layers: int = 8,
        num_heads: int = 6,
        timestep_embedding_dim: int = 128,
        dropout: float = 0.1,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        _check_sizes(num_heads, embedding_dim, num_layers)
        self.embedding_dim, self.num_layers, self.num_heads = embedding_dim, num_layers, num_heads
        self.timestep_embedding_dim, self.dropout = timestep_embedding_dim, dropout
        self.embed_time = nn.Sequential(
            TimestepEmbedding(timestep_embedding_dim), nn.Linear(timestep_embedding_dim, embedding_dim)
        )
        self.embed_action = nn.Linear(action_dim, embedding_dim)
        self.embed_observation = nn.Linear(observation_dim, embedding_dim)
        self.action_position = nn.Parameter(torch.empty(1, prediction_length, embedding_dim))
        self.memory_position = nn.Parameter(torch.empty(1, 1 + observation_steps, embedding_dim))
        self.encoder = nn.Sequential(
            nn.Linear(embedding_dim, 4 * embedding_dim),
            nn.Mish(),
            nn.Linear(4 * embedding_dim, embedding_dim),
        )
        layer = nn.TransformerDecoderLayer(
            embedding_dim,
            num_heads,
            dim_feedforward=4 * embedding_dim,
            dropout=dropout,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.decoder = nn.TransformerDecoder(layer, num_layers)
        self.head = nn.Sequential(nn.LayerNorm(embedding_dim), nn.Linear(embedding_dim, action_dim))
        mask = nn.Transformer.generate_square_subsequent_mask(prediction_length)
        self.register_buffer("causal_mask", mask, persistent=False)
        self.apply(self._init_weights)
        nn.init.normal_(self.action_position, std=0.02)
        nn.init.normal_(self.memory_position, std=0.02)

    @staticmethod
    def _init_weights(module: nn.Module) -> None:
        # The normal(0, 0.02) initialisation of Diffusion Policy's transformer.
        if isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, std=0.02)
            nn.init.zeros_(module.bias)
        elif isinstance(module, nn.MultiheadAttention):
            nn.init.normal_(module.in_proj_weight, std=0.02)
            nn.init.zeros_(module.in_proj_bias)

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        memory = torch.cat([self.embed_time(t)[:, None], self.embed_observation(observation)], dim=1)
        memory = self.encoder(memory + self.memory_position)
        tokens = self.embed_action(a) + self.action_position
        tokens = self.decoder(tokens, memory, tgt_mask=self.causal_mask, tgt_is_causal=True)
        return self.head(tokens)


class _AdaLNBlock(nn.Module):
    """Self-attention and a feed-forward layer, each scaled, shifted and gated by a condition."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.norm = nn.LayerNorm(dim, elementwise_affine=False)
        self.qkv, self.project = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)
        self.feed_forward = nn.Sequential(
            nn.Linear(dim, 4 * dim), nn.GELU(approximate="tanh"), nn.Linear(4 * dim, dim)
        )
        self.modulate = nn.Linear(dim, 6 * dim)
        nn.init.zeros_(self.modulate.weight)
        nn.init.zeros_(self.modulate.bias)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        shift, scale, gate, shift2, scale2, gate2 = self.modulate(condition)[:, None].chunk(6, dim=-1)
        queries, keys, values = (
            self.qkv(torch.addcmul(shift, self.norm(x), 1 + scale))
            .unflatten(-1, (3, self.num_heads, -1))
            .permute(2, 0, 3, 1, 4)
        )
        attended = F.scaled_dot_product_attention(queries, keys, values).transpose(1, 2).flatten(2)
        x = torch.addcmul(x, gate, self.project(attended))
        return torch.addcmul(x, gate2, self.feed_forward(torch.addcmul(shift2, self.norm(x), 1 + scale2)))


class AdaLNTransformer(VelocityNetwork):
    """Transformer over action tokens that time and observation modulate (DiT, Peebles and Xie, 2023).

    Time and observations become one vector. It scales, shifts and gates every layer (adaptive layer norm,
    from no effect at first), in place of the cross-attention of :class:`ChiTransformer`.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        embedding_dim: width of the tokens.
        num_layers: blocks.
        num_heads: attention heads, a divisor of ``embedding_dim``.
        timestep_embedding_dim: width of the time embedding before its projection.

    Raises:
        ValueError: if a size is not positive, or ``num_heads`` does not divide ``embedding_dim``.

    Examples:
        >>> import torch
        >>> from warmprior import AdaLNTransformer
        >>> network = AdaLNTransformer(7, 23, 8, embedding_dim=24, num_layers=2)
        >>> network(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        embedding_dim: int = 384,
        num_layers: int = 8,
        num_heads: int = 6,
        timestep_embedding_dim: int = 128,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        _check_sizes(num_heads, embedding_dim, num_layers)
        self.embedding_dim, self.num_layers, self.num_heads = embedding_dim, num_layers, num_heads
        self.timestep_embedding_dim = timestep_embedding_dim
        self.embed_time = nn.Sequential(
            TimestepEmbedding(timestep_embedding_dim), nn.Linear(timestep_embedding_dim, embedding_dim)
        )
        self.embed_observation = nn.Sequential(
            nn.Linear(observation_steps * observation_dim, embedding_dim),
            nn.GELU(),
            nn.Linear(embedding_dim, embedding_dim),
        )
        self.embed_action = nn.Linear(action_dim, embedding_dim)
        self.action_position = nn.Parameter(0.02 * torch.randn(1, prediction_length, embedding_dim))
        self.blocks = nn.ModuleList(_AdaLNBlock(embedding_dim, num_heads) for _ in range(num_layers))
        self.head = nn.Sequential(nn.LayerNorm(embedding_dim), nn.Linear(embedding_dim, action_dim))

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        condition = F.silu(self.embed_time(t) + self.embed_observation(observation.flatten(1)))
        tokens = self.embed_action(a) + self.action_position
        for block in self.blocks:
            tokens = block(tokens, condition)
        return self.head(tokens)
