"""Worker processes that take jobs one after another and end with whoever started them."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from types import TracebackType
from typing import Any, Protocol, Self

import torch
from tqdm import tqdm

__all__ = [
    "Failure",
    "Pool",
    "WorkerError",
    "WorkerPool",
    "available_cores",
    "end_with_parent",
    "start_method",
    "stop_forking",
]

_forks = True


class WorkerError(RuntimeError):
    """A worker process died, or cannot do the work.

    See Also:
        - :func:`~warmprior.training.parallel_env`: its processes.
        - :class:`~warmprior.io.workers.WorkerPool`: its workers.

    Examples:
        >>> with WorkerPool(1, 3) as pool:
        ...     pool.submit(os._exit)  # the worker ends with exit code 3
        ...     pool.wait()
        Traceback (most recent call last):
            ...
        warmprior.io.workers.WorkerError: worker 0 of 1 (exit code 3) died. It may have been killed for ...
    """


def worker_died(worker: str, advice: str) -> WorkerError:
    """The error that tells which worker died, the likely reason, and what to do."""
    return WorkerError(
        f"{worker} died. It may have been killed for lack of memory; use fewer workers (--envs), or {advice}."
    )


def start_method() -> str:
    """How to start workers: forking takes a second instead of a minute.

    But autograd refuses to work in the child of a process that used it where a GPU is in sight, even if
    that GPU is never used. See also :func:`stop_forking`.
    """
    if not _forks or torch.cuda.is_available():
        return "spawn"
    count_devices()
    return "fork"


@cache
def count_devices() -> None:
    """Let autograd count devices now, where there is none.

    It does so when it first computes a gradient, and refuses to work in forks from then on if there is one.
    Compiling anything, or fake tensors, let it see a GPU that is not there: it has to count before.
    """
    torch.ones((), requires_grad=True).backward()


def stop_forking() -> None:
    """Let this process start further workers afresh: it holds something that does not survive a fork."""
    global _forks
    _forks = False


def available_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def end_with_parent() -> None:
    """Let this process end when the one that started it dies, however abruptly.

    A killed process cannot tell its workers to stop, and they would wait for hours: its ends of their
    pipes stay open in whatever else it forked later. The main process is left alone.
    """
    if multiprocessing.parent_process() is None:
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)  # nobody is left to be told, and the environment may be in the middle of a step

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


@dataclass(frozen=True)
class Failure:
    """Why a job came to nothing, as a result among others.

    Attributes:
        reason: in words.

    See Also:
        :class:`~warmprior.io.workers.WorkerPool`: gives it in place of a result.

    Examples:
        >>> results = [0.9, Failure("its process was killed 4 times"), 0.7]
        >>> [result.reason for result in results if isinstance(result, Failure)]
        ['its process was killed 4 times']
    """

    reason: str


class Pool[State](Protocol):
    """What takes jobs: worker processes (:class:`WorkerPool`), or many machines (:class:`RayPool`).

    Examples:
        >>> from functools import partial
        >>> from operator import add
        >>> def results(pool: Pool, jobs):  # works with any
        ...     for job in jobs:
        ...         pool.submit(job)
        ...     while pool.running:
        ...         yield from (result for _, result in pool.wait())
        >>> with WorkerPool(1, 40) as pool:
        ...     sorted(results(pool, [partial(add, 2), partial(add, 1)]))
        [41, 42]
    """

    @property
    def num_workers(self) -> int:
        """How many jobs run at once at most."""

    @property
    def running(self) -> int:
        """Number of jobs submitted whose results :meth:`wait` has not given."""

    @property
    def idle(self) -> int:
        """Number of jobs that would start at once."""

    def submit(self, job: Callable[[State], Any]) -> None:
        """Let a worker call ``job(state)``."""

    def wait(self, timeout: float | None = None) -> list[tuple[Any, Any]]:
        """Wait until a job ends; ``[(job, result), ...]`` of those that have."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class WorkerPool[State]:
    """Processes that each hold a copy of a state and compute, with one thread, a job at a time.

    Leaving the context normally ends idle workers; leaving it with an error, such as Ctrl-C, ends all of
    them at once, whatever they do.

    Args:
        num_workers: number of processes.
        state: what jobs work on; has to be picklable where CUDA is in use or this process has rendered.
            What a job changes in it stays in its worker.

    Raises:
        ValueError: if ``num_workers < 1``.

    See Also:
        :class:`~warmprior.io.ray_pool.RayPool`: the same on a cluster.

    Examples:
        >>> from functools import partial
        >>> from operator import add
        >>> with WorkerPool(2, 40) as pool:
        ...     pool.submit(partial(add, 2))
        ...     [result for job, result in pool.wait()]
        [42]
    """

    def __init__(self, num_workers: int, state: State) -> None:
        if num_workers < 1:
            raise ValueError(f"the number of workers must be at least 1, got {num_workers}")
        self.num_workers = num_workers
        self._executor = ProcessPoolExecutor(
            num_workers,
            multiprocessing.get_context(start_method()),
            _start_worker,
            (state, torch.get_float32_matmul_precision()),
        )
        self._running: dict[Future[bytes], Callable[[State], Any]] = {}

    @property
    def running(self) -> int:
        """Number of jobs submitted whose results :meth:`wait` has not given."""
        return len(self._running)

    @property
    def idle(self) -> int:
        """Number of workers without a job."""
        return max(0, self.num_workers - self.running)

    def submit(self, job: Callable[[State], Any]) -> None:
        """Let a worker call ``job(state)``.

        Args:
            job: picklable.

        Raises:
            BrokenProcessPool: if a worker died; a ``WorkerError`` once the context is left.
        """
        with warnings.catch_warnings():
            # The children compute with one thread and use no lock that another thread may hold.
            warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
            self._running[self._executor.submit(_run, job)] = job

    def wait(self, timeout: float | None = None) -> list[tuple[Any, Any]]:
        """Wait until a job ends.

        Args:
            timeout: in seconds; without limit by default.

        Returns:
            ``[(job, result), ...]`` of the jobs that ended well; none after ``timeout``.

        Raises:
            Exception: whatever a job raised, once the results of all that ended before are given.
            BrokenProcessPool: if a worker died; a ``WorkerError`` once the context is left.
        """
        done, _ = wait(self._running, timeout, FIRST_COMPLETED)
        # An error ends the work of whoever waits: what others have finished must not be lost with it.
        finished = [future for future in done if future.exception() is None] or list(done)
        return [(self._running.pop(future), pickle.loads(future.result())) for future in finished]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        processes = list((self._executor._processes or {}).values())
        if error is not None and not isinstance(error, BrokenProcessPool):
            for process in processes:
                process.kill()
        self._executor.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            # The executor terminated the others.
            codes = [process.exitcode for process in processes]
            i = next((i for i, c in enumerate(codes) if c not in (0, -signal.SIGTERM)), 0)
            raise worker_died(
                f"worker {i} of {len(codes)} (exit code {codes[i]})",
                "see above for its own error",
            ) from error


_state: Any = None
"""Of this worker process."""


def _start_worker(state: Any, matmul_precision: str) -> None:
    global _state
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends its workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision(matmul_precision)
    tqdm.set_lock(threading.RLock())  # the parent's may have been held when it forked
    _state = state


def _run(job: Callable[[Any], Any]) -> bytes:
    # By value: left to itself, torch would share every tensor as an open file.
    return pickle.dumps(job(_state))
