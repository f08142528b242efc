"""Processes and threads that compute: how they start, and that they end with whoever started them."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

from warmprior.io.extras import require

_forks = True


class WorkerError(RuntimeError):
    """A worker process died, or cannot do the work.

    Examples:
        >>> from warmprior.training import WorkerError
        >>> raise WorkerError("worker 0 of 2 (exit code 9) died")
        Traceback (most recent call last):
            ...
        warmprior.io.workers.WorkerError: worker 0 of 2 (exit code 9) died
    """


def worker_died(worker: str, advice: str) -> WorkerError:
    """The error that tells which worker died, the likely reason, and what to do."""
    return WorkerError(
        f"{worker} died. It may have been killed for lack of memory; use fewer workers (--envs), or {advice}."
    )


def start_method() -> str:
    """How to start workers: forking takes a second instead of a minute.

    But autograd refuses to work in a fork of a process that used it where a GPU is in sight.
    """
    if not _forks or torch.cuda.is_available():
        return "spawn"
    count_devices()
    return "fork"


@cache
def count_devices() -> None:
    """Let autograd count devices now, where there is none: it does so at its first gradient, and once."""
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
    """Let this process end when the one that started it dies, however abruptly; a main process goes on."""
    if multiprocessing.parent_process() is None:
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)  # nobody is left to hear, and the environment may be in the middle of a step

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


_states: dict[str, Any] = {}
"""Of this process: what jobs of :func:`working` work on."""


def fresh_processes(count: int, env: Mapping[str, str] | None = None) -> Any:
    """A loky executor whose processes compute with one thread each, and end when this process ends.

    They are no forks: nothing of this process is in them. Ctrl-C is left to this process.
    """

    def begin(parent: int) -> None:
        # Sent by value, for it is defined here: Ctrl-C, or the end of this process, may come while the other
        # one imports this library, which takes seconds.
        import os
        import signal
        import sys
        import threading
        import time

        def watch() -> None:
            while os.getppid() == parent:
                time.sleep(0.2)
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # What a process keeps on purpose, such as demonstrations, is no leak to start it anew for.
        loky: Any = sys.modules["loky.process_executor"]
        loky._MAX_MEMORY_LEAK_SIZE = sys.maxsize

    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return require("loky", "sim").ProcessPoolExecutor(
        max_workers=count, env={**threads, **(env or {})}, initializer=begin, initargs=(os.getpid(),)
    )


@contextmanager
def working(count: int, state: Any) -> Iterator[Callable[[Callable[[Any], Any]], Future[Any]]]:
    """Processes that each hold a copy of a state; yields what submits ``job(state)``, both picklable.

    Leaving the context with an error ends all of them at once. A ``WorkerError`` if a process dies.
    """
    executor, name, pickled = fresh_processes(count), uuid.uuid4().hex, pickle.dumps(state)
    try:
        yield lambda job: executor.submit(_on_state, name, pickled, job)
    except BaseException as error:
        executor.shutdown(kill_workers=True)
        if isinstance(error, BrokenProcessPool):
            worker = f"one of {count} workers"
            raise worker_died(worker, "see above for its own error") from error
        raise
    executor.shutdown()


def _on_state(name: str, pickled: bytes, job: Callable[[Any], Any]) -> Any:
    if name not in _states:
        _states[name] = pickle.loads(pickled)
    return job(_states[name])


@contextmanager
def torch_threads(number: int | None) -> Iterator[None]:
    """Let PyTorch compute with as many threads (``None`` leaves them), and as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(number or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
