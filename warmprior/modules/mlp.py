"""A flat velocity network for small problems and small budgets."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from warmprior.modules.network import TimestepEmbedding, VelocityNetwork

__all__ = ["VelocityMLP"]


class VelocityMLP(VelocityNetwork):
    """Multi-layer perceptron on the flattened chunk, observation and time.

    It predicts ``net(t, a, o) - a``: under every source the velocity contains minus the point itself,
    and a network that has to learn this identity part pays for it at one integration step.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.

    Keyword Args:
        hidden_dim: width of the hidden layers.
        num_layers: number of hidden layers.
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
        num_layers: int = 3,
        timestep_embedding_dim: int = 32,
    ) -> None:
        super().__init__(
            action_dim,
            observation_dim,
            prediction_length,
            observation_steps,
            hidden_dim=hidden_dim,
            num_layers=num_layers,
            timestep_embedding_dim=timestep_embedding_dim,
        )
        self.embed_time = TimestepEmbedding(timestep_embedding_dim)
        chunk = prediction_length * action_dim
        self.net = MLP(
            in_features=chunk + observation_steps * observation_dim + timestep_embedding_dim,
            out_features=chunk,
            num_cells=[hidden_dim] * num_layers,
            activation_class=nn.GELU,
        )

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        self.check_shapes(a, observation)
        flat = torch.cat([a.flatten(1), observation.flatten(1), self.embed_time(t)], dim=-1)
        return self.net(flat).view_as(a) - a
