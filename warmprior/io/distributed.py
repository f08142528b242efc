"""Processes that train together, as ``torchrun`` starts them: who is who, and who waits for whom."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from warmprior.io.workers import WorkerError, stop_forking

__all__ = [
    "check_batch",
    "check_device",
    "from_leader",
    "go_on_alone",
    "joined",
    "launched",
    "leader_first",
    "mean_over_processes",
    "process_group",
    "rank",
    "world_size",
]

STEP = timedelta(minutes=10)
"""How long the others may take to arrive where gradients are averaged."""

PATIENCE = timedelta(days=2)
"""How long the first process may take to generate, render or learn what the others wait for."""

_waiting: dist.ProcessGroup | None = None
"""The group in which processes wait for each other; always of the CPU."""


def launched() -> bool:
    """Whether ``torchrun`` started this process as one of several.

    See Also:
        :func:`~warmprior.io.distributed.joined`: joins them.

    Examples:
        >>> from unittest.mock import patch
        >>> told = {"RANK": "0", "LOCAL_RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "localhost"}
        >>> with patch.dict(os.environ, told):  # as torchrun does
        ...     launched()
        True
        >>> with patch.dict(os.environ, told | {"WORLD_SIZE": "1"}):
        ...     launched()
        False
    """
    names = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR")
    return all(name in os.environ for name in names) and int(os.environ["WORLD_SIZE"]) > 1


def world_size() -> int:
    """How many processes train together: 1 unless this one has :func:`joined` others.

    Examples:
        >>> 256 // world_size()  # windows per process; here there is one
        256
    """
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """The number of this process among them. The first, 0, is the one that writes and prints.

    See Also:
        :func:`~warmprior.io.distributed.world_size`: how many there are.

    Examples:
        >>> if not rank():
        ...     print("trained")  # by the first of several processes alone
        trained
    """
    return dist.get_rank() if dist.is_initialized() else 0


@contextmanager
def joined() -> Iterator[None]:
    """Join the processes that ``torchrun`` started, if it did, and leave them at the end.

    Gradients on a CPU are averaged by gloo, those on GPUs by NCCL. Workers that are started from here on are
    started afresh: the threads of a group do not survive a fork.

    Raises:
        WorkerError: if another process ended, or did not arrive within ten minutes.

    See Also:
        - :func:`~warmprior.io.distributed.launched`: whether there is anything to join.
        - :func:`~warmprior.io.distributed.process_group`: tells errors of the group as what they are.

    Examples:
        >>> with joined():  # started without torchrun
        ...     world_size(), rank()
        (1, 0)
    """
    global _waiting
    if not launched():
        yield
        return
    local, devices = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if local < devices:
        torch.cuda.set_device(local)  # "cuda" is this one from here on
    stop_forking()
    with process_group():
        dist.init_process_group("cpu:gloo,cuda:nccl" if devices else "gloo", timeout=STEP)
        _waiting = dist.new_group(backend="gloo", timeout=PATIENCE)
    try:
        yield
    finally:
        _leave()


def _wait() -> None:
    """For all others."""
    with process_group():
        dist.barrier(_waiting)


def _leave() -> None:
    global _waiting
    _waiting = None
    if dist.is_initialized():
        dist.destroy_process_group()


@contextmanager
def process_group() -> Iterator[None]:
    """Tell the errors of a group whose other processes are gone as what they are.

    Raises:
        WorkerError: instead of them.

    See Also:
        :func:`~warmprior.io.distributed.joined`: starts the group.

    Examples:
        >>> with process_group():
        ...     raise RuntimeError("[gloo] Connection closed by peer")
        Traceback (most recent call last):
            ...
        warmprior.io.workers.WorkerError: another of the processes that train together has ended, ...
        >>> with process_group():
        ...     raise RuntimeError("any other error")
        Traceback (most recent call last):
            ...
        RuntimeError: any other error
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, dist.DistError) and "gloo" not in str(error).lower():
            raise
        raise WorkerError(
            "another of the processes that train together has ended, or does not answer: see its own error. "
            "What is finished and the last state are kept; start all of them again with --resume"
        ) from error


@contextmanager
def leader_first() -> Iterator[None]:
    """Let the first process do something before the others, which find it done.

    Raises:
        FloatingPointError: in all, if that is what it led to in the first: such failures end a training, and
            not the run.
        ValueError: likewise.
        SystemExit: in the others, if it failed otherwise in the first, which tells why.
        WorkerError: if the first process ended meanwhile.

    See Also:
        :func:`~warmprior.io.distributed.from_leader`: where the others need the result.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "data.txt"
        ...     with leader_first():  # what it writes is there for the others
        ...         if not path.exists():
        ...             _ = path.write_text("generated")
        ...     path.read_text()
        'generated'
    """
    told: list[Any] = [None]
    if not rank():
        try:
            yield
        except BaseException as error:
            told = [
                (
                    next((n for n, kind in _SHARED.items() if isinstance(error, kind)), ""),
                    str(error),
                )
            ]
            raise
        finally:
            if world_size() > 1:
                with process_group():
                    dist.broadcast_object_list(told, 0, _waiting)
        return
    with process_group():
        dist.broadcast_object_list(told, 0, _waiting)
    if told[0] is not None:
        kind, text = told[0]
        raise _SHARED[kind](text) if kind else SystemExit(2)
    yield


_SHARED: dict[str, type[Exception]] = {"number": FloatingPointError, "value": ValueError}
"""Errors that :func:`leader_first` raises in all processes."""


def from_leader[T](make: Callable[[], T]) -> T:
    """What the first process makes of something that the others must not, or might not, make alike.

    Args:
        make: called by the first process; its result has to be picklable.

    Raises:
        SystemExit: in the others, if it fails in the first, which tells why.
        WorkerError: if the first process ended meanwhile.

    See Also:
        :func:`~warmprior.io.distributed.leader_first`: where each makes, or finds, its own.

    Examples:
        >>> from_leader(lambda: 3)
        3
    """
    if world_size() == 1:
        return make()
    told: list[Any] = [None, False]
    try:
        if not rank():
            told = [make(), True]
    finally:
        with process_group():
            dist.broadcast_object_list(told, 0, _waiting)
    if not told[1]:
        raise SystemExit(2)
    return told[0]


def go_on_alone() -> None:
    """Let the first process go on as if it had been started alone, and the others end.

    Raises:
        SystemExit: in the others, with success.

    See Also:
        :func:`~warmprior.io.distributed.joined`: the group that ends.

    Examples:
        >>> with joined():
        ...     go_on_alone()  # of several processes the others end here
        ...     world_size()
        1
    """
    if world_size() == 1:
        return
    ends = bool(rank())
    _wait()
    _leave()
    if ends:
        raise SystemExit(0)


def mean_over_processes(value: Tensor) -> Tensor:
    """The mean of what every process has, in place.

    Args:
        value: of one shape everywhere.

    See Also:
        :func:`~warmprior.io.distributed.from_leader`: what one process knows.

    Examples:
        >>> mean_over_processes(torch.tensor(3.0))
        tensor(3.)
    """
    if world_size() > 1:
        dist.all_reduce(value)
        value /= world_size()
    return value


def check_batch(size: int) -> None:
    """Whether a batch can be divided among the processes.

    Args:
        size: windows per step, of all processes.

    Raises:
        ValueError: if it cannot.

    See Also:
        :class:`~warmprior.training.BehaviourCloning`: shares its batches out.

    Examples:
        >>> check_batch(256)
        >>> check_batch(0)
        Traceback (most recent call last):
            ...
        ValueError: --batch-size 0 cannot be divided among 1 process(es): choose a multiple of 1
    """
    count = world_size()
    if size < count or size % count:
        raise ValueError(
            f"--batch-size {size} cannot be divided among {count} process(es): choose a multiple of {count}"
        )


def check_device(device: str) -> None:
    """Whether every process here has a device of a name, and it computes.

    Args:
        device: such as ``"cuda"``; of several processes each then takes one of its own.

    Raises:
        ValueError: naming ``--device`` and what there is instead.

    See Also:
        :func:`~warmprior.io.distributed.joined`: the processes that share the devices.

    Examples:
        >>> check_device("cpu")
    """
    try:
        kind, index = torch.device(device).type, torch.device(device).index
        if kind == "cuda" and torch.cuda.is_available():
            devices = torch.cuda.device_count()
            local = int(os.environ.get("LOCAL_WORLD_SIZE", 1)) if launched() else 1
            if launched() and index is not None:
                raise ValueError(
                    f"--device {device}: under torchrun every process takes a GPU of its own: --device cuda"
                )
            if local > devices:
                raise ValueError(
                    f"--device {device}: {local} processes on a machine with {devices} CUDA device(s): start "
                    f"torchrun with --nproc-per-node {devices}"
                )
            if index is not None and index >= devices:
                known = ", ".join(f"cuda:{i}" for i in range(devices))
                raise ValueError(f"--device {device} does not work here: there is {known}")
        # Computed and read: there are devices that can only be named, such as meta.
        torch.ones(1, device=device).add(1).item()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"--device {device} does not work here: {reason}") from error
