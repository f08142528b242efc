"""The first of several processes generates or downloads for all of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as dist

from warmprior.io.distributed import from_leader, rank


@contextmanager
def leader_first() -> Iterator[None]:
    """Let the first process do something before the others, which find it done.

    If that ends in a `FloatingPointError` or `ValueError`, which end a training and not the run, all get it.
    After any other error, which the first process reports, the others get a `SystemExit`.
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
    """Let the first process go on as if it had been started alone, and the others end, with success."""
    ends = bool(rank())
    from_leader(int)  # all have arrived
    if dist.is_initialized():
        dist.destroy_process_group()
    if ends:
        raise SystemExit(0)
