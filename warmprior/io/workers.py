"""Processes and threads that compute: how they start, and that they end with whoever started them."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

_forks = True


class WorkerError(RuntimeError):
    """A worker process died, or cannot do the work.

    Examples:
        >>> from warmprior.evaluation import WorkerError
        >>> raise WorkerError("worker 0 of 2 (exit code 9) died")
        Traceback (most recent call last):
            ...
        warmprior.io.workers.WorkerError: worker 0 of 2 (exit code 9) died
    """


def dead_worker_error(worker: str, advice: str, code: int | None = None) -> WorkerError:
    """Return the error with the worker that died, the likely reason by its exit code, and advice."""
    if code is not None and code > 0:
        return WorkerError(f"{worker} died of an error of its own: {advice}.")
    return WorkerError(
        f"{worker} died. It may have been killed for lack of memory; use fewer workers, or {advice}."
    )


def start_method() -> str:
    """Return the method to start workers: forking, which takes a second instead of a minute, if possible.

    Autograd does not work in a fork of a process that used it if there is a GPU.
    """
    import torch

    if not _forks or torch.cuda.is_available():
        return "spawn"
    count_devices()
    return "fork"


@cache
def count_devices() -> None:
    """Let autograd count devices now, where there is none: it does so at its first gradient, and once."""
    import torch

    torch.ones((), requires_grad=True).backward()


def stop_forking() -> None:
    """Let this process start further workers afresh: it holds something that does not survive a fork."""
    global _forks
    _forks = False


def end_with_parent(parent: int) -> None:
    """Let this process end when the one that started it dies, however abruptly; ``parent`` itself goes on.

    Ctrl-C, which a terminal sends to all processes, is left to the one that started it.
    """
    if os.getpid() == parent:
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)  # nobody is left to hear, and the environment may be in the middle of a step

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


@contextmanager
def torch_threads(number: int | None) -> Iterator[None]:
    """Let PyTorch compute with as many threads (``None`` leaves them), and as before afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(number or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
