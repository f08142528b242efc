"""Compares sources: train what is missing, measure and play it, write it down."""

from __future__ import annotations

import multiprocessing
import traceback
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior.diagnostics.mean_error import MeanError, mean_error, mean_revision
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
from warmprior.experiments.straightness import flow_measures
from warmprior.io.files import check_writable
from warmprior.io.script import ERRORS, PartialFailure
from warmprior.io.workers import WorkerPool, available_cores
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.evaluation import Episode, play_episode
from warmprior.training.training_config import TrainingConfig

__all__ = ["Comparison", "Contestant"]

MEASURED_WINDOWS = 512
"""Observations of the training data on which source leak and flow of every policy are measured."""


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

    def __str__(self) -> str:
        problem = self.store.problem
        return f"{problem.task} {problem.style}, {self.prior.describe()}, seed {self.training.seed}"

    def teacher(self) -> Contestant:
        """The policy that it learns from, see :attr:`Prior.teacher`."""
        return replace(self, prior=self.store.teacher(self.prior))

    def facts(self) -> dict[str, Any]:
        """What rows tell of it."""
        return {
            "task": self.store.problem.task,
            "data": self.store.problem.style,
            **self.store.problem.space,
            "prior": self.prior.name,
            "options": self.prior.options,
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
class _Measure:
    number: int

    def __call__(self, worker: _Worker) -> _Measures:
        return worker.measure(self.number)


@dataclass(frozen=True)
class _Play:
    number: int
    checkpoint: int
    nfe: int
    episode_seed: int

    def __call__(self, worker: _Worker) -> Episode:
        return worker.play(self)


@dataclass(frozen=True)
class _Measures:
    """What is measured of a policy on its training data.

    Attributes:
        leaks: its source leak by NFE.
        means: the error of its mean by NFE.
        flow: of its flow and source; these hold at any NFE.
    """

    leaks: dict[int, SourceLeak]
    means: dict[int, MeanError]
    flow: dict[str, float]


Job = _Train | _Measure | _Play


@dataclass(frozen=True)
class _Failure:
    """Why a job came to nothing."""

    reason: str


@dataclass(frozen=True)
class _Attempt:
    """A job whose failure is a result: it must not stop the others."""

    job: Job

    def __call__(self, worker: _Worker) -> Any:
        try:
            return self.job(worker)
        except Exception as error:
            if not isinstance(error, ERRORS):
                traceback.print_exc()  # nothing that a user can mend
            return _Failure(str(error) or repr(error))


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
        self._simulator: EnvBase | None = None
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
            self._playing = None  # whatever fails on the way
            self._actor, self._env = self._prepare(chosen, job.checkpoint)
            self._playing = job.number, job.checkpoint
        seed = chosen.training.seed
        return play_episode(self._actor, self._env, job.episode_seed, nfe=job.nfe, policy_seed=seed)

    def measure(self, number: int) -> _Measures:
        chosen = self.contestants[number]
        shared = SharedObservations(
            chosen.store.problem.data.to("cpu"),
            chosen.prior.chunk_length,
            observation_steps=chosen.store.network.observation_steps,
        )
        drawn = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        shared = shared.subset(drawn[:MEASURED_WINDOWS].sort()[0])
        policy = self._load(chosen)
        leaks = {}
        if len(shared.episodes.unique()) > 1:  # two episodes with steps to compare
            windows = shared.windows(policy.prior)
            leaks = source_leak(policy, windows, nfes=self.options.nfes, episodes=shared.episodes)
        generator = torch.Generator().manual_seed(0)
        met = shared.met(policy, generator=generator)
        nfes = policy.prior.allowed_nfes(self.options.nfes)
        means = {nfe: mean_error(policy, met, nfe=nfe) for nfe in nfes}
        return _Measures(leaks, means, flow_measures(policy, met, generator=generator))

    def _load(self, chosen: Contestant, checkpoint: int | None = None) -> WarmPriorActor:
        policy = chosen.store.load(chosen.prior, chosen.training, checkpoint)
        return policy.replace(grid=self.options.grid)

    def _prepare(self, chosen: Contestant, checkpoint: int) -> tuple[WarmPriorActor, EnvBase]:
        if self._store is not chosen.store:
            if self._simulator is not None:
                self._simulator.close(raise_if_closed=False)
            self._store, self._simulator = None, None
            self._simulator = chosen.store.problem.make_env(**self.options.environment)
            self._store = chosen.store
        policy = self._load(chosen, checkpoint)
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
        contestants: the policies, in order; after a run without those that failed.
        results: the rows so far.
        failures: what failed in the last run, and why.

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
        self.failures: list[str] = []

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
                        chosen = replace(training, seed=seed)
                        contestant = Contestant(store, store.sized(prior), chosen)
                        key = tuple(contestant.facts().values())
                        if told.setdefault(key, contestant.folder) != contestant.folder:
                            raise ValueError(
                                "rows tell policies apart by their task, prior, options, sigma, chunk "
                                f"length, iterations and seed: they would not tell {prior} from another "
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

    def player(self, contestant: Contestant) -> WarmPriorActor:
        """The last policy of averaged weights, as it is played here.

        Args:
            contestant: one of :attr:`contestants`.
        """
        return contestant.policy().replace(grid=self.recipe.evaluation.grid)

    def policies(self) -> dict[str, dict[int, WarmPriorActor]]:
        """The last policies, by the description of their prior and their training seed.

        A prior of which a seed failed is left out: it would not compare with the others.
        """
        found: dict[str, dict[int, WarmPriorActor]] = {}
        for c in self.contestants:
            found.setdefault(c.prior.describe(), {})[c.training.seed] = c.policy()
        return {
            name: seeds for name, seeds in found.items() if len(seeds) == len(self.recipe.seeds)
        }

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

    @property
    def rows(self) -> list[Row]:
        """The rows of :attr:`contestants`: not those of policies that failed on the way."""
        names = tuple(self.contestants[0].facts())
        mine = {tuple(c.facts().values()) for c in self.contestants}
        return [
            row for row in self.results.rows if tuple(row.facts.get(name) for name in names) in mine
        ]

    def timed(self) -> list[Row]:
        """The :attr:`rows`, with the processor time of their policies' trainings as ``"training_seconds"``.

        It is no part of the results, which are the same on every machine.
        """
        seconds = {
            tuple(c.facts().values()): c.store.training_seconds(c.prior, c.training)
            for c in self.contestants
        }
        names = tuple(self.contestants[0].facts())
        return [
            replace(row, measures={**row.measures, "training_seconds": seconds.get(mine)})
            for row in self.rows
            for mine in [tuple(row.facts.get(name) for name in names)]
        ]

    def run(self) -> Results:
        """Train what is missing and play what is missing, in worker processes.

        A policy is played as soon as it is trained and a worker is free. The rows and their order are the
        same for any number of workers. A policy whose training, measures or episodes fail does not stop the
        others; it is told in :attr:`failures`, and tried again when the run is resumed.

        Returns:
            The results, also in ``results.json``.

        Raises:
            PartialFailure: if no policy is left.
            WorkerError: if a worker process dies, a ``RuntimeError``.
        """
        self._compute({n: self._evaluations(n) for n in range(len(self.contestants))})
        return self.results

    def train(self) -> None:
        """Train what is missing, in worker processes, and play nothing.

        Raises:
            PartialFailure: if a training failed, once all others are done.
            WorkerError: if a worker process dies, a ``RuntimeError``.
        """
        self._compute({n: [] for n in range(len(self.contestants))})
        if self.failures:
            raise PartialFailure("; ".join(self.failures))

    def _missing_teachers(self) -> list[Contestant]:
        """Policies that others learn from (:attr:`Prior.teacher`), where they are not compared themselves."""
        known = {c.folder for c in self.contestants}
        taught = (c for c in self.contestants if c.prior.teacher is not None)
        found = {t.folder: t for t in map(Contestant.teacher, taught) if t.folder not in known}
        return list(found.values())

    def _rows(self, number: int) -> list[tuple[dict[str, Any], int, int]]:
        """Facts of a contestant's rows, with their checkpoint and NFE."""
        c = self.contestants[number]
        return [
            (c.facts() | {"checkpoint": checkpoint, "nfe": nfe}, checkpoint, nfe)
            for checkpoint in c.training.checkpoint_iterations
            for nfe in c.prior.allowed_nfes(self.nfes)
        ]

    def _evaluations(self, number: int) -> list[_Measure | _Play]:
        """What the missing rows need of a policy."""
        missing = [row for row in self._rows(number) if self.results.find(row[0]) is None]
        last = self.contestants[number].training.iterations
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.recipe.evaluation.episodes)
        # Of the last checkpoint alone, for it costs like many episodes.
        measure = [_Measure(number)] if any(c == last for _, c, _ in missing) else []
        return [
            *measure,
            *(_Play(number, checkpoint, nfe, s) for _, checkpoint, nfe in missing for s in seeds),
        ]

    def _compute(self, following: Mapping[int, Sequence[_Measure | _Play]]) -> None:
        """One seed after another; a policy is played before the next is trained.

        Only the last trainings start at once, for they take longest and nothing should wait for them.
        """
        self.results.save()
        everyone = [*self.contestants, *self._missing_teachers()]
        following = {n: following.get(n, []) for n in range(len(everyone))}
        numbers = {c.folder: n for n, c in enumerate(everyone)}
        teachers = {
            n: numbers[c.teacher().folder]
            for n, c in enumerate(everyone)
            if c.prior.teacher is not None
        }
        at_once = self.trainings_at_once or len(following)
        by_seed = sorted(following, key=lambda n: everyone[n].training.seed)
        to_train, ready = deque(map(_Train, by_seed)), deque[_Measure | _Play]()
        worker = _Worker(everyone, self.recipe.evaluation)
        outcomes: dict[tuple[int, int, int], list[Episode]] = {}
        measures: dict[int, _Measures] = {}
        failed: dict[int, str] = {}
        episodes = sum(isinstance(job, _Play) for jobs in following.values() for job in jobs)
        iterations = sum(c.training.iterations for c in everyone)
        workers = min(self.num_workers, sum(1 + len(jobs) for jobs in following.values()))
        training, taught = 0, set[int]()

        def next_training() -> _Train | None:
            """The first that needs no policy which is still to be trained."""
            if training >= at_once or (ready and len(to_train) > workers):
                return None
            free = (job for job in to_train if teachers.get(job.number) in {None, *taught})
            return next(free, None)

        with (
            ComparisonProgress(iterations, episodes) as progress,
            WorkerPool(workers, worker) as pool,
        ):
            while True:
                while pool.idle and ((starts := next_training()) or ready):
                    if starts is not None:
                        to_train.remove(starts)
                        training += 1
                    pool.submit(_Attempt(starts or ready.popleft()))
                if not pool.running:
                    break
                for attempt, result in pool.wait(0.5):
                    job: Job = attempt.job
                    chosen = everyone[job.number]
                    if isinstance(job, _Train):
                        training -= 1
                        taught.add(job.number)
                    if isinstance(result, _Failure):
                        pupils = [n for n, teacher in teachers.items() if teacher == job.number]
                        for n in (job.number, *pupils):
                            if n not in failed:
                                failed[n] = f"{everyone[n]}: {result.reason}"
                                progress.say(f"FAILED {failed[n]}")
                        to_train = deque(j for j in to_train if j.number not in failed)
                        ready = deque(j for j in ready if j.number not in failed)
                    elif isinstance(job, _Train):
                        ready.extend(following[job.number])
                        chosen.store.note_trained(chosen.prior, chosen.training, result)
                        self.results.save()
                        progress.say(f"trained {chosen}, {chosen.training.iterations} iterations")
                    elif isinstance(job, _Measure):
                        measures[job.number] = result
                    else:
                        progress.played()
                        cell = job.number, job.checkpoint, job.nfe
                        outcomes.setdefault(cell, []).append(result)
                    if job.number < len(self.contestants):
                        self._write_down(job.number, outcomes, measures, progress)
                progress.trained(sum(worker.iterations))
        self.failures = [failed[number] for number in sorted(failed)]
        if all(n in failed for n in range(len(self.contestants))):
            raise PartialFailure("; ".join(self.failures))
        self.contestants = [c for n, c in enumerate(self.contestants) if n not in failed]

    def _write_down(
        self,
        number: int,
        outcomes: dict[tuple[int, int, int], list[Episode]],
        measures: Mapping[int, _Measures],
        progress: ComparisonProgress,
    ) -> None:
        """Add the rows of a policy for which everything is there."""
        chosen, count = self.contestants[number], self.recipe.evaluation.episodes
        for facts, checkpoint, nfe in self._rows(number):
            is_last = checkpoint == chosen.training.iterations
            episodes = outcomes.get((number, checkpoint, nfe), [])
            if len(episodes) < count or (is_last and number not in measures):
                continue
            # Sums depend on the order: that of the seeds, not that in which the episodes ended.
            episodes = sorted(outcomes.pop((number, checkpoint, nfe)), key=lambda e: e.seed)
            measured = _of_nfe(measures[number], nfe) if is_last else {}
            motion = _motion(episodes, chosen.prior)
            row = played(facts, [e.success for e in episodes], **motion, **measured)
            self.results.add(row, order=self._place)
            progress.say(_told(chosen, row))

    def _place(self, row: Row) -> tuple[int, int, int]:
        """Where a row stands among all."""
        mine = tuple(row.facts.get(name) for name in self.contestants[0].facts())
        number = self._order.get(mine, len(self._order))
        return number, row.get("checkpoint") or 0, -(row.get("nfe") or 0)


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


def _of_nfe(measured: _Measures, nfe: int) -> dict[str, float | None]:
    """What is measured of a policy, as a row of this NFE tells it."""
    leak, mean = measured.leaks.get(nfe), measured.means[nfe]
    return {
        "mean_error": mean.target,
        "mean_revision_data": mean.revision,
        "source_leak": None if leak is None else leak.leak,
        "inner_step_ratio": None if leak is None else leak.inner_step_ratio,
        **measured.flow,
    }


def _told(chosen: Contestant, row: Row) -> str:
    told = (
        f"played {chosen}, iteration {row['checkpoint']}, NFE {row['nfe']}: {row['successes']} of "
        f"{row['episodes']} solved"
    )
    if row.get("source_leak") is not None:
        told += f", source leak {row['source_leak']:.2f}"
    return told
