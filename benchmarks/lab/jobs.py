"""Jobs of a benchmark: functions that fresh processes of this machine (loky), or a Ray cluster, compute.

    with Jobs(run) as jobs:
        trained = jobs.submit("train", train, policy)
        jobs.submit("play", play, policy, after=trained, then=print)
        failures = jobs.wait()

A job is a function of an importable module whose result is small, or a file that it finds again when it is
called once more. So a worker that dies costs its own job alone, and nothing is stored here.
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

from lab.files import ERRORS
from lab.options import Run
from lab.workers import available_cores, fresh_processes

DEATHS = 3  # workers that a job may lose before it counts as failed
LINES_EVERY = 30.0  # seconds between two reports on running trainings where there is no terminal


@dataclass(eq=False)
class Job:
    """One call of a function."""

    name: str
    function: Callable[..., Any]
    args: tuple[Any, ...]
    after: Job | None = None  # it starts once this one is done
    group: str = ""  # after a failure, the other jobs of its group are left out
    then: Callable[[Any], object] | None = None  # called here with the result
    training: bool = False  # it is long, and takes a GPU if there is one
    status: Path | None = None  # where it reports its progress: {"iteration": ..., "iterations": ...}
    deaths: int = 0
    done: bool = False

    def iterations(self) -> tuple[int, int] | None:
        """How many iterations of a training are done, of how many."""
        try:
            status = json.loads(self.status.read_text()) if self.status else {}
            return status["iteration"], status["iterations"]
        except (OSError, ValueError, KeyError):  # none yet, or another machine is writing it
            return None


def call(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, str | None]:
    """In a worker: the result, or why there is none, as text: some exceptions cannot be pickled."""
    import torch

    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    try:
        return function(*args), None
    except (Exception, SystemExit) as error:  # code of a user's may call sys.exit
        if not isinstance(error, ERRORS):
            traceback.print_exc()  # nothing that a user can mend
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        return None, repr(error) if isinstance(error, SystemExit) else str(text) or repr(error)


class Local:
    """Processes of this machine, one thread each; the first ones have a GPU each, where one is asked for."""

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
        """Whether a process is free, with a GPU where the job trains on one."""
        return self._slot(job) is not None

    def submit(self, job: Job) -> Future[Any]:
        """Start it in a free process, which is started with its first job."""
        slot = self._slot(job)
        assert slot is not None, "takes(job) says so"
        try:
            self._busy[slot] = self._pools[slot].submit(call, job.function, job.args)
        except (KeyError, BrokenProcessPool):  # none yet, or it died with an earlier job
            env = {"CUDA_VISIBLE_DEVICES": "".join(self._gpus[slot : slot + 1])}
            self._pools[slot] = fresh_processes(1, env=env if self._gpus else None)
            self._busy[slot] = self._pools[slot].submit(call, job.function, job.args)
        return self._busy[slot]

    def close(self, kill: bool) -> None:
        """End the processes: what they have done is in files, or was given back."""
        for pool in self._pools.values():
            pool.shutdown(kill_workers=kill)


def _gpus(device: str) -> list[str]:
    """The GPUs that --device names, as CUDA_VISIBLE_DEVICES takes them."""
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
        from lab.ray_cluster import ray_cluster

        self._device = run.device
        folders = [] if run.out is None else [run.out, run.policies]
        self._connection = ray_cluster(run.ray_address, run.envs, folders)
        self._ray = self._connection.__enter__()
        self.workers = run.envs or int(self._ray.cluster_resources().get("CPU", 1))
        self._task = self._ray.remote(call)
        self._running: dict[Future[Any], Any] = {}

    def takes(self, job: Job) -> bool:
        return sum(not future.done() for future in self._running) < self.workers

    def submit(self, job: Job) -> Future[Any]:
        gpus = float(job.training and self._device.startswith("cuda"))
        # Lost ones are started again by `Jobs`, here as on one machine.
        options = {"num_cpus": 1, "num_gpus": gpus, "max_retries": 0}
        task = self._task.options(**options).remote(job.function, job.args)
        self._running[future := task.future()] = task
        return future

    def close(self, kill: bool) -> None:
        """Cancel what runs, and leave the cluster."""
        for future, task in self._running.items():
            if not future.done():
                self._ray.cancel(task, force=True)
        self._connection.__exit__(None, None, None)


class Jobs:
    """Jobs of one run.

    The first that is ready starts first, but the last trainings start before everything else: they take
    longest, and nothing should wait for them in the end.
    """

    def __init__(self, run: Run) -> None:
        # Either says what it `takes`, starts it (a future that raises if the worker dies), and closes.
        self.engine: Local | Ray = Ray(run) if run.engine == "ray" else Local(run.envs, run.device)
        self._waiting: list[Job] = []
        self._failed: dict[str, str] = {}  # by group, why
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
        """Print a line that stays above the bar."""
        tqdm.write(line)
        sys.stdout.flush()

    def wait(self) -> dict[str, str]:
        """Compute all jobs; what failed, by group, and why."""
        running: dict[Future[Any], Job] = {}
        ended = 0
        # disable=None: no bar without a terminal.
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
        """How far the trainings are: in the bar, or where there is none, in lines now and then."""
        trainings = {job.name: done for job in running if (done := job.iterations())}
        bar.set_postfix_str(", ".join(f"training {n / total:.0%}" for n, total in trainings.values()))
        if bar.disable and time.monotonic() - self._spoke > LINES_EVERY:
            self._spoke = time.monotonic()
            for name, (n, total) in trainings.items():
                print(f"{name}: {n:,} of {total:,} iterations", flush=True)

    def _next(self) -> Job | None:
        """The job that starts now, if one can."""
        ready = [
            job for job in self._waiting if (job.after is None or job.after.done) and self.engine.takes(job)
        ]
        trainings = [job for job in ready if job.training]
        if trainings and sum(job.training for job in self._waiting) <= self.engine.workers:
            return trainings[0]
        return ready[0] if ready else None

    def _ended(self, job: Job, future: Future[Any]) -> int:
        """Take note of a job whose future is done; how many jobs that settles."""
        try:
            result, reason = future.result()
        except Exception as error:  # the worker died
            job.deaths += 1
            if job.deaths < DEATHS and not hasattr(error, "cause"):
                self._waiting.insert(0, job)
                return 0
            result, kind = None, type(error).__name__
            reason = f"its worker died {job.deaths} times ({kind}), perhaps for lack of memory: use fewer "
            reason += "with --envs"
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
        self._waiting = [other for other in self._waiting if other.group != job.group]
        return 1 + before - len(self._waiting)
