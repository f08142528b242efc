"""What sources that learn before the flow learn from."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

__all__ = ["LearningWindows"]


@dataclass(frozen=True)
class LearningWindows:
    """Windows of demonstrations, as a :class:`~warmprior.LearnedPrior` is given them to learn from.

    Attributes:
        a1: targets, ``[B, P, d_a]``.
        counted: positions inside the episode, bool ``[B, P, 1]``.
        loc: mean of :class:`~warmprior.PastPrior`, ``[B, P, d_a]``.
        warm: where there is one, bool ``[B, P, 1]``.
        observation: ``[B, To, d_o]``.

    Examples:
        >>> import torch
        >>> a1, counted = torch.tensor([[[1.0], [3.0], [99.0]]]), torch.tensor([[[True], [True], [False]]])
        >>> windows = LearningWindows(a1, counted, a1, counted, observation=torch.zeros(1, 2, 5))
        >>> windows.mean(windows.a1)
        tensor(2.)
    """

    a1: Tensor
    counted: Tensor
    loc: Tensor
    warm: Tensor
    observation: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the coordinates inside the episode.

        Args:
            values: one per coordinate of the targets, ``[B, P, d_a]``.

        Returns:
            A scalar; 0 if no position is inside.
        """
        counted = self.counted.expand_as(values)
        return (values * counted).sum() / counted.sum().clamp_min(1)
