"""Compares sources on one set of demonstrations: train, evaluate, write down."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from warmprior.diagnostics.results import Results, Row
from warmprior.diagnostics.smoothness import smoothness
from warmprior.diagnostics.source_leak import SourceLeak
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.files import check_writable
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode
from warmprior.training.policies import Policies
from warmprior.training.policy_worker import PolicyWorker
from warmprior.training.progress import ComparisonProgress
from warmprior.training.schedule import LeakJob, PlayJob, Schedule, TrainJob
from warmprior.training.workers import WorkerPool, available_cores

__all__ = ["Comparison"]


@dataclass
class Comparison:
    """Evaluates the policies of several sources alike.

    Attributes:
        policies: what is compared, or will be once it is trained.
        priors: the sources to compare, the baseline first.
        nfes: network evaluations per chunk to evaluate at.
        directory: output folder.
        seeds: training seeds.
        resume: keep the evaluations that the output folder holds.
        options: recorded in ``results.json``.

    Raises:
        ValueError: if an NFE is below 1, a prior allows none of them, rows could not tell two priors apart,
            or the folder's results belong to other options.
        OSError: if the folder cannot be written to.
    """

    policies: Policies
    priors: Sequence[Prior]
    nfes: Sequence[int]
    directory: Path
    seeds: Sequence[int]
    resume: bool = False
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if min(self.nfes) < 1:
            raise ValueError(f"all nfes must be at least 1, got {list(self.nfes)}")
        told: dict[tuple[str, float, int], Prior] = {}
        for prior in self.priors:
            same = told.setdefault((prior.name, prior.sigma, prior.chunk_length), prior)
            if same.config() != prior.config():
                raise ValueError(
                    "rows tell priors apart by name, sigma and chunk length: they would not tell "
                    f"{prior} from {same}. Compare these in runs of their own"
                )
        for prior in self.priors:
            prior.allowed_nfes(self.nfes)
        check_writable(self.directory)
        self._started = time.monotonic()
        self.results = Results(
            self.directory / "results.json",
            self._meta(),
            resume=self.resume,
            identity=("data", "training", "network", "priors", "evaluation"),
        )
        self._earlier = self.results.meta.get("wall_time_s", 0.0)

    @property
    def num_workers(self) -> int:
        """Worker processes: the preset's, or one per core that this process may use."""
        return self.policies.preset.envs or available_cores()

    @property
    def losses(self) -> dict[str, list[list[tuple[int, float]]]]:
        """Training curves, by prior name one ``[(iteration, loss), ...]`` per policy."""
        curves: dict[str, list[list[tuple[int, float]]]] = {}
        for prior in self.priors:
            for seed in self.seeds:
                curves.setdefault(prior.name, []).append(self.policies.train(prior, seed))
        return curves

    def _meta(self) -> dict[str, Any]:
        policies = self.policies
        preset = policies.preset
        packages = ("warmprior", "torch", "torchrl", "tensordict", "robosuite", "mujoco", "numpy")
        cuda = "cuda" in policies.device
        return {
            "versions": {name: version(name) for name in packages}
            | {"python": platform.python_version()},
            "hardware": {
                "machine": platform.machine(),
                "cores": os.cpu_count(),
                "workers": self.num_workers,
                "torch_threads": 1,
                "device": torch.cuda.get_device_name() if cuda else "cpu",
            },
            **policies.facts(),
            "options": self.options,
            "training": asdict(preset.training) | {"device": policies.device},
            "network": {
                "name": preset.network,
                **preset.network_options,
                "precondition": preset.precondition,
            },
            "priors": [prior.config() for prior in self.priors],
            "short_of_training": preset.short_of_training(self.priors),
            "policies": [
                {"prior": p.config(), "seed": s, "folder": policies.folder(p, s).name}
                for p in self.priors
                for s in self.seeds
            ],
            "evaluation": {
                "episodes": preset.episodes,
                "nfes": list(self.nfes),
                "seeds": list(self.seeds),
            },
        }

    def run(self) -> Results:
        """Train what is missing and play what is missing, in worker processes.

        A policy is played as soon as it is trained and a worker is free. The rows and their order are the
        same for any number of workers.

        Returns:
            The results, also in ``results.json``.

        Raises:
            FloatingPointError: if the loss of a training becomes NaN or infinite; the other trainings
                stop, and continue from their last states when the run is resumed.
            WorkerError: if a worker process dies, a ``RuntimeError``.
        """
        self._save_time()
        cells = self._cells()
        trainings = self._trainings(cells)
        cuda = torch.device(self.policies.device).type == "cuda"
        schedule = Schedule(trainings, trainings_at_once=1 if cuda else None)
        worker = PolicyWorker(self.policies, len(trainings))
        played: dict[Row, list[Episode]] = {}
        leaks: dict[LeakJob, dict[int, SourceLeak]] = {}
        iterations = len(trainings) * self.policies.preset.training.iterations
        jobs = [job for following in trainings.values() for job in following]
        episodes = sum(isinstance(job, PlayJob) for job in jobs)
        workers = min(self.num_workers, len(trainings) + len(jobs))
        with (
            ComparisonProgress(iterations, episodes) as progress,
            WorkerPool(workers, worker) as pool,
        ):
            while True:
                while pool.idle and (job := schedule.next()) is not None:
                    pool.submit(job)
                if not pool.running:
                    return self.results
                for ended, result in pool.wait(0.5):
                    if isinstance(ended, TrainJob):
                        schedule.trained(ended)
                        self.policies.note_trained(ended.prior, ended.seed, result)
                        self._save_time()
                        progress.say(f"trained {ended.prior.describe()}, seed {ended.seed}")
                    elif isinstance(ended, LeakJob):
                        leaks[ended] = result
                    else:
                        progress.played()
                        played.setdefault(ended.row, []).append(result)
                for empty, prior in cells.items():
                    job = self._leak_job(prior, empty)
                    leak = {} if job is None else leaks.get(job)
                    if leak is None or len(played.get(empty, ())) < empty.episodes:
                        continue
                    row = replace(empty, **_outcome(played.pop(empty), leak.get(empty.nfe)))
                    self.results.add(row, [row.cell for row in cells])
                    self._save_time()
                    progress.say(_told(prior, row))
                progress.trained(sum(worker.iterations))

    def _cells(self) -> dict[Row, Prior]:
        """All rows, without the outcomes, in order."""
        return {
            self._row(prior, seed, checkpoint, nfe): prior
            for prior in self.priors
            for seed in self.seeds
            for checkpoint in self.policies.preset.training.checkpoint_iterations
            for nfe in prior.allowed_nfes(self.nfes)
        }

    def _leak_job(self, prior: Prior, row: Row) -> LeakJob | None:
        """The measure that a row needs: of the last checkpoint alone, for it costs like many episodes."""
        if row.checkpoint != self.policies.preset.training.iterations:
            return None
        return LeakJob(prior, row.seed, row.checkpoint, tuple(self.nfes))

    def _trainings(self, cells: dict[Row, Prior]) -> dict[TrainJob, list[LeakJob | PlayJob]]:
        """All trainings, with what the missing rows need of their policies."""
        # By folder: two workers must not train the same policy.
        policies = {self.policies.folder(p, s): (p, s) for p in self.priors for s in self.seeds}
        missing = [item for item in cells.items() if self.results.find(item[0].cell) is None]
        trainings: dict[TrainJob, list[LeakJob | PlayJob]] = {}
        for number, (prior, seed) in enumerate(policies.values()):
            mine = [row for row, owner in missing if (owner, row.seed) == (prior, seed)]
            trainings[TrainJob(prior, seed, number)] = [
                *dict.fromkeys(job for row in mine if (job := self._leak_job(prior, row))),
                *(
                    PlayJob(prior, row, EVALUATION_SEED + episode)
                    for row in mine
                    for episode in range(row.episodes)
                ),
            ]
        return trainings

    def _row(self, prior: Prior, seed: int, checkpoint: int, nfe: int) -> Row:
        return Row(
            task=self.policies.task,
            data=self.policies.demonstrations.style,
            prior=prior.name,
            sigma=prior.sigma,
            chunk=prior.chunk_length,
            nfe=nfe,
            seed=seed,
            checkpoint=checkpoint,
            episodes=self.policies.preset.episodes,
            successes=0,
            mean_steps=0.0,
        )

    def _save_time(self) -> None:
        self.results.meta["wall_time_s"] = self._earlier + time.monotonic() - self._started
        self.results.save()


def _outcome(episodes: Sequence[Episode], leak: SourceLeak | None) -> dict[str, Any]:
    outcome: dict[str, Any] = {
        "successes": sum(episode.success for episode in episodes),
        "mean_steps": sum(episode.steps for episode in episodes) / len(episodes),
    }
    # Sums depend on the order: that of the seeds, not that in which the episodes ended.
    episodes = sorted(episodes, key=lambda episode: episode.seed)
    rollout = torch.cat([episode.decisions for episode in episodes])
    # Episodes of a single decision have no boundary between chunks.
    if any(len(episode.decisions) > 1 for episode in episodes):
        smooth = smoothness(rollout)
        outcome["boundary_jump"] = smooth.boundary_jump
        outcome["inner_jump"] = _known(smooth.inner_jump)
    if leak is not None:
        outcome["source_leak"] = _known(leak.leak)
        outcome["inner_step_ratio"] = _known(leak.inner_step_ratio)
    return outcome


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _told(prior: Prior, row: Row) -> str:
    told = (
        f"played {prior.describe()}, seed {row.seed}, iteration {row.checkpoint}, NFE {row.nfe}: "
        f"{row.successes} of {row.episodes} solved"
    )
    if row.source_leak is not None:
        told += f", source leak {row.source_leak:.2f}"
    return told
