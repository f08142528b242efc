"""Environments. robosuite is imported only when one of its environments is built."""

from __future__ import annotations

from warmprior.envs.description import environment_description, environment_of
from warmprior.envs.env_args import (
    absolute_actions,
    delta_conventions,
    modernize_env_args,
)
from warmprior.envs.gymnasium import gym_env, registered_env
from warmprior.envs.navigation1d import (
    NavigationEnv,
    NavigationMetrics,
    navigation_demonstrations,
    navigation_heights,
    navigation_metrics,
    navigation_positions,
)
from warmprior.envs.rendering import rendering_backend
from warmprior.envs.robosuite import RobosuiteEnv
from warmprior.envs.robosuite_tasks import TASKS, TaskSpec, get_task

__all__ = [
    "TASKS",
    "NavigationEnv",
    "NavigationMetrics",
    "RobosuiteEnv",
    "TaskSpec",
    "absolute_actions",
    "delta_conventions",
    "environment_description",
    "environment_of",
    "get_task",
    "gym_env",
    "modernize_env_args",
    "navigation_demonstrations",
    "navigation_heights",
    "navigation_metrics",
    "navigation_positions",
    "registered_env",
    "rendering_backend",
]
