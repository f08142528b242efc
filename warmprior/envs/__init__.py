"""Environments. robosuite is imported only when one of its environments is built."""

from __future__ import annotations

from warmprior.envs.description import environment_description, environment_of
from warmprior.envs.env_args import (
    absolute_actions,
    absolute_to_env_action,
    delta_conventions,
    modernize_env_args,
)
from warmprior.envs.gymnasium import gym_env
from warmprior.envs.navigation1d import (
    NavigationEnv,
    NavigationMetrics,
    navigation_collides,
    navigation_demonstrations,
    navigation_heights,
    navigation_metrics,
    navigation_positions,
)
from warmprior.envs.navigation_goal import GoalNavigationEnv
from warmprior.envs.rendering import rendering_backend
from warmprior.envs.robosuite import RobosuiteEnv, RobosuiteWrapper
from warmprior.envs.tasks import TASKS, TaskSpec, get_task

__all__ = [
    "TASKS",
    "GoalNavigationEnv",
    "NavigationEnv",
    "NavigationMetrics",
    "RobosuiteEnv",
    "RobosuiteWrapper",
    "TaskSpec",
    "absolute_actions",
    "absolute_to_env_action",
    "delta_conventions",
    "environment_description",
    "environment_of",
    "get_task",
    "gym_env",
    "modernize_env_args",
    "navigation_collides",
    "navigation_demonstrations",
    "navigation_heights",
    "navigation_metrics",
    "navigation_positions",
    "rendering_backend",
]
