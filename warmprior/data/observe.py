"""Conversion of raw robosuite recordings, which hold states and actions, to files with observations."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warmprior.data.checks import DatasetError, check_count, check_env_args, store_finite
from warmprior.data.formats.hdf5 import open_robomimic, read_described, selected_demos
from warmprior.data.formats.hdf5_file import member, reading
from warmprior.envs.control_loop import StepLoop
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.robosuite_tasks import low_dim_keys
from warmprior.envs.simulator import make_simulator, scene_stays
from warmprior.io.extras import require
from warmprior.io.files import check_writable, write_atomic

_MORE = ("joint_pos", "joint_vel", "gripper_qvel")


def observe_recordings(
    path: str | Path,
    out: str | Path,
    *,
    observations: Sequence[str] | None = None,
    demos: int | None = None,
) -> Path:
    """Replay the states of recordings, and write the simulator's observations together with the actions.

    The result has robomimic's low-dimensional layout: ``obs`` before each action, ``rewards`` (1 where the
    next state is solved), ``dones``, the states, and ``env_args``. Recordings come from robosuite's
    ``collect_human_demonstrations``, from robosuite 1.0 on, with any robot and controller of robosuite 1.5;
    any robomimic file with states works too.

    Args:
        path: an HDF5 file such as ``demo.hdf5``, with ``states`` and ``actions`` per demo.
        out: the file to write; it must not exist.

    Keyword Args:
        observations: robosuite's observations to write; by default the object and every arm's pose,
            gripper and joints.
        demos: number of demos, from the first on; all by default.

    Returns:
        The path ``out``.

    Raises:
        FileNotFoundError: if there is no such file.
        FileExistsError: if ``out`` exists.
        DatasetError: if states or actions do not fit the environment that the file names.

    Examples:
        >>> from warmprior.data import observe_recordings
        >>> observe_recordings("demo.hdf5", "lift.hdf5")  # doctest: +SKIP
        PosixPath('lift.hdf5')
    """
    path, out = Path(path), Path(out)
    if out.exists():
        raise FileExistsError(f"{out} exists: choose another file")
    h5py = require("h5py", "sim")
    with open_robomimic(path) as source:
        env_args = recorded_env_args(source, path)
        names = selected_demos(source, None)
        check_count(path, demos, len(names))
        env = described_simulator(env_args, path)
        if not scene_stays(env):
            what = f"{type(env).__name__} moves fixtures at resets: observations do not follow from states"
            raise DatasetError(f"{path}: {what}")
        usual = [
            *low_dim_keys(len(env.robots)),
            *(f"robot{i}_{k}" for i in range(len(env.robots)) for k in _MORE),
        ]
        loop = StepLoop(env, usual if observations is None else observations)
        check_writable(out.parent)

        def write(temporary: Path) -> None:
            with h5py.File(temporary, "w") as file:
                data, total = file.create_group("data"), 0
                for name in tqdm(names[:demos], f"observe {path.stem}", unit="demo"):
                    total += _write_demo(source, name, data.create_group(name), loop)
                data.attrs["total"] = total
                data.attrs["env_args"] = json.dumps(env_args, indent=4)

        write_atomic(out, write)
    env.close()
    return out


def recorded_env_args(file: Any, path: Path) -> dict[str, Any]:
    """Return the environment of recordings as ``env_args``, if needed from robosuite's ``env_info``."""
    described = read_described(file, "env_args")
    if described is not None:
        return check_env_args(f"{path}: data.attrs['env_args']", described)
    info, attributes = read_described(file, "env_info"), file["data"].attrs
    if not isinstance(info, dict):
        raise DatasetError(f"{path}: data has neither 'env_args' nor 'env_info' to name the environment")
    name = str(info.pop("env_name", attributes.get("env", "")))
    version = str(attributes.get("repository_version", "unknown"))
    return check_env_args(
        f"{path}: data.attrs['env_info']",
        {"env_name": name, "env_version": version, "type": 1, "env_kwargs": info},
    )


def described_simulator(env_args: Mapping[str, Any], path: Path) -> Any:
    """Build the simulator that a file describes; raise DatasetError if robosuite cannot build it."""
    try:
        return make_simulator(modernize_env_args(env_args))
    except Exception as error:  # an unexpected description can raise anything
        raise DatasetError(
            f"{path}: robosuite cannot build {env_args['env_name']!r} as it is described ({error!r}): "
            "correct data.attrs['env_info'], or env_args"
        ) from error


def _write_demo(source: Any, name: str, demo: Any, loop: StepLoop) -> int:
    arrays: dict[str, np.ndarray] = {}
    for key in ("states", "actions"):
        stored = member(source, f"data/{name}/{key}", "dataset")
        if stored is None:
            raise DatasetError(f"{source.filename}: data/{name} has no {key}: it cannot be replayed")
        with reading(source, f"data/{name}/{key}"):
            arrays[key] = np.asarray(stored[()], np.float64)
    states, actions = arrays["states"], arrays["actions"]
    widths, env = (len(loop.state()), loop.env.action_dim), type(loop.env).__name__
    stored = tuple(value.shape[-1] if value.ndim == 2 else value.shape for value in arrays.values())
    if stored != widths or len(states) != len(actions) or not len(states):
        raise DatasetError(
            f"{source.filename}: data/{name} has states {states.shape} and actions {actions.shape}, but "
            f"{env} with this robot has [N, {widths[0]}] and [N, {widths[1]}]: they are from another robot"
        )
    for key, value in arrays.items():
        store_finite(value, value, f"{source.filename}: data/{name}/{key}", "Remove the demo.")
    observed, solved = zip(*_observed(states, loop), strict=True)
    rewards = np.array([*solved[1:], solved[-1]], np.float64)
    dones = rewards.astype(np.int64)
    dones[-1] = 1
    for key, value in {**arrays, "rewards": rewards, "dones": dones}.items():
        demo.create_dataset(key, data=value)
    for key in observed[0]:
        demo.create_dataset(f"obs/{key}", data=np.stack([entry[key] for entry in observed]))
    demo.attrs["num_samples"] = len(actions)
    model = source[f"data/{name}"].attrs.get("model_file")
    if model is not None:
        demo.attrs["model_file"] = model
    return len(actions)


def _observed(states: np.ndarray, loop: StepLoop) -> Iterator[tuple[dict[str, np.ndarray], bool]]:
    for state in states:
        observations = loop.set_state(state)
        yield {k: np.array(v, np.float64) for k, v in observations.items()}, bool(loop.env._check_success())
