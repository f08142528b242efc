"""Demonstrations: files of robomimic and MimicGen, LeRobot's datasets, and scripted experts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from warmprior.data.convert import convert_robomimic
from warmprior.data.download import download_lerobot, download_mimicgen, download_robomimic
from warmprior.data.hdf5 import DatasetError
from warmprior.data.lerobot import LeRobotExperienceReplay, lerobot_steps
from warmprior.data.mimicgen import MimicGenExperienceReplay
from warmprior.data.robomimic import RobomimicExperienceReplay

if TYPE_CHECKING:
    from warmprior.data.render import render_demonstrations
    from warmprior.data.scripted import generate_demonstrations

__all__ = [
    "DatasetError",
    "LeRobotExperienceReplay",
    "MimicGenExperienceReplay",
    "RobomimicExperienceReplay",
    "convert_robomimic",
    "download_lerobot",
    "download_mimicgen",
    "download_robomimic",
    "generate_demonstrations",
    "lerobot_steps",
    "render_demonstrations",
]


def __getattr__(name: str) -> Any:
    # They sit on top of the simulator, which reading files does not need.
    if name == "generate_demonstrations":
        from warmprior.data.scripted import generate_demonstrations

        return generate_demonstrations
    if name == "render_demonstrations":
        from warmprior.data.render import render_demonstrations

        return render_demonstrations
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
