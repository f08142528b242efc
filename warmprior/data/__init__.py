"""Demonstrations: robomimic's files, scripted experts, and what they say of actions and tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from warmprior.data.download import download_robomimic
from warmprior.data.hdf5 import DatasetError
from warmprior.data.robomimic import RobomimicExperienceReplay
from warmprior.data.robomimic_env import (
    absolute_actions,
    absolute_to_env_action,
    delta_conventions,
    modernize_env_args,
)
from warmprior.data.rotation import rotation_6d_to_rotvec
from warmprior.data.tasks import TASKS, TaskSpec, get_task

if TYPE_CHECKING:
    from warmprior.data.scripted import generate_demonstrations

__all__ = [
    "TASKS",
    "DatasetError",
    "RobomimicExperienceReplay",
    "TaskSpec",
    "absolute_actions",
    "absolute_to_env_action",
    "delta_conventions",
    "download_robomimic",
    "generate_demonstrations",
    "get_task",
    "modernize_env_args",
    "rotation_6d_to_rotvec",
]


def __getattr__(name: str) -> Any:
    # The experts sit on top of the simulator, which reading files does not need.
    if name == "generate_demonstrations":
        from warmprior.data.scripted import generate_demonstrations

        return generate_demonstrations
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
