"""Demonstrations as one TensorDict of steps: files of robomimic and MimicGen, and LeRobot's datasets."""

from __future__ import annotations

from warmprior.data.convert import convert_robomimic
from warmprior.data.lerobot import LeRobotExperienceReplay, lerobot_steps
from warmprior.data.replay import DatasetError
from warmprior.data.robomimic import RobomimicExperienceReplay

__all__ = [
    "DatasetError",
    "LeRobotExperienceReplay",
    "RobomimicExperienceReplay",
    "convert_robomimic",
    "lerobot_steps",
]
