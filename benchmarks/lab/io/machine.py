"""Description of the machine, and the check of a device."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from warmprior import checks
from warmprior.io.distributed import launched

PACKAGES = ("warmprior", "torch", "torchrl", "tensordict", "robosuite", "mujoco", "numpy", "lerobot")


def facts_of_machine(**more: Any) -> dict[str, Any]:
    """Return versions and hardware, which files of results keep."""
    import torch

    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue  # an optional package that is not installed
    hardware = {"machine": platform.machine(), "cores": os.cpu_count(), **more}
    if torch.cuda.is_available():
        hardware["gpu"] = torch.cuda.get_device_name()
    return {"versions": versions, "hardware": hardware}


def check_device(device: str) -> None:
    """Raise ValueError if a device, such as ``"cuda"``, is missing for a process or does not work."""
    import torch

    if device.startswith("cuda") and launched():
        local, devices = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
        if device != "cuda":
            raise ValueError(
                f"--device {device}: under torchrun every process takes its own GPU: write --device cuda"
            )
        if local > devices:
            raise ValueError(
                f"--device {device}: {local} processes on a machine with {devices} CUDA device(s): start "
                f"torchrun with --nproc-per-node {devices}"
            )
    checks.check_device(device)
