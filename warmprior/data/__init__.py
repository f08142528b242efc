"""Demonstrations: robomimic's files, their download, and what they say about actions and tasks."""

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

__all__ = [
    "TASKS",
    "DatasetError",
    "RobomimicExperienceReplay",
    "TaskSpec",
    "absolute_actions",
    "absolute_to_env_action",
    "delta_conventions",
    "download_robomimic",
    "get_task",
    "modernize_env_args",
    "rotation_6d_to_rotvec",
]
