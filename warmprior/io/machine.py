"""The free memory of this machine."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import psutil

_CONTROL_GROUP = Path("/sys/fs/cgroup")


def available_memory() -> int:
    """Return the bytes that can be allocated before the system, or this process's container, runs out."""
    free = int(psutil.virtual_memory().available)
    # psutil does not know the limit of a container. There is none where these are missing or say "max".
    with contextlib.suppress(OSError, ValueError):
        limit = int((_CONTROL_GROUP / "memory.max").read_text())
        used = int((_CONTROL_GROUP / "memory.current").read_text())
        cache = re.search(r"^file (\d+)", (_CONTROL_GROUP / "memory.stat").read_text(), re.M)
        free = min(free, limit - used + (int(cache[1]) if cache else 0))
    return free
