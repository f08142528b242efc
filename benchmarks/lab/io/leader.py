"""The first of several processes, where it goes on without the others."""

from __future__ import annotations

import torch.distributed as dist

from warmprior.io.distributed import rank, wait_for_leader


def go_on_alone() -> None:
    """End all processes but the first, which goes on as if it had been started alone."""
    ends = bool(rank())
    wait_for_leader()
    if dist.is_initialized():
        dist.destroy_process_group()
    if ends:
        raise SystemExit(0)
