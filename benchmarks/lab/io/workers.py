"""Fresh processes that compute with one thread each (loky)."""

from __future__ import annotations

import os
import pickle
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any
from unittest import mock

from warmprior.io.extras import require
from warmprior.io.workers import dead_worker_error


def available_cores() -> int:
    """Return the number of cores that this process may use; its container or `at_most` may limit them."""
    return int(require("loky", "sim").cpu_count())


@contextmanager
def at_most(cores: int | None) -> Iterator[None]:
    """Limit what `available_cores` returns in a block, here and in processes that start there."""
    with mock.patch.dict(os.environ, {} if cores is None else {"LOKY_MAX_CPU_COUNT": str(cores)}):
        yield


_states: dict[str, Any] = {}
"""States of :func:`working` in this process, by name."""


def fresh_processes(count: int, env: Mapping[str, str] | None = None) -> Any:
    """Return a loky executor whose processes compute with one thread each, and end with this process.

    They are not forked, and ignore Ctrl-C.
    """

    def begin(parent: int) -> None:
        # A local function is sent by value, so it runs before the process imports this library, which takes
        # seconds: Ctrl-C and the end of this process are handled from the start.
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
        # Processes cache data such as demonstrations; loky must not restart them for a memory leak.
        loky: Any = sys.modules["loky.process_executor"]
        loky._MAX_MEMORY_LEAK_SIZE = sys.maxsize

    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    # Where processes are killed, loky's tracker of resources may find some gone, and would print so last.
    quiet = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker")))
    with mock.patch.dict(os.environ, {"PYTHONWARNINGS": quiet}):
        return require("loky", "sim").ProcessPoolExecutor(
            max_workers=count, env={**threads, **(env or {})}, initializer=begin, initargs=(os.getpid(),)
        )


@contextmanager
def working(count: int, state: Any) -> Iterator[Callable[[Callable[[Any], Any]], Future[Any]]]:
    """Start processes with a copy of a state each; yield a function that submits ``job(state)``.

    State and jobs have to be picklable. An error in the context ends all processes at once.

    Raises:
        WorkerError: if a process dies.
    """
    executor, name, pickled = fresh_processes(count), uuid.uuid4().hex, pickle.dumps(state)
    try:
        yield lambda job: executor.submit(_on_state, name, pickled, job)
    except BaseException as error:
        executor.shutdown(kill_workers=True)
        if isinstance(error, BrokenProcessPool):
            worker = f"one of {count} workers"
            raise dead_worker_error(worker, "see its own error above") from error
        raise
    executor.shutdown()


def _on_state(name: str, pickled: bytes, job: Callable[[Any], Any]) -> Any:
    if name not in _states:
        _states[name] = pickle.loads(pickled)
    return job(_states[name])
