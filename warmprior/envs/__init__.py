"""Environments. robosuite is imported only when one of its environments is built."""

from __future__ import annotations

from warmprior.envs.description import environment_description, environment_of
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

__all__ = [
    "GoalNavigationEnv",
    "NavigationEnv",
    "NavigationMetrics",
    "RobosuiteEnv",
    "RobosuiteWrapper",
    "environment_description",
    "environment_of",
    "navigation_collides",
    "navigation_demonstrations",
    "navigation_heights",
    "navigation_metrics",
    "navigation_positions",
    "rendering_backend",
]
