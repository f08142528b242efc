"""A task of the demonstrations in a file, played in the simulator that recorded them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.data.demonstrations import Demonstrations
from warmprior.data.images import check_images
from warmprior.data.replay import DatasetIndex, DemonstrationReplay
from warmprior.envs.description import environment_description, robosuite_parts
from warmprior.envs.simulator import task_env_args
from warmprior.envs.tasks import TASKS
from warmprior.keys import ACTION, OBSERVATION, STATE
from warmprior.modules.normalize import Normalizer, bound_of
from warmprior.modules.trend import RestingPose
from warmprior.transforms.absolute_actions import AbsoluteActions


def opened(place: Path | str, task: str | None = None, mask: str | None = None) -> Demonstrations:
    """Open the demonstrations at a place, with the task's environment if they do not describe one."""
    return Demonstrations(place, task_env_args(task) if task in TASKS else None, mask)


def task_name(dataset: DemonstrationReplay | DatasetIndex) -> str:
    """Return the short name of a dataset's task, or its environment's name if no task has it."""
    task = dataset.task
    return str(dataset.env_args["env_name"]).lower() if task is None else task.name


def image_names(cameras: Sequence[str]) -> list[str]:
    """Return the names of the cameras' images in files."""
    return [f"{camera}_image" for camera in cameras]


def recorded_task(
    dataset: DemonstrationReplay, images: Mapping[str, Any] | None, **options: Any
) -> dict[str, Any]:
    """Return data, environment and units of demonstrations in robosuite, as arguments of :class:`Task`.

    The options are those of :func:`~warmprior.envs.environment_description`.
    """
    low_dim_keys = None
    if images is None and (dataset.task is None or dataset.observation_keys != dataset.task.low_dim_keys):
        low_dim_keys = dataset.observation_keys
    options |= {"images": images, "low_dim_keys": low_dim_keys}
    description = environment_description(dataset.env_args, **options)
    make_env, adapters = robosuite_parts(description)
    # Poses in the units of deltas: errors and sigma have the same meaning in both spaces, and the loss does
    # not give positions, whose range is large, little weight compared with the gripper.
    absolute = adapters.get("actions")
    units = {ACTION: absolute.one_step} if isinstance(absolute, AbsoluteActions) else None
    vector = OBSERVATION if images is None else (OBSERVATION, STATE)
    normalizer = Normalizer.fit(dataset.data, (vector, ACTION), units=units)
    data = normalizer.normalize(dataset.data.exclude("next"))
    return {
        "data": data,
        "make_env": make_env,
        "normalizer": normalizer,
        "adapters": adapters,
        "rest": None if absolute is None else RestingPose(dataset.pose_columns, normalizer),
        "clip": bound_of(data[ACTION]),
        "environment": description,
    }


def read_steps(
    demonstrations: Demonstrations,
    *,
    absolute_actions: bool = False,
    observation_keys: Sequence[str] | None = None,
    cameras: Sequence[str] = (),
    fast_rendering: bool = False,
    demos: int | None = None,
) -> tuple[DemonstrationReplay, dict[str, Any] | None]:
    """Return the demonstrations as policies see them, and the options of their images, if any."""
    if not cameras:
        options: Mapping[str, Any] = {"absolute_actions": absolute_actions}
        return demonstrations.replay(**options, observation_keys=observation_keys, demos=demos), None
    if absolute_actions:
        raise ValueError("images go with pose deltas: leave out actions='absolute', or the cameras")
    check_images(demonstrations, cameras, fast_rendering)
    # As in robomimic, image policies also see the robot's state, but not that of the objects.
    vector = [key for key in demonstrations.index(demos=demos).observation_keys if key != "object"]
    vector = vector if observation_keys is None else list(observation_keys)
    names = image_names(cameras)
    dataset = demonstrations.replay(observation_keys=vector, image_keys=names, storage="memmap", demos=demos)
    return dataset, {
        "cameras": list(cameras),
        "size": dataset.image_size,
        "fast_rendering": fast_rendering,
        "low_dim_keys": vector,
    }
