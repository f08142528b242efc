"""Velocity networks over action tokens: the transformer of Diffusion Policy, and a faster one."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.modules import MLP

from warmprior.checks import check_share, check_whole_numbers
from warmprior.modules.network import TimestepEmbedding, VelocityNetwork


def _check_sizes(num_heads: int, hidden_dim: int, num_layers: int, observation_layers: int) -> None:
    check_whole_numbers(num_heads=num_heads, hidden_dim=hidden_dim, num_layers=num_layers)
    check_whole_numbers(0, observation_layers=observation_layers)
    if hidden_dim % num_heads:
        raise ValueError(f"num_heads must divide hidden_dim, got {num_heads} and {hidden_dim}")


class ChiTransformer(VelocityNetwork):
    """A decoder transformer over action tokens that attends to time and observation tokens.

    It is the architecture of `Diffusion Policy <https://arxiv.org/abs/2303.04137>`_ (Chi et al., 2023) in the
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
        hidden_dim: width of the tokens.
        num_layers: decoder layers.
        num_heads: attention heads, a divisor of ``hidden_dim``.
        timestep_embedding_dim: width of the time embedding before its projection.
        dropout: dropout rate of attention and feed-forward layers.
        observation_layers: hidden layers of a network that makes the observation tokens from all ``To`` steps
            together; with 0, each token is a linear function of its own step.
        time_frequency: the highest frequency of the time embedding; the lowest is 1.

    Raises:
        ValueError: if a size is not positive, ``dropout`` is not in [0, 1), or ``num_heads`` does not divide
            ``hidden_dim``.

    Examples:
        >>> import torch
        >>> from warmprior import ChiTransformer
        >>> network = ChiTransformer(7, 23, 8, hidden_dim=24, num_layers=2)
        >>> network(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    name = "chi_transformer"

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        hidden_dim: int = 384,
        num_layers: int = 8,
        num_heads: int = 6,
        timestep_embedding_dim: int = 128,
        dropout: float = 0.1,
        observation_layers: int = 0,
        time_frequency: float = 100.0,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        _check_sizes(num_heads, hidden_dim, num_layers, observation_layers)
        check_share(dropout=dropout)
        self.hidden_dim, self.num_layers, self.num_heads = hidden_dim, num_layers, num_heads
        self.timestep_embedding_dim, self.dropout = timestep_embedding_dim, dropout
        self.observation_layers, self.time_frequency = observation_layers, time_frequency
        self.embed_time = nn.Sequential(
            TimestepEmbedding(timestep_embedding_dim, time_frequency),
            nn.Linear(timestep_embedding_dim, hidden_dim),
        )
        self.embed_action = nn.Linear(action_dim, hidden_dim)
        self.embed_observation: nn.Module = nn.Linear(observation_dim, hidden_dim)
        if observation_layers:
            sizes = observation_steps * observation_dim, observation_steps * hidden_dim
            self.embed_observation = nn.Sequential(
                nn.Flatten(),
                MLP(*sizes, depth=observation_layers, num_cells=hidden_dim, activation_class=nn.GELU),
                nn.Unflatten(-1, (observation_steps, hidden_dim)),
            )
        self.action_position = nn.Parameter(torch.empty(1, prediction_length, hidden_dim))
        self.memory_position = nn.Parameter(torch.empty(1, 1 + observation_steps, hidden_dim))
        self.encoder = nn.Sequential(
            nn.Linear(hidden_dim, 4 * hidden_dim),
            nn.Mish(),
            nn.Linear(4 * hidden_dim, hidden_dim),
        )
        layer = nn.TransformerDecoderLayer(
            hidden_dim,
            num_heads,
            dim_feedforward=4 * hidden_dim,
            dropout=dropout,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.decoder = nn.TransformerDecoder(layer, num_layers)
        self.head = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, action_dim))
        mask = nn.Transformer.generate_square_subsequent_mask(prediction_length)
        self.causal_mask = nn.Buffer(mask, persistent=False)
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
        """Return the velocity ``[B, P, d_a]`` at times ``t`` ``[B]`` and points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        memory = torch.cat([self.embed_time(t)[:, None], self.embed_observation(observation)], dim=1)
        memory = self.encoder(memory + self.memory_position)
        tokens = self.embed_action(a) + self.action_position
        tokens = self.decoder(tokens, memory, tgt_mask=self.causal_mask, tgt_is_causal=True)
        return self.head(tokens)


class _AdaLNBlock(nn.Module):
    """A block of self-attention and a feed-forward layer, each scaled, shifted and gated by a condition."""

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
    """A transformer over action tokens, modulated by time and observation (DiT, Peebles and Xie, 2023).

    Time and observations become one vector. It scales, shifts and gates every layer (adaptive layer norm,
    from no effect at first), in place of the cross-attention of :class:`ChiTransformer`.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        hidden_dim: width of the tokens.
        num_layers: blocks.
        num_heads: attention heads, a divisor of ``hidden_dim``.
        timestep_embedding_dim: width of the time embedding before its projection.
        observation_layers: hidden layers of the network that reads all ``To`` steps together.
        time_frequency: the highest frequency of the time embedding; the lowest is 1.

    Raises:
        ValueError: if a size is not positive, or ``num_heads`` does not divide ``hidden_dim``.

    Examples:
        >>> import torch
        >>> from warmprior import AdaLNTransformer
        >>> network = AdaLNTransformer(7, 23, 8, hidden_dim=24, num_layers=2)
        >>> network(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    name = "adaln_transformer"

    def __init__(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        observation_steps: int = 2,
        *,
        hidden_dim: int = 384,
        num_layers: int = 8,
        num_heads: int = 6,
        timestep_embedding_dim: int = 128,
        observation_layers: int = 1,
        time_frequency: float = 100.0,
    ) -> None:
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        _check_sizes(num_heads, hidden_dim, num_layers, observation_layers)
        self.hidden_dim, self.num_layers, self.num_heads = hidden_dim, num_layers, num_heads
        self.timestep_embedding_dim = timestep_embedding_dim
        self.observation_layers, self.time_frequency = observation_layers, time_frequency
        self.embed_time = nn.Sequential(
            TimestepEmbedding(timestep_embedding_dim, time_frequency),
            nn.Linear(timestep_embedding_dim, hidden_dim),
        )
        sizes = observation_steps * observation_dim, hidden_dim
        self.embed_observation = MLP(
            *sizes, depth=observation_layers, num_cells=hidden_dim, activation_class=nn.GELU
        )
        self.embed_action = nn.Linear(action_dim, hidden_dim)
        self.action_position = nn.Parameter(0.02 * torch.randn(1, prediction_length, hidden_dim))
        self.blocks = nn.ModuleList(_AdaLNBlock(hidden_dim, num_heads) for _ in range(num_layers))
        self.head = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, action_dim))

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Return the velocity ``[B, P, d_a]`` at times ``t`` ``[B]`` and points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        condition = F.silu(self.embed_time(t) + self.embed_observation(observation.flatten(1)))
        tokens = self.embed_action(a) + self.action_position
        for block in self.blocks:
            tokens = block(tokens, condition)
        return self.head(tokens)
