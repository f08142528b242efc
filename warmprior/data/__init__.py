"""Demonstrations as one TensorDict of steps, from robomimic files and LeRobot and Minari datasets."""

from __future__ import annotations

from warmprior.data.checks import DatasetError
from warmprior.data.convert import convert_robomimic
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.in_memory import demonstrations_of
from warmprior.data.observe import observe_recordings
from warmprior.data.opening import open_demonstrations

__all__ = [
    "DatasetError",
    "Demonstrations",
    "convert_robomimic",
    "demonstrations_of",
    "observe_recordings",
    "open_demonstrations",
]
