"""Compares sources: train what is missing, measure and play it, write it down."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.diagnostics.smoothness import smoothness
from warmprior.diagnostics.source_leak import SourceLeak, source_leak
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments.labels import source_labels
from warmprior.experiments.problem import find_problems, observe
from warmprior.experiments.progress import ComparisonProgress
from warmprior.experiments.recipe import EvaluationOptions, HeldOutOptions, Recipe
from warmprior.experiments.record import record
from warmprior.experiments.results import Results, Row, facts_of_machine, played
from warmprior.experiments.store import Losses, Store
from warmprior.io.files import check_writable
from warmprior.io.workers import WorkerPool, available_cores
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.evaluation import Episode, play_episode
from warmprior.training.training_config import TrainingConfig

__all__ = ["Comparison", "Contestant"]

LEAK_WINDOWS = 512
"""Observations on which the source leak of every policy is measured."""


@dataclass(frozen=True, eq=False)
class Contestant:
    """A policy of a comparison, trained or not.

    Attributes:
        store: where it lies, with its problem.
        prior: its source distribution.
        training: its recipe, with its seed.
    """

    store: Store
    prior: Prior
    training: TrainingConfig

    @property
    def folder(self) -> Path:
        """Where it lies, or will lie."""
        return self.store.folder(self.prior, self.training)

    @property
    def path(self) -> Path:
        """Where its last policy of averaged weights lies, or will lie."""
        return policy_path(self.folder, self.training.iterations)

    def policy(self) -> WarmPriorActor:
        """The last policy of averaged weights, trained if it is not yet."""
        return self.store.policy(self.prior, self.training)

    def facts(self) -> dict[str, Any]:
        """What rows tell of it."""
        return {
            "task": self.store.problem.task,
            "data": self.store.problem.style,
            **self.store.problem.space,
            "prior": self.prior.name,
            "sigma": float(self.prior.sigma),
            "chunk": self.prior.chunk_length,
            "seed": self.training.seed,
            "iterations": self.training.iterations,
        }


@dataclass(frozen=True)
class _Train:
    number: int

    def __call__(self, worker: _Worker) -> Losses:
        return worker.train(self.number)


@dataclass(frozen=True)
class _Leak:
    number: int

    def __call__(self, worker: _Worker) -> dict[int, SourceLeak]:
        return worker.leak(self.number)


@dataclass(frozen=True)
class _Play:
    number: int
    checkpoint: int
    nfe: int
    episode_seed: int

    def __call__(self, worker: _Worker) -> Episode:
        return worker.play(self)


class _Worker:
    """The state of a worker process: it trains and measures policies, and plays their episodes.

    It keeps its simulator, and the policy that it played last: an episode after one of the same policy
    needs no preparation.
    """

    def __init__(self, contestants: Sequence[Contestant], options: EvaluationOptions) -> None:
        self.contestants, self.options = contestants, options
        # Iterations of each training, for the process that shows them. Without a lock, which a killed
        # worker might hold for ever: each entry has a single writer.
        self.iterations = multiprocessing.RawArray("q", len(contestants))
        self._store: Store | None = None
        self._simulator: EnvBase
        self._playing: tuple[int, int] | None = None

    def train(self, number: int) -> Losses:
        def report(iteration: int) -> None:
            self.iterations[number] = iteration

        chosen = self.contestants[number]
        losses = chosen.store.train(chosen.prior, chosen.training, report)
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()  # for the next training, which may be another worker's
        return losses

    def play(self, job: _Play) -> Episode:
        chosen = self.contestants[job.number]
        if (job.number, job.checkpoint) != self._playing:
            self._actor, self._env = self._prepare(chosen, job.checkpoint)
            self._playing = job.number, job.checkpoint
        seed = chosen.training.seed
        return play_episode(self._actor, self._env, job.episode_seed, nfe=job.nfe, policy_seed=seed)

    def leak(self, number: int) -> dict[int, SourceLeak]:
        chosen = self.contestants[number]
        shared = SharedObservations(
            chosen.store.problem.data.to("cpu"),
            chosen.prior.chunk_length,
            observation_steps=chosen.store.network.observation_steps,
        )
        drawn = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        shared = shared.subset(drawn[:LEAK_WINDOWS].sort()[0])
        if len(shared.episodes.unique()) < 2:
            return {}  # no two episodes with steps to compare
        policy = chosen.store.load(chosen.prior, chosen.training)
        windows = shared.windows(chosen.prior)
        return source_leak(policy, windows, nfes=self.options.nfes, episodes=shared.episodes)

    def _prepare(self, chosen: Contestant, checkpoint: int) -> tuple[WarmPriorActor, EnvBase]:
        if self._store is not chosen.store:
            if self._store is not None:
                self._simulator.close(raise_if_closed=False)
            self._simulator = chosen.store.problem.make_env(**self.options.environment)
            self._store = chosen.store
        policy = chosen.store.load(chosen.prior, chosen.training, checkpoint)
        # The policy's own prior, which may have learnt.
        transforms = chosen.store.transforms(policy.prior)()
        return policy, TransformedEnv(self._simulator, transforms)


class Comparison:
    """Evaluates the policies of several sources alike.

    Args:
        recipe: everything that determines it.
        study: its name; a folder holds one.
        stores: the problems; those of the recipe by default.
        directory: where the results go; the run's output folder by default.
        priors: the sources, the baseline first; those of the recipe by default.

    Attributes:
        contestants: the policies, in order.
        results: the rows so far.

    Raises:
        ValueError: if a prior allows none of the NFEs, is longer than every demonstration, rows could not
            tell two policies apart, or the folder's results belong to other options.
        OSError: if the folder cannot be written to.
    """

    def __init__(
        self,
        recipe: Recipe,
        study: str = "comparison",
        *,
        stores: Sequence[Store] | None = None,
        directory: Path | None = None,
        priors: Sequence[Prior] | None = None,
    ) -> None:
        self.recipe, self.directory = recipe, directory or recipe.run.directory
        self.priors = recipe.sources.priors() if priors is None else list(priors)
        self.nfes = recipe.evaluation.nfes
        for prior in self.priors:
            prior.allowed_nfes(self.nfes)
        check_writable(self.directory)
        if stores is None:
            out = recipe.run.directory
            policies, logs = out.parent / "policies", out / "logs"
            problems = find_problems(recipe.data, recipe.network.observation_steps)
            stores = [Store(p, recipe.network, policies, logs, recipe.run) for p in problems]
        self.stores = list(stores)
        self.contestants = self._contestants()
        self._order = {tuple(c.facts().values()): i for i, c in enumerate(self.contestants)}
        problems = [store.problem for store in self.stores]
        identity = {
            "study": study,
            "recipe": record(recipe),
            "priors": [prior.config() for prior in self.priors],
            "data": [problem.identity for problem in problems],
        }
        meta = {
            **facts_of_machine(workers=self.num_workers, device=recipe.run.device, torch_threads=1),
            "problems": [{"task": p.task, "style": p.style, **p.facts} for p in problems],
            "policies": [
                c.facts() | {"prior": c.prior.config(), "folder": c.folder.name}
                for c in self.contestants
            ],
        }
        self.results = Results(
            self.directory / "results.json", meta, identity, resume=recipe.run.resume
        )

    def _contestants(self) -> list[Contestant]:
        found: dict[Path, Contestant] = {}  # two workers must not train the same policy
        told: dict[tuple[Any, ...], Path] = {}
        for store in self.stores:
            longest = int(store.problem.data["episode"].flatten().bincount().max())
            for training in self.recipe.trainings():
                for prior in self.priors:
                    if prior.chunk_length > longest:
                        raise ValueError(
                            f"{prior} predicts more steps than the longest demonstration of "
                            f"{store.problem.name} has, {longest}: choose a shorter chunk"
                        )
                    for seed in self.recipe.seeds:
                        contestant = Contestant(store, prior, replace(training, seed=seed))
                        key = tuple(contestant.facts().values())
                        if told.setdefault(key, contestant.folder) != contestant.folder:
                            raise ValueError(
                                "rows tell policies apart by their task, prior, sigma, chunk length, "
                                f"iterations and seed: they would not tell {prior} from another "
                                f"{prior.name}. Compare these in runs of their own"
                            )
                        found.setdefault(contestant.folder, contestant)
        return list(found.values())

    @property
    def num_workers(self) -> int:
        """Worker processes: as asked for, or one per core that this process may use."""
        return self.recipe.run.envs or available_cores()

    @property
    def trainings_at_once(self) -> int | None:
        """How many trainings may share the device; no limit on a CPU, where each has a thread."""
        return None if torch.device(self.recipe.run.device).type == "cpu" else 1

    @property
    def title(self) -> str:
        """What is compared, for figures."""
        return ", ".join(store.problem.name for store in self.stores)

    def policies(self) -> dict[str, dict[int, WarmPriorActor]]:
        """The last policies, by the description of their prior and their training seed."""
        found: dict[str, dict[int, WarmPriorActor]] = {}
        for c in self.contestants:
            found.setdefault(c.prior.describe(), {})[c.training.seed] = c.policy()
        return found

    def observe(self, options: HeldOutOptions) -> tuple[SharedObservations, str]:
        """Held-out observations of the first problem, and what they are in words.

        Args:
            options: which.

        Raises:
            ValueError: see :func:`observe`.
        """
        problem = self.stores[0].problem
        assert problem.normalizer is not None, "demonstrations of simulators have one"
        return observe(
            options,
            self.results.meta["problems"][0],
            problem.normalizer,
            chunk_length=self.priors[0].chunk_length,
            observation_steps=self.recipe.network.observation_steps,
            device=self.recipe.run.device,
        )

    def losses(self, store: Store) -> dict[str, list[Losses]]:
        """Training curves on one problem, by source one ``[(iteration, loss), ...]`` per policy.

        Args:
            store: of the problem.
        """
        mine = [c for c in self.contestants if c.store is store]
        rows = [Row(c.facts(), {}) for c in mine]
        label, curves = source_labels(rows), dict[str, list[Losses]]()
        for c, row in zip(mine, rows, strict=True):
            curves.setdefault(label(row), []).append(store.train(c.prior, c.training))
        return curves

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
        self._compute({n: self._evaluations(n) for n in range(len(self.contestants))})
        return self.results

    def train(self) -> None:
        """Train what is missing, in worker processes, and play nothing."""
        self._compute({n: [] for n in range(len(self.contestants))})

    def _rows(self, number: int) -> list[tuple[dict[str, Any], int, int]]:
        """Facts of a contestant's rows, with their checkpoint and NFE."""
        c = self.contestants[number]
        return [
            (c.facts() | {"checkpoint": checkpoint, "nfe": nfe}, checkpoint, nfe)
            for checkpoint in c.training.checkpoint_iterations
            for nfe in c.prior.allowed_nfes(self.nfes)
        ]

    def _evaluations(self, number: int) -> list[_Leak | _Play]:
        """What the missing rows need of a policy."""
        missing = [row for row in self._rows(number) if self.results.find(row[0]) is None]
        last = self.contestants[number].training.iterations
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.recipe.evaluation.episodes)
        # The leak of the last checkpoint alone, for it costs like many episodes.
        leak = [_Leak(number)] if any(checkpoint == last for _, checkpoint, _ in missing) else []
        return [
            *leak,
            *(_Play(number, checkpoint, nfe, s) for _, checkpoint, nfe in missing for s in seeds),
        ]

    def _compute(self, following: Mapping[int, Sequence[_Leak | _Play]]) -> None:
        """Longest jobs first: trainings, then measures and episodes of what is trained."""
        self.results.save()
        at_once = self.trainings_at_once or len(following)
        to_train, ready = deque(_Train(n) for n in following), deque[_Leak | _Play]()
        worker = _Worker(self.contestants, self.recipe.evaluation)
        outcomes: dict[tuple[int, int, int], list[Episode]] = {}
        leaks: dict[int, dict[int, SourceLeak]] = {}
        episodes = sum(isinstance(job, _Play) for jobs in following.values() for job in jobs)
        iterations = sum(self.contestants[n].training.iterations for n in following)
        workers = min(self.num_workers, sum(1 + len(jobs) for jobs in following.values()))
        training = 0
        with (
            ComparisonProgress(iterations, episodes) as progress,
            WorkerPool(workers, worker) as pool,
        ):
            while True:
                while pool.idle and ((to_train and training < at_once) or ready):
                    starts = bool(to_train) and training < at_once
                    pool.submit(to_train.popleft() if starts else ready.popleft())
                    training += starts
                if not pool.running:
                    return
                for job, result in pool.wait(0.5):
                    chosen = self.contestants[job.number]
                    if isinstance(job, _Train):
                        training -= 1
                        ready.extend(following[job.number])
                        chosen.store.note_trained(chosen.prior, chosen.training, result)
                        self.results.save()
                        progress.say(
                            f"trained {chosen.store.problem.task}, {chosen.prior.describe()}, seed "
                            f"{chosen.training.seed}, {chosen.training.iterations} iterations"
                        )
                    elif isinstance(job, _Leak):
                        leaks[job.number] = result
                    else:
                        progress.played()
                        cell = job.number, job.checkpoint, job.nfe
                        outcomes.setdefault(cell, []).append(result)
                    self._write_down(job.number, outcomes, leaks, progress)
                progress.trained(sum(worker.iterations))

    def _write_down(
        self,
        number: int,
        outcomes: dict[tuple[int, int, int], list[Episode]],
        leaks: Mapping[int, Mapping[int, SourceLeak]],
        progress: ComparisonProgress,
    ) -> None:
        """Add the rows of a policy for which everything is there."""
        chosen, count = self.contestants[number], self.recipe.evaluation.episodes
        for facts, checkpoint, nfe in self._rows(number):
            is_last = checkpoint == chosen.training.iterations
            episodes = outcomes.get((number, checkpoint, nfe), [])
            if len(episodes) < count or (is_last and number not in leaks):
                continue
            # Sums depend on the order: that of the seeds, not that in which the episodes ended.
            episodes = sorted(outcomes.pop((number, checkpoint, nfe)), key=lambda e: e.seed)
            leak = leaks[number].get(nfe) if is_last else None
            row = _outcome(facts, episodes, leak)
            self.results.add(row, order=self._place)
            progress.say(_told(chosen, row))

    def _place(self, row: Row) -> tuple[int, int, int]:
        """Where a row stands among all."""
        mine = tuple(row.facts.get(name) for name in self.contestants[0].facts())
        number = self._order.get(mine, len(self._order))
        return number, row.get("checkpoint") or 0, -(row.get("nfe") or 0)


def _outcome(facts: Mapping[str, Any], episodes: Sequence[Episode], leak: SourceLeak | None) -> Row:
    # Episodes of a single decision have no boundary between chunks.
    smooth = None
    if any(len(episode.decisions) > 1 for episode in episodes):
        smooth = smoothness(torch.cat([episode.decisions for episode in episodes]))
    return played(
        facts,
        sum(episode.success for episode in episodes),
        len(episodes),
        mean_steps=sum(episode.steps for episode in episodes) / len(episodes),
        boundary_jump=smooth and smooth.boundary_jump,
        inner_jump=smooth and smooth.inner_jump,
        source_leak=leak and leak.leak,
        inner_step_ratio=leak and leak.inner_step_ratio,
    )


def _told(chosen: Contestant, row: Row) -> str:
    told = (
        f"played {chosen.store.problem.task}, {chosen.prior.describe()}, seed {row['seed']}, iteration "
        f"{row['checkpoint']}, NFE {row['nfe']}: {row['successes']} of {row['episodes']} solved"
    )
    if row["source_leak"] is not None:
        told += f", source leak {row['source_leak']:.2f}"
    return told
