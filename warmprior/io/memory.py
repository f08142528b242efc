"""How much memory may still be taken."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["available_memory"]

_CONTROL_GROUP = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Bytes that can be taken before the system, or this process's container, runs out.

    Returns:
        The lesser of both, or ``None`` where neither says (outside Linux).

    Examples:
        >>> free = available_memory()
        >>> free is None or free > 0
        True
    """
    found: list[int] = []
    try:
        text = Path("/proc/meminfo").read_text()
        found += [1024 * int(kib) for kib in re.findall(r"MemAvailable:\s+(\d+) kB", text)]
        limit = (_CONTROL_GROUP / "memory.max").read_text().strip()
        if limit != "max":
            used = int((_CONTROL_GROUP / "memory.current").read_text())
            cache = re.search(r"^file (\d+)", (_CONTROL_GROUP / "memory.stat").read_text(), re.M)
            found.append(int(limit) - used + (int(cache[1]) if cache else 0))
    except (OSError, ValueError):
        pass  # no such file outside Linux and outside a container
    return min(found, default=None)
