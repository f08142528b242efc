"""Demonstrations as one TensorDict of steps, from robomimic files and LeRobot and Minari datasets."""

from __future__ import annotations

from warmprior.data.convert import convert_robomimic
from warmprior.data.lerobot import LeRobotDemonstrations
from warmprior.data.minari import MinariDemonstrations
from warmprior.data.observe import observe_recordings
from warmprior.data.replay import DatasetError
from warmprior.data.robomimic import RobomimicDemonstrations

__all__ = [
    "DatasetError",
    "LeRobotDemonstrations",
    "MinariDemonstrations",
    "RobomimicDemonstrations",
    "convert_robomimic",
    "observe_recordings",
]
