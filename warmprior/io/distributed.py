"""Processes that train together, as ``torchrun`` starts them: who is who, and who waits for whom."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from warmprior.io.workers import stop_forking

if TYPE_CHECKING:
    import torch.distributed as dist

STEP = timedelta(minutes=10)
"""How long the others may take to arrive where gradients are averaged."""

PATIENCE = timedelta(days=2)
"""How long the first process may take to generate, render or learn what the others wait for."""

_waiting: dist.ProcessGroup | None = None
"""The group in which processes wait for each other; always of the CPU."""


def launched() -> bool:
    """Return True if ``torchrun`` started this process as one of several."""
    names = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR")
    return all(name in os.environ for name in names) and int(os.environ["WORLD_SIZE"]) > 1


def world_size() -> int:
    """Return the number of processes that train together: 1 unless this one has :func:`joined` others."""
    return _joined().get_world_size() if _joined() else 1


def rank() -> int:
    """Return this process's number. Process 0 is the leader: only it writes and prints."""
    return _joined().get_rank() if _joined() else 0


def _joined() -> Any:
    """Return the module of joined processes, or ``None``; a process alone need not import PyTorch to know."""
    module = sys.modules.get("torch.distributed")
    return module if module is not None and module.is_initialized() else None


@contextmanager
def joined() -> Iterator[None]:
    """Join the processes that ``torchrun`` started, if it did, and leave them at the end.

    Gradients on a CPU are averaged by gloo, those on GPUs by NCCL.

    Examples:
        >>> from warmprior.io.distributed import joined, rank, world_size
        >>> with joined():  # started without torchrun
        ...     world_size(), rank()
        (1, 0)
    """
    global _waiting
    if not launched():
        yield
        return
    import torch
    import torch.distributed as dist

    local, devices = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if local < devices:
        torch.cuda.set_device(local)  # "cuda" is this one from here on
    stop_forking()
    dist.init_process_group("cpu:gloo,cuda:nccl" if devices else "gloo", timeout=STEP)
    _waiting = dist.new_group(backend="gloo", timeout=PATIENCE)
    try:
        yield
    finally:
        if dist.is_initialized():  # and not left already
            dist.destroy_process_group()


def from_leader[T](make: Callable[[], T]) -> T:
    """Let the first process make something for all of them, which has to be picklable.

    If it fails there, which the first process reports, the others get a ``SystemExit``.

    Examples:
        >>> from warmprior.io.distributed import from_leader
        >>> from_leader(lambda: 3)
        3
    """
    if world_size() == 1:
        return make()
    import torch.distributed as dist

    made: list[T] = []
    try:
        if not rank():
            made.append(make())
    finally:
        parcel = [made]
        dist.broadcast_object_list(parcel, 0, _waiting)
    if not parcel[0]:
        raise SystemExit(2)
    return parcel[0][0]


def wait_for_leader() -> None:
    """Wait until the first process has come as far as this one."""
    from_leader(lambda: None)


@contextmanager
def leader_first() -> Iterator[None]:
    """Run a block in the first process, and afterwards in the others, which find the work done.

    A ``FloatingPointError`` or ``ValueError`` of the first process is raised in all, because it ends only a
    training. After any other error, which the first process reports, the others raise ``SystemExit``.
    """
    failure: BaseException | None = SystemExit(2)
    try:
        if not rank():
            yield
            failure = None
    except (FloatingPointError, ValueError) as error:
        kind = FloatingPointError if isinstance(error, FloatingPointError) else ValueError
        failure = kind(str(error))
        raise
    finally:
        failure = from_leader(lambda: failure)
    if rank():
        if failure is not None:
            raise failure
        yield


def check_batch(size: int) -> None:
    """Raise ValueError for a batch, of all processes together, that cannot be divided among them.

    Examples:
        >>> from warmprior.io.distributed import check_batch
        >>> check_batch(0)
        Traceback (most recent call last):
            ...
        ValueError: batch_size must be a multiple of the 1 process(es), got 0
    """
    count = world_size()
    if size < count or size % count:
        raise ValueError(f"batch_size must be a multiple of the {count} process(es), got {size}")
