import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("h5py")

import h5py
import numpy as np

from warmprior.envs.robosuite_tasks import get_task
from warmprior.envs.simulator import task_env_args

WIDTHS = {"eef_pos": 3, "eef_quat": 4, "gripper_qpos": 2}


def env_args_14(task: str) -> dict[str, Any]:
    """The ``env_args`` of a robomimic file of robosuite 1.4, which has one arm's controller."""
    meta = task_env_args(task)
    kwargs = meta["env_kwargs"]
    arm = kwargs.pop("controller_configs")["body_parts"]["right"]
    arm["damping"], arm["damping_limits"] = arm.pop("damping_ratio"), arm.pop("damping_ratio_limits")
    for name in ("input_type", "input_ref_frame", "gripper"):
        del arm[name]
    kwargs.pop("lite_physics", None)
    kwargs |= {"controller_configs": arm | {"control_delta": True}, "render_gpu_device_id": 0}
    if get_task(task).arms == 2:
        kwargs["env_configuration"] = "single-arm-opposed"
    return meta | {"env_version": "1.4.1"}


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
    """Write random demonstrations in robomimic's layout, with a task's keys and widths.

    Masks are numbers of demos by filter key; the last reward of failures is 0. Returns per demo the float64
    arrays as written: ``actions``, ``rewards`` and the observations by key.
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
            entry["obs/agentview_image"] = np.zeros((steps, 8, 8, 3), np.uint8)
            demos.append(demo)
        for key, numbers in (masks or {}).items():
            file[f"mask/{key}"] = np.array([f"demo_{n}".encode() for n in numbers], dtype="S")
    return demos


def shortened(file: Path, path: Path, steps: int) -> Path:
    """Write the first steps of a file's first two of three demos to another file; return its path."""
    shutil.copy(file, path)
    with h5py.File(path, "a") as copy:
        del copy["data/demo_2"]
        copy["data"].attrs["total"] = 2 * steps
        for name, names in list(copy["mask"].items()):
            kept = [demo for demo in names[()] if demo != b"demo_2"]
            del copy["mask"][name]
            copy["mask"][name] = np.array(kept, dtype="S8")
        for demo in copy["data"].values():
            demo.attrs["num_samples"] = steps
            demo.pop("next_obs", None)
            for group in (demo, demo["obs"]):
                for name, rows in list(group.items()):
                    if isinstance(rows, h5py.Dataset):
                        kept = rows[:steps]
                        del group[name]
                        group[name] = kept
    return path
