"""What a worker process of a comparison does: it trains policies, measures them and plays them."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior.experiments.cell_outcome import CellOutcome
from warmprior.experiments.condition import Condition
from warmprior.experiments.contestant import Cell, Contestant
from warmprior.experiments.measures import Measures, measure
from warmprior.experiments.recipe import EvaluationOptions
from warmprior.experiments.store import Losses, Store
from warmprior.io.script import ERRORS
from warmprior.io.workers import Failure
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.evaluation import Episode, play_episode

__all__ = ["Attempt", "Job", "Measure", "Play", "PlayCell", "Tracker", "Train", "Worker"]


@dataclass(frozen=True)
class Train:
    """Train a policy.

    Attributes:
        number: of the policy.
    """

    number: int

    def __call__(self, worker: Worker) -> Losses:
        """Its training curve."""
        return worker.train(self.number)


@dataclass(frozen=True)
class Measure:
    """Measure the last checkpoint of a policy on its training data.

    Attributes:
        number: of the policy.
    """

    number: int

    def __call__(self, worker: Worker) -> Measures:
        """What was measured."""
        return worker.measure(self.number)


@dataclass(frozen=True)
class Play:
    """Play an episode.

    Attributes:
        number: of the policy.
        cell: how it is played.
        episode_seed: of the episode.
    """

    number: int
    cell: Cell
    episode_seed: int

    def __call__(self, worker: Worker) -> Episode:
        """The episode."""
        return worker.play(self)


@dataclass(frozen=True)
class PlayCell:
    """Play all episodes of a cell, one after another.

    Attributes:
        number: of the policy.
        cell: how it is played.
        episode_seeds: of the episodes.
    """

    number: int
    cell: Cell
    episode_seeds: range

    def __call__(self, worker: Worker) -> CellOutcome:
        """What they tell together."""
        episodes = []
        for seed in self.episode_seeds:
            episodes.append(worker.play(Play(self.number, self.cell, seed)))
            worker.tracker.report(self, len(episodes))
        return CellOutcome.of(episodes)


Job = Train | Measure | Play | PlayCell


class Tracker(Protocol):
    """How far jobs are, told by those who do them to those who wait for them."""

    def report(self, job: Job, count: int) -> None:
        """A job has come to ``count`` gradient steps, or episodes."""

    def count(self, job: Job) -> int:
        """How far it is."""

    def result(self, job: Job, compute: Callable[[], Any]) -> Any:
        """What a job gives; computed if that is not known from an earlier attempt."""


@dataclass(frozen=True)
class Attempt:
    """A job whose failure is a result: it must not stop the others."""

    job: Job

    def __call__(self, worker: Worker) -> Any:
        """What the job gives, or a :class:`Failure`."""
        try:
            return worker.tracker.result(self.job, partial(self.job, worker))
        except Exception as error:
            if not isinstance(error, ERRORS):
                traceback.print_exc()  # nothing that a user can mend
            return Failure(str(error) or repr(error))


class Worker:
    """The state of a worker process.

    It keeps its simulator, and the policy that it played last: an episode after one of the same policy
    needs no preparation.

    Args:
        contestants: the policies that jobs name by number.
        options: how they are played.
        tracker: is told how far jobs are.
    """

    def __init__(
        self, contestants: Sequence[Contestant], options: EvaluationOptions, tracker: Tracker
    ) -> None:
        self.contestants, self.options, self.tracker = contestants, options, tracker
        self._store: Store | None = None
        self._simulator: EnvBase | None = None
        self._playing: tuple[int, int, Condition] | None = None

    def train(self, number: int) -> Losses:
        """Train a policy, see :meth:`Store.train`."""
        chosen, report = self.contestants[number], partial(self.tracker.report, Train(number))
        losses = chosen.store.train(chosen.method, chosen.training, report)
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()  # for the next training, which may be another worker's
        return losses

    def measure(self, number: int) -> Measures:
        """Measure the last checkpoint of a policy on its training data."""
        chosen = self.contestants[number]
        return measure(
            self._load(chosen),
            chosen.store.problem.data,
            self.options.nfes,
            chunk_length=chosen.method.chunk_length,
            coupled=chosen.method.composition.coupling is not None,
            observation_steps=chosen.store.network.observation_steps,
        )

    def play(self, job: Play) -> Episode:
        """Play an episode; its noise is that of the policy's seed."""
        chosen, cell = self.contestants[job.number], job.cell
        prepared = job.number, cell.checkpoint, cell.condition
        if prepared != self._playing:
            self._playing = None  # whatever fails on the way
            self._actor, self._env = self._prepare(chosen, cell)
            self._playing = prepared
        seed = chosen.training.seed
        return play_episode(
            self._actor, self._env, job.episode_seed, nfe=cell.nfe, policy_seed=seed
        )

    def _load(self, chosen: Contestant, checkpoint: int | None = None) -> WarmPriorActor:
        policy = chosen.store.load(chosen.method, chosen.training, checkpoint)
        return policy.replace(grid=self.options.grid)

    def _prepare(self, chosen: Contestant, cell: Cell) -> tuple[WarmPriorActor, EnvBase]:
        if self._store is not chosen.store:
            if self._simulator is not None:
                self._simulator.close(raise_if_closed=False)
            self._store, self._simulator = None, None
            self._simulator = chosen.store.problem.make_env(**self.options.environment)
            self._store = chosen.store
        condition = cell.condition
        policy = self._load(chosen, cell.checkpoint).replace(guidance=condition.guidance)
        make_transforms = chosen.store.transforms(chosen.method)
        transforms = make_transforms(execute=condition.execute, delay=condition.delay)
        return policy, TransformedEnv(self._simulator, transforms)
