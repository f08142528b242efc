"""A flat velocity network for small problems and small budgets."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from warmprior.modules.network import TimestepEmbedding, VelocityNetwork

__all__ = ["VelocityMLP"]


class _Block(nn.Module):
    """Pre-norm residual block of two layers."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.LayerNorm(dim), nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim)
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.net(x)


class VelocityMLP(VelocityNetwork):
    """Residual multi-layer perceptron on the flattened chunk, observation and time.

    Two choices matter at small budgets. The observation has an encoder of its own: in one vector with
    the chunk it would be drowned by the source's unit noise, because normalised observations vary
    little. And it predicts ``net(t, a, o) - a``: under every source the velocity contains minus the point
    itself, and a network that has to learn this identity part pays for it at one integration step.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Keyword Args:
        hidden_dim: width of the hidden layers.
        num_blocks: number of residual blocks of two layers.
        timestep_embedding_dim: width of the time embedding.

    Examples:
        >>> import torch
        >>> network = VelocityMLP(7, 23, 8)
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
        hidden_dim: int = 512,
        num_blocks: int = 2,
        timestep_embedding_dim: int = 32,
    ) -> None:
        super().__init__(
            action_dim,
            observation_dim,
            prediction_length,
            observation_steps,
            hidden_dim=hidden_dim,
            num_blocks=num_blocks,
            timestep_embedding_dim=timestep_embedding_dim,
        )
        chunk = prediction_length * action_dim
        self.embed_time = TimestepEmbedding(timestep_embedding_dim)
        self.encode_observation = nn.Sequential(
            nn.Linear(observation_steps * observation_dim, hidden_dim),
            nn.GELU(),
            nn.Linear(hidden_dim, hidden_dim),
        )
        self.embed_chunk = nn.Linear(chunk + timestep_embedding_dim, hidden_dim)
        self.trunk = nn.Sequential(*(_Block(hidden_dim) for _ in range(num_blocks)))
        self.head = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, chunk))

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        x = self.embed_chunk(torch.cat([a.flatten(1), self.embed_time(t)], dim=-1))
        x = self.trunk(x + self.encode_observation(observation.flatten(1)))
        return self.head(x).view_as(a) - a
