"""From the episodes and measures of policies to rows: what a row needs, and what it tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments.cell_outcome import CellOutcome
from warmprior.experiments.contestant import Cell, Contestant
from warmprior.experiments.measures import Measures
from warmprior.experiments.recipe import Recipe
from warmprior.experiments.results import Results, Row, played
from warmprior.experiments.worker import Measure, Play, PlayCell
from warmprior.training.evaluation import Episode

__all__ = ["Outcomes"]


class Outcomes:
    """What is known of policies, until it makes a row.

    The rows of the last checkpoint alone tell measures, for they cost like many episodes.

    Args:
        contestants: the policies that jobs name by number.
        recipe: how they are played.

    Keyword Args:
        whole_cells: whether a job plays all episodes of a cell, or one of them.
    """

    def __init__(
        self, contestants: Sequence[Contestant], recipe: Recipe, *, whole_cells: bool = False
    ) -> None:
        self._whole_cells = whole_cells
        self._contestants, self._options = contestants, recipe.evaluation
        nfes = self._options.nfes
        self._cells = [c.cells(nfes, recipe.conditions(c.method)) for c in contestants]
        self._episodes: dict[tuple[int, Cell], list[Episode]] = {}
        self._played: dict[tuple[int, Cell], CellOutcome] = {}
        self._measures: dict[int, Measures] = {}

    def missing(self, number: int, results: Results) -> list[Measure | Play | PlayCell]:
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
        measures = [Measure(number)] if is_last else []
        if self._whole_cells:
            return [*measures, *(PlayCell(number, cell, seeds) for cell in cells)]
        return [*measures, *(Play(number, cell, seed) for cell in cells for seed in seeds)]

    def add(self, job: Measure | Play | PlayCell, outcome: Any) -> list[Row]:
        """Take note of what a job gave.

        Args:
            job: which.
            outcome: what it gave.

        Returns:
            The rows of its policy that lacked nothing else; each is given once.
        """
        number = job.number
        if isinstance(job, Measure):
            self._measures[number] = outcome
        elif isinstance(job, PlayCell):
            self._played[number, job.cell] = outcome
        else:
            episodes = self._episodes.setdefault((number, job.cell), [])
            episodes.append(outcome)
            if len(episodes) == self._options.episodes:
                self._played[number, job.cell] = CellOutcome.of(episodes)
                del self._episodes[number, job.cell]
        return self._complete(number)

    def _complete(self, number: int) -> list[Row]:
        chosen, rows = self._contestants[number], []
        for cell in self._cells[number]:
            is_last = cell.checkpoint == chosen.training.iterations
            if (number, cell) not in self._played or (is_last and number not in self._measures):
                continue
            outcome = self._played.pop((number, cell))
            measured = self._measures[number][cell.nfe] if is_last else {}
            facts = chosen.facts() | cell.facts()
            rows.append(played(facts, outcome.successes, **outcome.motion, **measured))
        return rows
