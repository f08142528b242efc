"""Demonstrations as one TensorDict of steps, from robomimic files and LeRobot and Minari datasets."""

from __future__ import annotations

from warmprior.data.convert import convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.minari import MinariDemonstrations
from warmprior.data.observe import observe_recordings
from warmprior.data.replay import DatasetError

__all__ = [
    "DatasetError",
    "LeRobotDemonstrations",
    "MinariDemonstrations",
    "RobomimicDemonstrations",
    "convert_robomimic",
    "observe_recordings",
]
