"""The transformer of Diffusion Policy, with a mask that lets the first action see the current observation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from warmprior.modules.network import TimestepEmbedding, VelocityNetwork

__all__ = ["ChiTransformer"]


class ChiTransformer(VelocityNetwork):
    """Decoder transformer over action tokens that attends to time and observation tokens.

    The architecture of `Diffusion Policy <https://arxiv.org/abs/2303.04137>`_ (Chi et al., 2023) in the
    paper's sizes (Table 3). Action tokens attend causally to each other and to the memory
    ``[time, o_{-To+1}, ..., o_0]``.

    .. note::
        Diffusion Policy starts its chunk at the *oldest* observation, and its memory mask hides from
        every action the observations that come after it. Here index 0 of a chunk is the action at the
        *current* step, all ``To`` observations precede it, and nothing in the memory is masked: with
        the original mask and ``To=2`` the first executed action could not see the current observation.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Keyword Args:
        embedding_dim: width of the tokens.
        num_layers: decoder layers.
        num_heads: attention heads, a divisor of ``embedding_dim``.
        timestep_embedding_dim: width of the time embedding before its projection.
        dropout: dropout in attention and feed-forward layers.

    Raises:
        ValueError: if ``num_heads`` does not divide ``embedding_dim``.

    See Also:
        - :class:`~warmprior.VelocityMLP`: a small network for vectors.
        - :class:`~warmprior.VisionNetwork`: puts encoders of images before it.

    Examples:
        >>> from warmprior import ChiTransformer
        >>> import torch
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
        if embedding_dim % num_heads:
            raise ValueError(f"num_heads must divide embedding_dim, got {num_heads} and {embedding_dim}")
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
