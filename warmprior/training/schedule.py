"""The jobs of a comparison and their order: trainings, and measures and episodes of what is trained."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from warmprior.diagnostics.results import Row
from warmprior.diagnostics.source_leak import SourceLeak
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode
from warmprior.training.policy_worker import PolicyWorker

__all__ = ["LeakJob", "PlayJob", "Schedule", "TrainJob"]


@dataclass(frozen=True, eq=False)
class TrainJob:
    """Train a policy.

    Attributes:
        prior: its source distribution.
        seed: its training seed.
        number: of the training, from 0.
    """

    prior: Prior
    seed: int
    number: int

    def __call__(self, worker: PolicyWorker) -> list[tuple[int, float]]:
        """The training curve."""
        return worker.train(self.prior, self.seed, self.number)


@dataclass(frozen=True)
class LeakJob:
    """Measure how much of the source's noise a trained policy lets through.

    Attributes:
        prior: the policy's source distribution.
        seed: its training seed.
        checkpoint: its iteration.
        nfes: network evaluations per chunk.
    """

    prior: Prior
    seed: int
    checkpoint: int
    nfes: tuple[int, ...]

    def __call__(self, worker: PolicyWorker) -> dict[int, SourceLeak]:
        """The measures by NFE."""
        return worker.leak(self.prior, self.seed, self.checkpoint, self.nfes)


@dataclass(frozen=True, eq=False)
class PlayJob:
    """Play an episode.

    Attributes:
        prior: the policy's source distribution.
        row: what the episode belongs to, without the outcome.
        episode_seed: of the simulator.
    """

    prior: Prior
    row: Row
    episode_seed: int

    def __call__(self, worker: PolicyWorker) -> Episode:
        """The episode."""
        row = self.row
        return worker.play(self.prior, row.seed, row.checkpoint, row.nfe, self.episode_seed)


class Schedule:
    """Gives the longest jobs first: trainings, then measures and episodes of the policies trained so far.

    Args:
        following: what to do with each training's policy.
        trainings_at_once: how many trainings may run at a time; no limit by default.
    """

    def __init__(
        self,
        following: Mapping[TrainJob, Sequence[LeakJob | PlayJob]],
        trainings_at_once: int | None = None,
    ) -> None:
        self._following = following
        self._at_once = trainings_at_once
        self._to_train = deque(following)
        self._training: set[TrainJob] = set()
        self._ready: deque[LeakJob | PlayJob] = deque()

    def next(self) -> TrainJob | LeakJob | PlayJob | None:
        """The next job for an idle worker; ``None`` if there is none until :meth:`trained`."""
        if self._to_train and (self._at_once is None or len(self._training) < self._at_once):
            job = self._to_train.popleft()
            self._training.add(job)
            return job
        return self._ready.popleft() if self._ready else None

    def trained(self, job: TrainJob) -> None:
        """Note that a training ended: its policy can be measured and played."""
        self._training.remove(job)
        self._ready.extend(self._following[job])
