"""What computed a result: versions and hardware."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

__all__ = ["facts_of_machine"]

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
