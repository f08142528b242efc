"""Reading robomimic's HDF5 layout, with errors that say which demo, key and row is wrong.

:func:`read_index` looks at names, shapes and attributes only, and finds all that is wrong with them
before anything big is read. :func:`read_rows` then reads values, block by block, into memory that
the caller owns.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warmprior._extras import require
from warmprior.data.tasks import TASKS, TaskSpec

if TYPE_CHECKING:
    import h5py

__all__ = ["DatasetError", "RobomimicIndex", "open_robomimic", "read_index", "read_rows"]

BLOCK = 4096  # rows read at once: a bound on temporary memory, whatever the length of a demo
_ARM_SUFFIXES = ("eef_pos", "eef_quat", "gripper_qpos")
_LEAVE_OUT = "Rebuild or remove the demo, or leave it out with a mask."


class DatasetError(ValueError):
    """A demonstration file is not what it should be; the message says where and what to do."""


@dataclass(frozen=True)
class RobomimicIndex:
    """What a robomimic file holds, without its values.

    Attributes:
        path: the file.
        demos: names of the selected demos, in the order of their numbers.
        lengths: the number of steps of each.
        observation_keys: the observations to read, in the order of concatenation.
        observation_dims: the width of each.
        available_keys: every observation of the first demo.
        action_dim: the width of ``actions``.
        env_args: the parsed ``env_args`` as the file has them.
        task: the task of :data:`warmprior.data.TASKS` that uses this environment, or ``None``.
    """

    path: Path
    demos: tuple[str, ...]
    lengths: tuple[int, ...]
    observation_keys: tuple[str, ...]
    observation_dims: tuple[int, ...]
    available_keys: tuple[str, ...]
    action_dim: int
    env_args: dict[str, Any]
    task: TaskSpec | None


@contextmanager
def open_robomimic(path: str | Path) -> Iterator[h5py.File]:
    """Open a robomimic file for reading.

    Args:
        path: the HDF5 file.

    Yields:
        The open ``h5py.File``, which has a group ``data`` with at least one demo.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if it is not a complete HDF5 file or has no demos.
        ImportError: if h5py is not installed.

    Examples:
        >>> with open_robomimic("nowhere.hdf5") as file:
        ...     pass
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """
    h5py = require("h5py", "sim")
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; check the path")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DatasetError(
            f"{path}: not a readable HDF5 file ({path.stat().st_size} bytes; {error}). "
            "It may have been cut short: copy or download it again."
        ) from error
    with file:
        if "data" not in file:
            found = ", ".join(sorted(file)) or "nothing"
            raise DatasetError(f"{path}: no group 'data' (found {found}): not a robomimic file")
        if len(file["data"]) == 0:
            raise DatasetError(f"{path}: the group 'data' holds no demos: record or copy some")
        yield file


def _number(path: Path, name: str) -> int:
    if not (name.startswith("demo_") and name[5:].isdecimal()):
        raise DatasetError(f"{path}: data/{name} is not called demo_<number>; rename the group")
    return int(name[5:])


def _selected(file: h5py.File, path: Path, filter_key: str | None) -> tuple[str, ...]:
    present = set(file["data"])
    names = present
    if filter_key is not None:
        masks = sorted(file["mask"]) if "mask" in file else []
        if filter_key not in masks:
            known = f"choose one of {', '.join(masks)}" if masks else "this file has none"
            raise DatasetError(f"{path}: unknown filter key {filter_key!r}; {known}")
        names = {entry.decode() for entry in file["mask"][filter_key][()]}
        absent = sorted(names - present)
        if absent or not names:
            what = f"demos that data does not hold: {', '.join(absent)}" if absent else "no demos"
            raise DatasetError(
                f"{path}: mask/{filter_key} names {what}. "
                "Choose another filter key or rebuild the mask."
            )
    # Numbers are not zero padded: demo_10 comes after demo_9.
    return tuple(sorted(names, key=lambda name: _number(path, name)))


def _env_args(file: h5py.File, path: Path) -> dict[str, Any]:
    text = file["data"].attrs.get("env_args")
    if text is None:
        raise DatasetError(
            f"{path}: the group 'data' has no attribute env_args, which names the environment; "
            "copy it from the file this one was made from"
        )
    try:
        parsed = json.loads(text)
    except ValueError as error:
        raise DatasetError(f"{path}: data.attrs['env_args'] is not JSON ({error})") from error
    if not (isinstance(parsed, dict) and {"env_name", "env_kwargs"} <= parsed.keys()):
        raise DatasetError(f"{path}: data.attrs['env_args'] lacks env_name or env_kwargs")
    return parsed


def _default_keys(path: Path, available: Sequence[str]) -> tuple[str, ...]:
    robots = sorted({key.split("_")[0] for key in available if key.startswith("robot")})
    wanted = ["object", *(f"{robot}_{suffix}" for robot in robots for suffix in _ARM_SUFFIXES)]
    keys = tuple(key for key in wanted if key in available)
    if available and not keys:
        raise DatasetError(
            f"{path}: no object or robot observations among {', '.join(available)}; "
            "name some with observation_keys"
        )
    return keys


def _widths(path: Path, demo: h5py.Group, keys: Sequence[str]) -> tuple[int, dict[str, int]]:
    """Return the steps of a demo and the width of each key, after checking that they agree."""
    name = demo.name[1:]
    if "obs" not in demo:
        raise DatasetError(
            f"{path}: {name} has no group 'obs'. Raw files (demo_v15.hdf5) have no observations: "
            "use the low_dim file, or add them with robomimic's dataset_states_to_obs.py."
        )
    steps, widths = 0, {}
    for key in ("actions", "rewards", *keys):
        if key not in demo:
            group = demo["obs"] if key.startswith("obs/") else demo
            raise DatasetError(
                f"{path}: {name} has no {key!r}; {group.name[1:]} has {', '.join(sorted(group))}. "
                "Choose other keys or rebuild the file."
            )
        shape, kind = demo[key].shape, demo[key].dtype.kind
        steps = shape[0] if key == "actions" and shape else steps
        if steps == 0:
            raise DatasetError(f"{path}: {name} has no steps (actions {shape}). {_LEAVE_OUT}")
        if shape[:1] != (steps,):
            raise DatasetError(
                f"{path}: {name}/{key} has shape {shape} but actions has {steps} rows. {_LEAVE_OUT}"
            )
        if len(shape) > 2 or kind not in "fiub":
            raise DatasetError(
                f"{path}: {name}/{key} has shape {shape} and type {demo[key].dtype}; only vectors "
                "of numbers can be used. Leave the key out of observation_keys."
            )
        widths[key] = 1 if len(shape) == 1 else shape[1]
    return steps, widths


def _check_widths(
    path: Path, demo: h5py.Group, widths: Mapping[str, int], expected: Mapping[str, int], why: str
) -> None:
    for key, width in expected.items():
        if widths[key] != width:
            raise DatasetError(
                f"{path}: {demo.name[1:]}/{key} has shape {demo[key].shape}; {why} has {width} "
                "columns. Use data of one environment with pose-delta actions; if other "
                "observations are meant, name them with observation_keys."
            )


def read_index(
    path: str | Path,
    *,
    filter_key: str | None = None,
    observation_keys: Sequence[str] | None = None,
    poses: bool = False,
) -> RobomimicIndex:
    """Check a robomimic file and say what it holds. No values are read.

    Args:
        path: the HDF5 file.
        filter_key: a mask of the file, such as ``"train"``; all demos if ``None``.
        observation_keys: the observations to read. By default those of the task, or, for an
            unknown environment, ``object`` and each robot's pose and gripper as far as the file
            has them.
        poses: also require the hand pose of every arm, from which absolute actions are built.

    Returns:
        The selection.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file is cut short or not a robomimic file, the filter key is unknown or
            names absent demos, a key is missing, a demo is empty, or shapes disagree.

    Examples:
        >>> index = read_index("square.hdf5", filter_key="train")  # doctest: +SKIP
        >>> len(index.demos), index.action_dim  # doctest: +SKIP
        (180, 7)
    """
    path = Path(path)
    with open_robomimic(path) as file:
        demos = _selected(file, path, filter_key)
        env_args = _env_args(file, path)
        task = next((t for t in TASKS.values() if t.env_name == env_args["env_name"]), None)
        first = file["data"][demos[0]]
        available = tuple(sorted(first["obs"])) if "obs" in first else ()
        if observation_keys is not None:
            keys = tuple(observation_keys)
            if not keys:
                raise DatasetError(f"{path}: observation_keys is empty; name at least one")
        else:
            keys = task.low_dim_keys if task else _default_keys(path, available)
        wanted = [f"obs/{key}" for key in keys]
        if poses and "actions" in first:
            for arm in range(first["actions"].shape[-1] // 7):
                wanted += [f"obs/robot{arm}_eef_pos", f"obs/robot{arm}_eef_quat"]
        required: dict[str, int] = {}
        if task is not None:
            required["actions"] = task.action_dim
            if observation_keys is None:
                required["obs/object"] = task.object_dim
        lengths: list[int] = []
        reference: dict[str, int] = {}
        for name in demos:
            demo = file["data"][name]
            steps, widths = _widths(path, demo, wanted)
            _check_widths(path, demo, widths, required, env_args["env_name"])
            reference = reference or widths
            _check_widths(path, demo, widths, reference, f"data/{demos[0]}")
            lengths.append(steps)
    return RobomimicIndex(
        path=path,
        demos=demos,
        lengths=tuple(lengths),
        observation_keys=keys,
        observation_dims=tuple(reference[f"obs/{key}"] for key in keys),
        available_keys=available,
        action_dim=reference["actions"],
        env_args=env_args,
        task=task,
    )


def read_rows(file: h5py.File, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
    """Read rows of one array of a demo into ``out``, block by block, and check them.

    Args:
        file: the open file.
        demo: the name of the demo.
        key: path inside the demo, such as ``"actions"`` or ``"obs/object"``.
        out: ``[rows, width]`` floating-point memory to fill; may be a strided view.
        first: the row of the demo that goes to the first row of ``out``.

    Raises:
        DatasetError: if a value is not finite in the type of ``out``, or the file cannot be read.
    """
    name = f"data/{demo}/{key}"
    dataset = file[name]
    for start in range(0, len(out), BLOCK):
        rows = out[start : start + BLOCK]
        try:
            block = dataset[first + start : first + start + len(rows)]
        except OSError as error:
            raise DatasetError(
                f"{file.filename}: {name} cannot be read ({error}); copy or download the file again"
            ) from error
        with np.errstate(over="ignore"):  # an overflow is infinite, which is reported below
            rows[...] = block.reshape(rows.shape)
        finite = np.isfinite(rows).all(-1)
        if not finite.all():
            raise DatasetError(
                f"{file.filename}: {name} (shape {dataset.shape}) has NaN or infinity in row "
                f"{first + start + int(np.argmin(finite))}. {_LEAVE_OUT}"
            )
