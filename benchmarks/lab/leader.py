"""Work that the first of several processes does for all of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as dist

from warmprior.io.distributed import from_leader, rank


@contextmanager
def leader_first() -> Iterator[None]:
    """Run a block in the first process, and afterwards in the others, which find the work done.

    A `FloatingPointError` or `ValueError` of the first process is raised in all, because it ends only a
    training. After any other error, which the first process reports, the others raise `SystemExit`.
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


def go_on_alone() -> None:
    """End all processes but the first, which goes on as if it had been started alone."""
    ends = bool(rank())
    from_leader(int)  # all have arrived
    if dist.is_initialized():
        dist.destroy_process_group()
    if ends:
        raise SystemExit(0)
