"""Demonstrations: files of robomimic and MimicGen, LeRobot's datasets, and scripted experts."""

from __future__ import annotations

from warmprior.data.convert import convert_robomimic
from warmprior.data.lerobot import LeRobotExperienceReplay, lerobot_steps
from warmprior.data.render import render_demonstrations
from warmprior.data.replay import DatasetError
from warmprior.data.robomimic import RobomimicExperienceReplay, download_robomimic
from warmprior.data.scripted.generate import generate_demonstrations

__all__ = [
    "DatasetError",
    "LeRobotExperienceReplay",
    "RobomimicExperienceReplay",
    "convert_robomimic",
    "download_robomimic",
    "generate_demonstrations",
    "lerobot_steps",
    "render_demonstrations",
]
