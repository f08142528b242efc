"""Jobs of a benchmark: function calls that run in fresh processes of this machine (loky), or on Ray.

    with Jobs(run) as jobs:
        trained = jobs.submit("train", train, policy)
        jobs.submit("play", play, policy, after=trained, then=print)
        failures = jobs.wait()

The function must be importable. Its result is small, or a file that it finds when it is called again. So a
worker that dies costs only its own job, and nothing is stored here.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from tqdm import tqdm

from lab.io.errors import ERRORS
from lab.io.workers import available_cores, fresh_processes
from lab.options.options import Run

DEATHS = 3  # number of dead workers after which a job counts as failed
LINES_EVERY = 30.0  # seconds between reports on training runs, without a terminal


@dataclass(eq=False)
class Job:
    """A call of a function."""

    name: str
    function: Callable[..., Any]
    args: tuple[Any, ...]
    after: Job | None = None  # the job that must be done first
    group: str = ""  # jobs that are left out if one of them fails
    then: Callable[[Any], object] | None = None  # called in this process with the result
    training: bool = False  # a long job, which takes a GPU if there is one
    status: Path | None = None  # file of its progress: {"iteration": ..., "iterations": ...}
    deaths: int = 0
    done: bool = False

    def progress(self) -> tuple[str, str] | None:
        """Return how far a training is, as a share and in iterations; None if unknown."""
        try:
            status = json.loads(self.status.read_text()) if self.status else {}
            done, total = status["iteration"], status["iterations"]
            return f"{done / total:.0%}", f"{done:,} of {total:,} iterations"
        except (OSError, LookupError, ArithmeticError, TypeError, ValueError):  # none yet, or damaged
            return None


def call(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, str | None]:
    """Call a function in a worker; return its result, or its error as text, which can be pickled."""
    import torch

    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    try:
        return function(*args), None
    except (Exception, SystemExit) as error:  # a user's code may call sys.exit
        if not isinstance(error, ERRORS):
            traceback.print_exc()  # not an error that a user can mend
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        return None, repr(error) if isinstance(error, SystemExit) else str(text) or repr(error)


class Local:
    """Processes of this machine, with one thread each; for CUDA the first ones have one GPU each."""

    def __init__(self, workers: int | None, device: str) -> None:
        self._gpus = _gpus(device)
        self.workers = workers or available_cores()
        self._pools: dict[int, Any] = {}
        self._busy: dict[int, Future[Any]] = {}

    def _slot(self, job: Job) -> int | None:
        free = [i for i in range(self.workers) if i not in self._busy or self._busy[i].done()]
        if self._gpus and job.training:
            return next((i for i in free if i < len(self._gpus)), None)
        return free[-1] if free else None

    def takes(self, job: Job) -> bool:
        """Return True if a process is free, with a GPU if the job needs one."""
        return self._slot(job) is not None

    def submit(self, job: Job) -> Future[Any]:
        """Start a job in a free process; a process starts with its first job."""
        slot = self._slot(job)
        assert slot is not None, "submit is called after takes(job)"
        try:
            self._busy[slot] = self._pools[slot].submit(call, job.function, job.args)
        except (KeyError, BrokenProcessPool):  # not started, or killed by an earlier job
            env = {"CUDA_VISIBLE_DEVICES": "".join(self._gpus[slot : slot + 1])}
            self._pools[slot] = fresh_processes(1, env=env if self._gpus else None)
            self._busy[slot] = self._pools[slot].submit(call, job.function, job.args)
        return self._busy[slot]

    def close(self, kill: bool) -> None:
        """End the processes; results are in files, or were returned."""
        for pool in self._pools.values():
            pool.shutdown(kill_workers=kill)


def _gpus(device: str) -> list[str]:
    """Return the GPUs of --device, in the form of CUDA_VISIBLE_DEVICES."""
    kind, _, index = device.partition(":")
    if kind != "cuda":
        return []
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        import torch

        visible = ",".join(map(str, range(torch.cuda.device_count())))
    names = visible.split(",")
    return [names[int(index)]] if index else names


class Ray:
    """Tasks of a Ray cluster."""

    def __init__(self, run: Run) -> None:
        from lab.io.ray_cluster import ray_cluster

        self._device = run.device
        folders = [] if run.out is None else [run.out, run.policies]
        self._connection = ray_cluster(run.ray_address, run.workers, folders)
        self._ray = self._connection.__enter__()
        self.workers = run.workers or int(self._ray.cluster_resources().get("CPU", 1))
        self._task = self._ray.remote(call)
        self._running: dict[Future[Any], Any] = {}

    def takes(self, job: Job) -> bool:
        return sum(not future.done() for future in self._running) < self.workers

    def submit(self, job: Job) -> Future[Any]:
        gpus = float(job.training and self._device.startswith("cuda"))
        # `Jobs` restarts lost tasks itself.
        options = {"num_cpus": 1, "num_gpus": gpus, "max_retries": 0}
        task = self._task.options(**options).remote(job.function, job.args)
        self._running[future := task.future()] = task
        return future

    def close(self, kill: bool) -> None:
        """Cancel running tasks, and disconnect from the cluster."""
        for future, task in self._running.items():
            if not future.done():
                self._ray.cancel(task, force=True)
        self._connection.__exit__(None, None, None)


class Jobs:
    """The jobs of a run.

    Of the jobs that are ready, the first submitted starts. Only the last trainings go before all others,
    because they take longest and would otherwise run alone at the end.
    """

    def __init__(self, run: Run) -> None:
        # The future of `submit` raises if the worker dies.
        self.engine: Local | Ray = Ray(run) if run.engine == "ray" else Local(run.workers, run.device)
        self._waiting: list[Job] = []
        self._failed: dict[str, str] = {}  # reasons by group
        self._spoke = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self.engine.close(kill=kind is not None)

    def submit(
        self, name: str, function: Callable[..., Any], *args: Any, group: str = "", **options: Any
    ) -> Job:
        """Add a job, with options of :class:`Job`; :meth:`wait` computes it."""
        job = Job(name, function, args, group=group or name, **options)
        self._waiting.append(job)
        return job

    def say(self, line: str) -> None:
        """Print a line above the progress bar."""
        tqdm.write(line)
        sys.stdout.flush()

    def wait(self) -> dict[str, str]:
        """Run all jobs; return the reasons of failures by group."""
        running: dict[Future[Any], Job] = {}
        ended = 0
        # disable=None shows no bar without a terminal.
        with tqdm(desc="jobs", leave=False, dynamic_ncols=True, disable=None) as bar:
            while self._waiting or running:
                while (job := self._next()) is not None:
                    self._waiting.remove(job)
                    running[self.engine.submit(job)] = job
                finished, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = running.pop(future)
                    ended += self._ended(job, future)
                bar.n, bar.total = ended, ended + len(self._waiting) + len(running)
                self._show(bar, running.values())
        return self._failed

    def _show(self, bar: tqdm, running: Iterable[Job]) -> None:
        """Show the progress of trainings in the bar, or print it now and then without a terminal."""
        trainings = {job.name: done for job in running if (done := job.progress())}
        bar.set_postfix_str(", ".join(f"training {share}" for share, _ in trainings.values()))
        if bar.disable and time.monotonic() - self._spoke > LINES_EVERY:
            self._spoke = time.monotonic()
            for name, (_, iterations) in trainings.items():
                print(f"{name}: {iterations}", flush=True)

    def _next(self) -> Job | None:
        """Return the job to start now, if there is one."""
        ready = [
            job for job in self._waiting if (job.after is None or job.after.done) and self.engine.takes(job)
        ]
        trainings = [job for job in ready if job.training]
        if trainings and sum(job.training for job in self._waiting) <= self.engine.workers:
            return trainings[0]
        return ready[0] if ready else None

    def _ended(self, job: Job, future: Future[Any]) -> int:
        """Handle a job whose future is done; return the number of jobs that ended with it."""
        try:
            result, reason = future.result()
        except Exception as error:  # the worker died
            job.deaths += 1
            if job.deaths < DEATHS and not hasattr(error, "cause"):
                self._waiting.insert(0, job)
                return 0
            result, kind = None, type(error).__name__
            reason = f"its worker died {job.deaths} times ({kind}), perhaps for lack of memory: use fewer "
            reason += "--workers"
        if reason is None:
            job.done = True
            if job.then is not None:
                job.then(result)
            return 1
        if job.group not in self._failed:
            what = job.name.replace(job.group, "").replace(" ,", ",").strip()
            self._failed[job.group] = f"{what}: {reason}" if what else str(reason)
            self.say(f"FAILED {job.group}: {self._failed[job.group]}")
        before = len(self._waiting)
        # Its group is left out, and what waits for it, whose group may be another.
        left_out = [other for other in self._waiting if other.group == job.group or other.after is job]
        self._waiting = [other for other in self._waiting if other not in left_out]
        return 1 + before - len(self._waiting)
