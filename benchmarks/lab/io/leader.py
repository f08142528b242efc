"""The first of several processes, where it goes on without the others."""

from __future__ import annotations

import torch.distributed as dist

from warmprior.io.distributed import from_leader, rank


def go_on_alone() -> None:
    """End all processes but the first, which goes on as if it had been started alone."""
    ends = bool(rank())
    from_leader(int)  # all have arrived
    if dist.is_initialized():
        dist.destroy_process_group()
    if ends:
        raise SystemExit(0)
