"""The environments in which demonstrations were recorded, by their kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from warmprior.checks import given
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.image_check import check_images, renderer_versions
from warmprior.data.index import DatasetIndex
from warmprior.envs.description import environment_description, registered_description, robosuite_parts
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.gymnasium import registered_builder
from warmprior.io.files import digest_of
from warmprior.keys import ACTION
from warmprior.options.data import Actions
from warmprior.tasks.task import Play, RecordedEnvironment


def _robosuite(
    demonstrations: Demonstrations,
    index: DatasetIndex,
    env_args: Mapping[str, Any],
    observations: Sequence[str] | None,
    images: Sequence[str],
    *,
    actions: Actions,
    play: Play,
) -> RecordedEnvironment:
    task = demonstrations.task
    if task is not None and task not in (index.task_name, env_args):
        raise ValueError(
            f"{demonstrations} holds demonstrations of {index.task_name}, not of {task}: correct the task"
        )
    if images and actions == "absolute":
        raise ValueError("images go with pose deltas: leave out actions='absolute', or the images")
    pictured, low_dim_keys, style = None, None, demonstrations.style or "ph"
    if images:
        # As in robomimic, image policies also see the robot's state, but not that of the objects.
        robot = [key for key in index.observation_keys if key != "object"]
        index = demonstrations.index(robot if observations is None else observations, images)
        check_images(demonstrations, index, play.fast_rendering)
        pictured = {
            "cameras": [key.removesuffix("_image") for key in index.image_keys],
            "size": index.image_size,
            "rendered": [list(shape) for shape in index.image_shapes],
            "resize": index.resize,
            "fast_rendering": play.fast_rendering,
            "low_dim_keys": list(index.observation_keys),
        }
    elif index.task is None or index.observation_keys != index.task.low_dim_keys:
        low_dim_keys = index.observation_keys
    description = environment_description(
        modernize_env_args(env_args),
        style,
        actions,
        pictured,
        low_dim_keys=low_dim_keys,
        horizon=play.horizon,
    )
    make_env, adapters = robosuite_parts(description)
    # Poses in the units of deltas: errors and sigma have the same meaning in both spaces, and the loss does
    # not give positions, whose range is large, little weight compared with the gripper.
    absolute: Any = adapters.get("actions")
    demos = None if index.whole else list(index.demos)
    sha256 = demonstrations.digest(index)
    # The default is left out.
    space: dict[str, Any] = {} if actions == "delta" else {"actions": actions}
    space |= {} if pictured is None else {"obs": "image", "images": pictured}
    space |= {} if observations is None else {"observation_keys": list(observations)}
    return RecordedEnvironment(
        index,
        index.task_name,
        style,
        make_env,
        description,
        adapters,
        units=None if absolute is None else {ACTION: absolute.one_step},
        poses=None if absolute is None else index.pose_columns,
        facts={"sha256": sha256, **space},
        # Images depend on the installed renderer.
        digest=digest_of(sha256, demos, space, pictured and renderer_versions()),
    )


def _gymnasium(
    demonstrations: Demonstrations,
    index: DatasetIndex,
    environment: Mapping[str, Any],
    observations: Sequence[str] | None,
    images: Sequence[str],
    *,
    play: Play,
    **_: Any,
) -> RecordedEnvironment | None:
    if images:
        return None
    environment = {**environment, "observation_keys": list(index.observation_keys)}
    environment |= given(max_episode_steps=play.horizon)
    return RecordedEnvironment(
        index,
        demonstrations.title,
        demonstrations.style or "human",
        # Unknown wrappers raise an error only when it is built, which training does not need.
        registered_builder(environment),
        registered_description(environment),
    )


KINDS: dict[str, Callable[..., RecordedEnvironment | None]] = {
    "robosuite": _robosuite,
    "gymnasium": _gymnasium,
}
"""The environments that formats name, see :meth:`Demonstrations.environment`."""
