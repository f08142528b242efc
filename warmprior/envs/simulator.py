"""Access to robosuite: a quiet import, isolated seeding and one way to build an environment."""

from __future__ import annotations

import contextlib
import copy
import logging
import random
import warnings
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

import numpy as np

from warmprior.envs.mimicgen import is_mimicgen, register_mimicgen
from warmprior.envs.robosuite_tasks import get_task
from warmprior.io.extras import require

# Sizes drawn when a model is loaded (Lift's cube, Transport's hammer) must be the same in every
# process, or the same seed would mean different episodes.
_MODEL_SEED = 0
_ARM_CONTROLLER = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping_ratio": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_ratio_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "input_type": "delta",
    "input_ref_frame": "world",
    "interpolation": None,
    "ramp_ratio": 0.2,
    "gripper": {"type": "GRIP"},
}


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Suppress warnings (not errors), because robosuite logs five about optional parts when imported."""
    before = logging.root.manager.disable
    logging.disable(max(before, logging.WARNING))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def import_robosuite() -> ModuleType:
    """Import ``robosuite`` without its start-up warnings."""
    with _without_warnings():
        return require("robosuite", "sim")


@contextlib.contextmanager
def isolated_numpy_seed(seed: int) -> Iterator[None]:
    """Seed the global generators that robosuite's samplers use; they are restored afterwards."""
    numpy_state, python_state = np.random.get_state(), random.getstate()
    np.random.seed(seed % 2**32)
    random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(numpy_state)
        random.setstate(python_state)


def task_env_args(task: str) -> dict[str, Any]:
    """Describe a task's environment as the ``env_args`` of a robomimic file, which JSON can hold.

    Every option that changes what an action means is written out.
    """
    spec = get_task(task)
    kwargs: dict[str, Any] = {
        "has_renderer": False,
        "has_offscreen_renderer": False,
        "ignore_done": True,
        "use_object_obs": True,
        "use_camera_obs": False,
        "control_freq": 20,
        "robots": ["Panda"] * spec.arms,
        "camera_depths": False,
        "camera_heights": 84,
        "camera_widths": 84,
        "lite_physics": True,
        "reward_shaping": False,
        "controller_configs": {"type": "BASIC", "body_parts": {"right": copy.deepcopy(_ARM_CONTROLLER)}},
    }
    if is_mimicgen(spec.env_name):
        del kwargs["lite_physics"]  # some of MimicGen's tasks reject the argument
    if spec.arms == 2:
        kwargs["env_configuration"] = "opposed"
    return {"env_name": spec.env_name, "env_version": "1.5.1", "type": 1, "env_kwargs": kwargs}


def make_simulator(env_args: Mapping[str, Any]) -> Any:
    """Make a robosuite environment for stepping: no renderer, no time limit, cheap resets.

    Frames are rendered on demand elsewhere, and time limits belong to the wrapper.
    """
    robosuite = import_robosuite()
    name = env_args["env_name"]
    if name not in robosuite.ALL_ENVIRONMENTS and is_mimicgen(name):
        with _without_warnings():
            register_mimicgen()
    if name not in robosuite.ALL_ENVIRONMENTS:
        names = ", ".join(sorted(robosuite.ALL_ENVIRONMENTS))
        raise ImportError(
            f"robosuite has no environment {name!r}: import its package first, or write type=2 in env_args "
            f"for an environment of Gymnasium's; it has {names}"
        )
    kwargs = dict(env_args["env_kwargs"])
    kwargs.update(
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
        hard_reset=False,
        renderer="mujoco",  # the default starts an interactive viewer
    )
    with _without_warnings(), isolated_numpy_seed(_MODEL_SEED):
        return robosuite.make(name, **kwargs)


def scene_stays(env: Any) -> bool:
    """Return False if a simulator moves fixtures at resets, which are not part of its state.

    Afterwards its model holds the scene without the grippers' markers, which no episode shows.
    """
    placed = []
    with isolated_numpy_seed(0):
        for _ in range(2):
            env.reset()
            model = env.sim.model._model
            placed.append(np.concatenate([model.body_pos, model.body_quat], -1))
    return np.array_equal(*placed)


def action_limits(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each entry of an environment's action, each ``[d_a]``.

    For absolute targets they only bound random samples: joints by their range in radians, poses by two metres
    and half a turn.
    """
    limits = []
    for robot in env.robots:
        composite = robot.composite_controller
        low, high = (np.array(ends, np.float64) for ends in composite.action_limits)
        for part, (first, last) in composite._action_split_indexes.items():
            controller = composite.part_controllers.get(part)
            if getattr(controller, "input_type", "delta") == "absolute":
                target = np.array([2.0] * 3 + [np.pi] * 3)
                if controller.name == "JOINT_POSITION":
                    ranges = env.sim.model.jnt_range[controller.joint_index]
                    limited = env.sim.model.jnt_limited[controller.joint_index]
                    target = np.where(limited, np.abs(ranges).max(-1), np.pi)
                # Positions stand first, or gains before them.
                target = target[: last - first]
                low[last - len(target) : last], high[last - len(target) : last] = -target, target
        limits.append((low, high))
    low, high = map(np.concatenate, zip(*limits, strict=True))
    return low, high
