"""From the episodes and measures of policies to rows: what a row needs, and what it tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from warmprior.diagnostics.mean_error import mean_revision
from warmprior.diagnostics.smoothness import smoothness
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments.contestant import Cell, Contestant
from warmprior.experiments.measures import Measures
from warmprior.experiments.recipe import Recipe
from warmprior.experiments.results import Results, Row, played
from warmprior.experiments.worker import Measure, Play
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode

__all__ = ["Outcomes"]


class Outcomes:
    """What is known of policies, until it makes a row.

    The rows of the last checkpoint alone tell measures, for they cost like many episodes.

    Args:
        contestants: the policies that jobs name by number.
        recipe: how they are played.
    """

    def __init__(self, contestants: Sequence[Contestant], recipe: Recipe) -> None:
        self._contestants, self._options = contestants, recipe.evaluation
        nfes = self._options.nfes
        self._cells = [c.cells(nfes, recipe.conditions(c.prior)) for c in contestants]
        self._episodes: dict[tuple[int, Cell], list[Episode]] = {}
        self._measures: dict[int, Measures] = {}

    def missing(self, number: int, results: Results) -> list[Measure | Play]:
        """The jobs that the rows of a policy need.

        Args:
            number: of the policy.
            results: the rows that are there.
        """
        chosen = self._contestants[number]
        cells = [
            cell
            for cell in self._cells[number]
            if results.find(chosen.facts() | cell.facts()) is None
        ]
        is_last = any(cell.checkpoint == chosen.training.iterations for cell in cells)
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + self._options.episodes)
        return [
            *([Measure(number)] if is_last else []),
            *(Play(number, cell, seed) for cell in cells for seed in seeds),
        ]

    def add(self, job: Measure | Play, outcome: Any) -> list[Row]:
        """Take note of what a job gave.

        Args:
            job: which.
            outcome: of the job: :class:`Measures` or an :class:`~warmprior.training.Episode`.

        Returns:
            The rows of its policy that lacked nothing else; each is given once.
        """
        if isinstance(job, Measure):
            self._measures[job.number] = outcome
        else:
            self._episodes.setdefault((job.number, job.cell), []).append(outcome)
        return self._complete(job.number)

    def _complete(self, number: int) -> list[Row]:
        chosen, rows = self._contestants[number], []
        for cell in self._cells[number]:
            is_last = cell.checkpoint == chosen.training.iterations
            count = len(self._episodes.get((number, cell), ()))
            if count < self._options.episodes or (is_last and number not in self._measures):
                continue
            # Sums depend on the order: that of the seeds, not that in which the episodes ended.
            played_out = self._episodes.pop((number, cell))
            episodes = sorted(played_out, key=lambda episode: episode.seed)
            measured = self._measures[number].at(cell.nfe) if is_last else {}
            motion, facts = _motion(episodes, chosen.prior), chosen.facts() | cell.facts()
            rows.append(played(facts, [e.success for e in episodes], **motion, **measured))
        return rows


def _motion(episodes: Sequence[Episode], prior: Prior) -> dict[str, float | None]:
    """How long episodes took, how smooth they were, and how far decisions were from their mean."""
    rollout = torch.cat([episode.decisions for episode in episodes])
    # Episodes of a single decision have no boundary between chunks.
    smooth = None
    if any(len(episode.decisions) > 1 for episode in episodes):
        smooth = smoothness(rollout)
    return {
        "mean_steps": sum(episode.steps for episode in episodes) / len(episodes),
        "boundary_jump": None if smooth is None else smooth.boundary_jump,
        "inner_jump": None if smooth is None else smooth.inner_jump,
        "mean_revision": mean_revision(rollout, prior),
    }
