"""Small robomimic files with known contents."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from warmprior.envs.simulator import task_env_args
from warmprior.envs.tasks import get_task

OSC_14 = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "control_delta": True,
    "interpolation": None,
    "ramp_ratio": 0.2,
}
"""The controller as files of robosuite 1.4 describe it."""

WIDTHS = {"eef_pos": 3, "eef_quat": 4, "gripper_qpos": 2}


def env_args_14(task: str) -> dict[str, Any]:
    """The ``env_args`` of a robomimic file recorded with robosuite 1.4."""
    spec = get_task(task)
    kwargs: dict[str, Any] = {
        "has_renderer": False,
        "has_offscreen_renderer": False,
        "ignore_done": True,
        "use_object_obs": True,
        "use_camera_obs": False,
        "control_freq": 20,
        "controller_configs": dict(OSC_14),
        "robots": ["Panda"] * spec.arms,
        "camera_depths": False,
        "camera_heights": 84,
        "camera_widths": 84,
        "reward_shaping": False,
        "render_gpu_device_id": 0,
    }
    if spec.arms == 2:
        kwargs["env_configuration"] = "single-arm-opposed"
    return {"env_name": spec.env_name, "env_version": "1.4.1", "type": 1, "env_kwargs": kwargs}


def env_args_15(task: str, frame: str = "world") -> dict[str, Any]:
    """The ``env_args`` of a robomimic file recorded with robosuite 1.5."""
    meta = task_env_args(task)
    meta["env_kwargs"]["controller_configs"]["body_parts"]["right"]["input_ref_frame"] = frame
    return meta


def write_robomimic_file(
    path: str | Path,
    lengths: Sequence[int] = (12, 5, 30),
    task: str = "square",
    seed: int = 0,
    masks: Mapping[str, Sequence[int]] | None = None,
    env_args: Mapping[str, Any] | None = None,
    failures: Sequence[int] = (),
) -> list[dict[str, np.ndarray]]:
    """Write random demonstrations in robomimic's layout.

    Args:
        path: file to write.
        lengths: steps of each demo.
        task: which task's keys and widths to use.
        seed: of the random contents.
        masks: filter key to demo numbers; no group ``mask`` if ``None``.
        env_args: what to store as such; by default those of robosuite 1.5.
        failures: numbers of the demos whose last reward is 0.

    Returns:
        Per demo the float64 arrays as written: ``actions``, ``rewards`` and the observations by key.
    """
    spec = get_task(task)
    rng = np.random.default_rng(seed)
    demos = []
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        group.attrs["total"] = sum(lengths)
        group.attrs["env_args"] = json.dumps(env_args or env_args_15(task), indent=4)
        for number, steps in enumerate(lengths):
            demo: dict[str, np.ndarray] = {
                "actions": rng.uniform(-1, 1, (steps, spec.action_dim)),
                "rewards": np.zeros(steps),
                "object": rng.normal(size=(steps, spec.object_dim)),
            }
            if number not in failures:
                demo["rewards"][-1:] = 1
            for arm in range(spec.arms):
                for suffix, width in WIDTHS.items():
                    demo[f"robot{arm}_{suffix}"] = rng.normal(size=(steps, width))
                quat = demo[f"robot{arm}_eef_quat"]
                quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
            entry = group.create_group(f"demo_{number}")
            entry.attrs["num_samples"] = steps
            for key, value in demo.items():
                entry[key if key in ("actions", "rewards") else f"obs/{key}"] = value
            # Real files hold much that is not read.
            entry["dones"] = (demo["rewards"] > 0).astype(np.int64)
            entry["states"] = rng.normal(size=(steps, 45))
            entry["obs/robot0_eef_vel_lin"] = rng.normal(size=(steps, 3))
            entry["obs/agentview_image"] = np.zeros((steps, 4, 4, 3), np.uint8)
            demos.append(demo)
        for key, numbers in (masks or {}).items():
            file[f"mask/{key}"] = np.array([f"demo_{n}".encode() for n in numbers], dtype="S")
    return demos
