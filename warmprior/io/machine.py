"""What this machine is, and how much of its memory is free."""

from __future__ import annotations

import contextlib
import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil
import torch

_CONTROL_GROUP = Path("/sys/fs/cgroup")

PACKAGES = ("warmprior", "torch", "torchrl", "tensordict", "robosuite", "mujoco", "numpy", "lerobot")


def facts_of_machine(**more: Any) -> dict[str, Any]:
    """Versions and hardware, as files of results keep them."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue  # an extra that this run does without
    hardware = {"machine": platform.machine(), "cores": os.cpu_count(), **more}
    if torch.cuda.is_available():
        hardware["gpu"] = torch.cuda.get_device_name()
    return {"versions": versions, "hardware": hardware}


def available_memory() -> int:
    """Bytes that can be taken before the system, or this process's container, runs out."""
    free = int(psutil.virtual_memory().available)
    # psutil does not know the limit of a container. There is none where these are missing or say "max".
    with contextlib.suppress(OSError, ValueError):
        limit = int((_CONTROL_GROUP / "memory.max").read_text())
        used = int((_CONTROL_GROUP / "memory.current").read_text())
        cache = re.search(r"^file (\d+)", (_CONTROL_GROUP / "memory.stat").read_text(), re.M)
        free = min(free, limit - used + (int(cache[1]) if cache else 0))
    return free
