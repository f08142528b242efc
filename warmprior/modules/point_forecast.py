"""What learned sources share whose network forecasts the chunk itself."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.learned import LearnedPrior
from warmprior.modules.learning_windows import LearningWindows

__all__ = ["PointForecastPrior"]


class PointForecastPrior(LearnedPrior):
    """Base class of learned priors whose network forecasts the chunk, by mean squared error.

    Args:
        chunk_length: ``H``.

    Examples:
        >>> import torch
        >>> prior = PointForecastPrior(4).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.zeros(5, 4, 2), torch.zeros(5, 4, 1, dtype=torch.bool)
        >>> prior.forecast(loc, warm, torch.zeros(5, 1, 3)).shape
        torch.Size([5, 4, 2])
    """

    always_warm = True

    def build(self) -> None:
        """The forecaster."""
        self.network = self.mlp(self.seen_dim, self.chunk_dim)

    def forecast(self, loc: Tensor, warm: Tensor, observation: Tensor | None) -> Tensor:
        """The forecast chunk.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            observation: see :meth:`distribution`.

        Returns:
            In normalised action units, ``[*B, P, d_a]``.
        """
        seen = self.seen(loc, warm, observation)
        return self.network(seen).unflatten(-1, (self.prediction_length, self.action_dim))

    def learning_loss(
        self, windows: LearningWindows, generator: torch.Generator | None = None
    ) -> Tensor:
        """Mean squared error."""
        forecast = self.forecast(windows.loc, windows.warm, windows.observation)
        return windows.mean((windows.a1 - forecast).square())
