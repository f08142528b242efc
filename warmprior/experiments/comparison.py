"""Compares sources: trains what is missing, measures and plays it, and writes it down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.experiments.contestant import Contestant
from warmprior.experiments.labels import source_labels
from warmprior.experiments.methods import Method
from warmprior.experiments.outcomes import Outcomes
from warmprior.experiments.problem import find_problems, observe
from warmprior.experiments.progress import ComparisonProgress
from warmprior.experiments.recipe import HeldOutOptions, Recipe
from warmprior.experiments.record import record
from warmprior.experiments.results import Results, Row, facts_of_machine
from warmprior.experiments.schedule import Schedule
from warmprior.experiments.store import Losses, Store
from warmprior.experiments.trackers import FileTracker, MemoryTracker
from warmprior.experiments.worker import (
    Attempt,
    Job,
    Measure,
    Play,
    PlayCell,
    Tracker,
    Train,
    Worker,
)
from warmprior.io.distributed import go_on_alone, leader_first, rank, world_size
from warmprior.io.files import check_writable
from warmprior.io.ray_pool import RayPool
from warmprior.io.script import PartialFailure
from warmprior.io.workers import Failure, Pool, WorkerPool, available_cores
from warmprior.modules.actor import WarmPriorActor

__all__ = ["Comparison"]


class Comparison:
    """Evaluates the policies of several sources alike.

    Args:
        recipe: everything that determines it.
        study: its name; a folder holds one.
        stores: the problems; those of the recipe by default.
        directory: where the results go; the run's output folder by default.
        methods: what is compared, the baseline first; those of the recipe by default.

    Attributes:
        contestants: the policies, in order; after a run without those that failed.
        results: the rows so far.
        failures: what failed in the last run, and why.

    Raises:
        ValueError: if a method allows none of the NFEs, is longer than every demonstration, or the folder's
            results belong to other options.
        OSError: if the folder cannot be written to.

    See Also:
        - :class:`~warmprior.experiments.Store`: where the policies are.
        - :func:`~warmprior.experiments.success_table`: a table of the rows.
        - :func:`~warmprior.training.evaluate`: the evaluation alone.

    Examples:
        >>> from dataclasses import replace
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import (
        ...     NAVIGATION_PRESETS, Comparison, RunOptions, Store, navigation_problem)
        >>> recipe = NAVIGATION_PRESETS["quick"]
        >>> with TemporaryDirectory() as folder:
        ...     recipe = replace(recipe, run=RunOptions(out=Path(folder) / "run", logger="none"))
        ...     stores = [Store.of(recipe, navigation_problem())]
        ...     compared = Comparison(recipe, "navigation", stores=stores)
        >>> [contestant.method.name for contestant in compared.contestants]
        ['gaussian', 'regression', 'history', 'past', 'past', 'preview', 'preview']
        >>> compared.train()  # in worker processes, one per core  # doctest: +SKIP
    """

    def __init__(
        self,
        recipe: Recipe,
        study: str = "comparison",
        *,
        stores: Sequence[Store] | None = None,
        directory: Path | None = None,
        methods: Sequence[Method] | None = None,
    ) -> None:
        self.recipe, self.directory = recipe, directory or recipe.run.directory
        self.methods = recipe.sources.methods() if methods is None else list(methods)
        self.nfes = recipe.evaluation.nfes
        for method in self.methods:
            method.allowed_nfes(self.nfes)
        check_writable(self.directory)
        if stores is None:
            with leader_first():  # the others find what it has generated, rendered or downloaded
                problems = find_problems(recipe.data, recipe.network.observation_steps)
            stores = [Store.of(recipe, problem) for problem in problems]
        self.stores = list(stores)
        self.contestants = self._contestants()
        self._order = {tuple(c.facts().values()): i for i, c in enumerate(self.contestants)}
        problems = [store.problem for store in self.stores]
        identity = {
            "study": study,
            "recipe": record(recipe),
            "methods": [method.config() for method in self.methods],
            "data": [problem.identity for problem in problems],
        }
        meta = {
            **facts_of_machine(**self._hardware, device=recipe.run.device, torch_threads=1),
            "problems": [{"task": p.task, "style": p.style, **p.facts} for p in problems],
            "policies": [
                c.facts() | {"method": c.method.config(), "folder": c.folder.name}
                for c in self.contestants
            ],
        }
        self.results = Results(
            self.directory / "results.json", meta, identity, resume=recipe.run.resume
        )
        self.failures: list[str] = []

    def _contestants(self) -> list[Contestant]:
        found: dict[Path, Contestant] = {}  # two workers must not train the same policy
        for store in self.stores:
            longest = int(store.problem.data["episode"].flatten().bincount().max())
            for training in self.recipe.trainings():
                for method in self.methods:
                    if method.chunk_length > longest:
                        raise ValueError(
                            f"{method} predicts more steps than the longest demonstration of "
                            f"{store.problem.name} has, {longest}: choose a shorter chunk"
                        )
                    for seed in self.recipe.seeds:
                        chosen = replace(training, seed=seed)
                        contestant = Contestant(store, method, chosen)
                        found.setdefault(contestant.folder, contestant)
        return list(found.values())

    @property
    def num_workers(self) -> int:
        """Worker processes: as asked for, or one per core that this process may use."""
        return self.recipe.run.envs or available_cores()

    @property
    def _hardware(self) -> dict[str, Any]:
        """What computes, where it is known before the work."""
        if self._on_ray:
            return {"engine": "ray", "workers": self.recipe.run.envs}
        return {"workers": self.num_workers}

    @property
    def _on_ray(self) -> bool:
        return self.recipe.run.engine == "ray"

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

    def policies(self) -> dict[Method, dict[int, WarmPriorActor]]:
        """The last policies, by their method and training seed.

        A method of which a seed failed is left out: it would not compare with the others.
        """
        found: dict[Method, dict[int, WarmPriorActor]] = {}
        for c in self.contestants:
            found.setdefault(c.method, {})[c.training.seed] = c.policy()
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
            chunk_length=self.methods[0].chunk_length,
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
            curves.setdefault(label(row), []).append(store.train(c.method, c.training))
        return curves

    @property
    def rows(self) -> list[Row]:
        """The rows of :attr:`contestants`: not those of policies that failed on the way."""
        mine = {tuple(c.facts().values()) for c in self.contestants}
        return [row for row in self.results.rows if self._policy(row) in mine]

    def timed(self) -> list[Row]:
        """The :attr:`rows`, with the processor time of their policies' trainings as ``"training_seconds"``.

        It is no part of the results, which are the same on every machine.
        """
        seconds = {
            tuple(c.facts().values()): c.store.training_seconds(c.method, c.training)
            for c in self.contestants
        }
        return [
            replace(
                row, measures={**row.measures, "training_seconds": seconds.get(self._policy(row))}
            )
            for row in self.rows
        ]

    def _policy(self, row: Row) -> tuple[Any, ...]:
        """The facts of a row that tell which policy it is of."""
        return tuple(row.facts.get(name) for name in self.contestants[0].facts())

    def run(self) -> Results:
        """Train what is missing and play what is missing, in worker processes or on a Ray cluster.

        A policy is played as soon as it is trained and a worker is free. The rows and their order are the
        same for any number of workers. A policy whose training, measures or episodes fail does not stop the
        others; it is told in :attr:`failures`, and tried again when the run is resumed.

        Returns:
            The results, also in ``results.json``.

        Raises:
            PartialFailure: if no policy is left.
            WorkerError: if a worker process dies, a ``RuntimeError``; on a cluster that fails its job alone.
            ConnectionError: if there is no such cluster. What it asks of machines, and raises, is told by
                :class:`~warmprior.io.ray_pool.RayPool`.
        """
        self._compute(play=True)
        return self.results

    def train(self) -> None:
        """Train what is missing, in worker processes, and play nothing.

        Raises:
            PartialFailure: if a training failed, once all others are done.
            WorkerError: if a worker process dies, a ``RuntimeError``.
        """
        self._compute(play=False)
        if self.failures:
            raise PartialFailure("; ".join(self.failures))

    def _missing_teachers(self) -> list[Contestant]:
        """Policies that others learn from (:attr:`Method.teacher`), where they are not compared."""
        known = {c.folder for c in self.contestants}
        taught = (c for c in self.contestants if c.method.teacher is not None)
        found = {t.folder: t for t in map(Contestant.teacher, taught) if t.folder not in known}
        return list(found.values())

    def _compute(self, *, play: bool) -> None:
        """Train, and measure and play what the missing rows need."""
        if not rank():
            self.results.save()
        everyone = [*self.contestants, *self._missing_teachers()]
        found = {n for n, contestant in enumerate(everyone) if contestant.path.is_dir()}
        together = self._train_together(everyone) if world_size() > 1 else {}
        outcomes = Outcomes(self.contestants, self.recipe, whole_cells=self._on_ray)
        following = {}
        if play:
            following = {n: outcomes.missing(n, self.results) for n in range(len(self.contestants))}
        jobs = [job for those in following.values() for job in those]
        tracker = self._tracker(everyone)
        failed: dict[int, str] = {}
        running = set[Job]()
        iterations = sum(c.training.iterations for c in everyone)
        episodes = sum(_amount(job, everyone) for job in jobs if not isinstance(job, Measure))
        with (
            ComparisonProgress(iterations, episodes) as progress,
            self._pool(everyone, len(jobs), tracker) as pool,
        ):
            schedule = self._schedule(everyone, following, pool)
            for number, reason in together.items():
                failed |= {n: f"{everyone[n]}: {reason}" for n in schedule.failed(Train(number))}
            while True:
                while pool.idle and (job := schedule.next()) is not None:
                    pool.submit(Attempt(job))
                    running.add(job)
                if not pool.running:
                    break
                for attempt, result in pool.wait(0.5):
                    job, chosen = attempt.job, everyone[attempt.job.number]
                    running.remove(job)
                    progress.moved(job, _amount(job, everyone))
                    if isinstance(result, Failure):
                        for n in schedule.failed(job):
                            failed[n] = f"{everyone[n]}{_told_cell(job)}: {result.reason}"
                            progress.say(f"FAILED {failed[n]}")
                    elif isinstance(job, Train):
                        schedule.trained(job.number)
                        chosen.store.note_trained(chosen.method, chosen.training, result)
                        self.results.save()
                        done = "found" if job.number in found else "trained"
                        progress.say(f"{done} {chosen}, {chosen.training.iterations} iterations")
                    else:
                        for row in outcomes.add(job, result):
                            self.results.add(row, order=self._place)
                            progress.say(_told(chosen, row))
                for job in running:
                    progress.moved(job, tracker.count(job))
        self.failures = [failed[number] for number in sorted(failed)]
        if isinstance(tracker, FileTracker) and not failed:
            tracker.remove()
        if all(n in failed for n in range(len(self.contestants))):
            raise PartialFailure("; ".join(self.failures))
        self.contestants = [c for n, c in enumerate(self.contestants) if n not in failed]

    def _train_together(self, everyone: Sequence[Contestant]) -> dict[int, str]:
        """Train what is missing by all processes, one policy after another; the first one alone goes on.

        Returns:
            By number, why a training failed. What fails in all processes alike does not stop the others.
        """
        failed: dict[int, str] = {}
        lost = set[Path]()

        def place(entry: tuple[int, Contestant]) -> tuple[int, bool]:
            return entry[1].training.seed, entry[1].method.teacher is not None

        for number, chosen in sorted(enumerate(everyone), key=place):
            if chosen.method.teacher is not None and chosen.teacher().folder in lost:
                continue  # told with its teacher
            quiet = (lambda iteration: None) if rank() else None
            try:
                chosen.store.train(chosen.method, chosen.training, quiet)
            except (FloatingPointError, ValueError) as error:
                failed[number] = str(error)
                lost.add(chosen.folder)
                print(f"FAILED {chosen}: {error}", flush=True)
        go_on_alone()
        return failed

    def _tracker(self, everyone: Sequence[Contestant]) -> MemoryTracker | FileTracker:
        if self._on_ray:
            return FileTracker(self.directory / "cells", everyone, self.recipe.evaluation)
        return MemoryTracker(len(everyone))

    def _pool(
        self, everyone: Sequence[Contestant], num_jobs: int, tracker: Tracker
    ) -> Pool[Worker]:
        """Who computes."""
        make_worker = partial(Worker, everyone, self.recipe.evaluation, tracker)
        if not self._on_ray:
            return WorkerPool(min(self.num_workers, len(everyone) + num_jobs), make_worker())
        run = self.recipe.run
        return RayPool(
            make_worker,
            address=run.ray_address,
            limit=run.envs,
            folders=sorted({self.directory, *(store.directory for store in self.stores)}),
            gpus=lambda attempt: (self.trainings_at_once or 0) * isinstance(attempt.job, Train),
        )

    def _schedule(
        self,
        everyone: Sequence[Contestant],
        following: Mapping[int, Sequence[Measure | Play | PlayCell]],
        pool: Pool[Worker],
    ) -> Schedule:
        """One training seed after another, teachers before their pupils."""
        numbers = {c.folder: n for n, c in enumerate(everyone)}
        at_once = self.trainings_at_once
        if at_once is not None and isinstance(pool, RayPool):
            at_once *= pool.num_gpus
            if not at_once:
                raise ValueError(
                    f"--device {self.recipe.run.device}: no machine of the Ray cluster has a GPU"
                )
        return Schedule(
            sorted(numbers.values(), key=lambda n: everyone[n].training.seed),
            following,
            teachers={
                n: numbers[c.teacher().folder]
                for n, c in enumerate(everyone)
                if c.method.teacher is not None
            },
            workers=pool.num_workers,
            trainings_at_once=at_once,
        )

    def _place(self, row: Row) -> tuple[int, int, int, int, str]:
        """Where a row stands among all."""
        number = self._order.get(self._policy(row), len(self._order))
        condition = row.get("delay") or 0, row.get("guidance") or ""
        return number, row.get("checkpoint") or 0, -(row.get("nfe") or 0), *condition


def _amount(job: Job, everyone: Sequence[Contestant]) -> int:
    """Gradient steps, or episodes, of a job."""
    if isinstance(job, Train):
        return everyone[job.number].training.iterations
    return len(job.episode_seeds) if isinstance(job, PlayCell) else 1


def _told_cell(job: Job) -> str:
    return f", {job.cell}" if isinstance(job, Play | PlayCell) else ""


def _told(chosen: Contestant, row: Row) -> str:
    late = ""
    if row.get("delay") is not None:
        late = f", delay {row['delay']}, guidance {row['guidance']}"
    told = (
        f"played {chosen}, iteration {row['checkpoint']}, NFE {row['nfe']}{late}: {row['successes']} of "
        f"{row['episodes']} solved"
    )
    if row.get("source_leak") is not None:
        told += f", source leak {row['source_leak']:.2f}"
    return told
