"""What the episodes of a cell tell together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch

from warmprior.diagnostics.mean_error import mean_revision
from warmprior.diagnostics.smoothness import smoothness
from warmprior.training.evaluation import Episode

__all__ = ["CellOutcome"]


@dataclass(frozen=True)
class CellOutcome:
    """What a row tells of its episodes.

    Attributes:
        successes: whether each was solved, in the order of their seeds.
        motion: how long they took, how smooth they were, and how far decisions were from their mean.
    """

    successes: list[bool]
    motion: dict[str, float | None]

    @classmethod
    def of(cls, episodes: Sequence[Episode]) -> Self:
        """Summarise episodes.

        Args:
            episodes: in any order.
        """
        # Sums depend on the order: that of the seeds, not that in which the episodes ended.
        episodes = sorted(episodes, key=lambda episode: episode.seed)
        rollout = torch.cat([episode.decisions for episode in episodes])
        # Episodes of a single decision have no boundary between chunks.
        smooth = None
        if any(len(episode.decisions) > 1 for episode in episodes):
            smooth = smoothness(rollout)
        motion = {
            "mean_steps": sum(episode.steps for episode in episodes) / len(episodes),
            "boundary_jump": None if smooth is None else smooth.boundary_jump,
            "inner_jump": None if smooth is None else smooth.inner_jump,
            "mean_revision": mean_revision(rollout),
        }
        return cls([episode.success for episode in episodes], motion)
