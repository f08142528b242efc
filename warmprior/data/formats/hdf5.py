"""A reader of robomimic's HDF5 layout, with errors that say which demo, key and row is wrong."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, override

import numpy as np
import torch
from torch import Tensor

from warmprior.checks import LARGEST
from warmprior.data import checks
from warmprior.data.checks import (
    DatasetError,
    check_count,
    check_env_args,
    declared_poses,
    store_finite,
    unknown_name_error,
)
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.formats.hdf5_file import (
    AGAIN,
    LEAVE_OUT,
    follow,
    member,
    names,
    open_hdf5,
    place_of,
    reading,
)
from warmprior.data.index import BLOCK, DatasetIndex, DemonstrationReader, pose_keys
from warmprior.envs.robosuite_tasks import low_dim_keys, task_of_env
from warmprior.io.extras import require
from warmprior.io.files import file_digest

if TYPE_CHECKING:
    import h5py


RATE = "control_freq"
"""The attribute of ``data`` with the control steps per second, for files that describe no environment."""

_IMAGE_BYTES = 2**24  # bytes of images that are read at once
_OBSERVE = "use the low_dim file, or replay its states (python -m warmprior observe FILE OUT)"


@contextmanager
def open_robomimic(path: str | Path) -> Iterator[h5py.File]:
    """Open a robomimic file for reading; raise DatasetError if it is incomplete or has no demos."""
    with open_hdf5(path) as file:
        data = member(file, "data", "group")
        if data is None:
            raise DatasetError(f"{path}: no group 'data' among {names(file)}: not a robomimic file")
        if not names(data):
            raise DatasetError(f"{path}: the group 'data' holds no demos")
        yield file


def _mask_names(file: h5py.File) -> list[str]:
    group = member(file, "mask", "group")
    return [] if group is None else names(group)


def _mask(file: h5py.File, filter_key: str) -> set[str]:
    if filter_key not in (masks := _mask_names(file)):
        raise unknown_name_error(file.filename, "filter key", filter_key, masks)
    entries, demos = member(file["mask"], filter_key, "dataset"), len(names(file["data"]))
    what = f"{file.filename}: mask/{filter_key}"
    if entries is None or entries.ndim != 1 or entries.dtype.kind not in "SO":
        raise DatasetError(f"{what} is not a list of names of demos, but {entries}; rebuild the mask")
    if len(entries) > demos:
        raise DatasetError(f"{what} has {len(entries)} names, but data holds {demos} demos; rebuild the mask")
    with reading(file, f"mask/{filter_key}"):
        return {entry.decode() for entry in entries[()]}


def selected_demos(file: h5py.File, filter_key: str | None) -> tuple[str, ...]:
    """Return the names of the demos, or of those in a mask, in the order of their numbers."""
    present = set(names(file["data"]))
    selected = present if filter_key is None else _mask(file, filter_key)
    if absent := sorted(selected - present):
        raise DatasetError(f"{file.filename}: mask/{filter_key} names {absent}, which data lacks")
    if not selected:
        raise DatasetError(f"{file.filename}: mask/{filter_key} names no demos")
    for name in selected:
        if not (name.startswith("demo_") and name[5:].isdecimal()):
            raise DatasetError(f"{file.filename}: data/{name} is not called demo_<number>; rename the group")
    return tuple(sorted(selected, key=lambda name: (int(name[5:]), name)))


def read_described(file: h5py.File, name: str) -> Any:
    """Read a JSON attribute of the demos, or return ``None`` if there is none."""
    with reading(file, f"data.attrs[{name!r}]"):
        attributes = file["data"].attrs
        return json.loads(attributes[name]) if name in attributes else None


def _number(group: h5py.Group, name: str, advice: str = AGAIN) -> float | None:
    """Return a number among a group's attributes, or ``None`` if there is none."""
    with checks.reading(f"{place_of(group)}.attrs[{name!r}]", advice):
        value = group.attrs.get(name)
        return None if value is None else float(np.asarray(value).item())


def _rate(file: h5py.File) -> float | None:
    """Return the control steps per second that a file names, or ``None``."""
    advice = "Write the control steps per second, or remove it."
    rate = _number(file["data"], RATE, advice)
    if rate is not None and not 0 < rate <= LARGEST:
        raise DatasetError(f"{file.filename}: data.attrs[{RATE!r}] is {rate:g}. {advice}")
    return rate


def _check_count(group: h5py.Group, name: str, steps: int) -> None:
    """Compare steps with a group's own count, if there is one: damage can hide demos, and rows be padding."""
    count = _number(group, name)
    if count is not None and count != steps:
        raise DatasetError(
            f"{place_of(group)}.attrs[{name!r}] counts {count:g} steps, but there are {steps}: a demo is "
            "missing, incomplete or padded. Copy or download it again, or correct the attribute."
        )


def _widths(demo: h5py.Group, keys: Sequence[str]) -> tuple[int, dict[str, int]]:
    """Return the steps of a demo and the width of each key, after checking that they agree."""
    what, steps, widths = place_of(demo), 0, {}
    observations = member(demo, "obs", "group")
    if observations is None:
        raise DatasetError(f"{what} has no group 'obs': it holds no observations: {_OBSERVE}")
    for key in ("actions", "rewards", *keys):
        dataset = member(demo, key, "dataset")
        if dataset is None and key == "rewards":  # cloning needs no rewards
            continue
        if dataset is None:
            kind, group = ("observation", observations) if key.startswith("obs/") else ("dataset", demo)
            raise unknown_name_error(what, kind, key.removeprefix("obs/"), names(group))
        shape: tuple[int, ...] = dataset.shape or ()
        steps = shape[0] if key == "actions" and shape else steps
        if steps == 0 or shape[:1] != (steps,):
            raise DatasetError(f"{what}/{key} has shape {shape}, not {steps or 'some'} rows. {LEAVE_OUT}")
        if len(shape) > 2 or dataset.dtype.kind not in "fiub":
            kind = f"shape {shape} and type {dataset.dtype}"
            raise DatasetError(f"{what}/{key} has {kind}, expected vectors of numbers: leave the key out")
        widths[key] = 1 if len(shape) == 1 else shape[1]
    return steps, widths


def _option(observations: h5py.Group, key: str) -> str:
    """Return the option that takes an observation, for numbers or vectors and for images, or ""."""
    with reading(observations, key):
        item = follow(observations, key)
        if not isinstance(item, require("h5py", "sim").Dataset):
            return ""
        if len(item.shape or ()) in (1, 2) and item.dtype.kind in "fiub":
            return "observations"
        return "images" if item.dtype == "uint8" and item.ndim == 4 and item.shape[3] == 3 else ""


def _options(observations: h5py.Group, keys: Iterable[str]) -> dict[str, str]:
    """Return the option that takes each observation; what is damaged is read by none."""
    options = dict.fromkeys(keys, "")
    for key in options:
        with suppress(DatasetError):
            options[key] = _option(observations, key)
    return options


def _image_shapes(demo: h5py.Group, keys: Sequence[str], steps: int) -> dict[str, tuple[int, int]]:
    """Return heights and widths of a demo's images, after checking their shapes and types."""
    shapes = {}
    for key in keys:
        what, images = place_of(demo, f"obs/{key}"), member(demo, f"obs/{key}", "dataset")
        if images is None:
            options = _options(demo["obs"], names(demo["obs"]))
            others = [name for name, option in options.items() if option == "images"]
            if not others:
                raise DatasetError(
                    f"{place_of(demo)} has no images: leave the images out, or render them from its states "
                    "(python benchmarks/demonstrations.py render)"
                )
            raise unknown_name_error(place_of(demo), "images", key, others)
        shape: tuple[int, ...] = images.shape or ()
        rows, *size, colours = shape if len(shape) == 4 else (0, 0, 0)
        if images.dtype != "uint8" or (rows, colours) != (steps, 3) or not min(size):
            kind = f"shape {shape} and type {images.dtype}"
            raise DatasetError(f"{what} has {kind}; images are uint8 ({steps}, height, width, 3)")
        shapes[key] = (size[0], size[1])
    return shapes


class RobomimicReader(DemonstrationReader):
    """A reader of an open file's values."""

    def __init__(self, file: h5py.File) -> None:
        self.file = file

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read block by block; ``out`` may be a strided view."""
        dataset: Any = member(self.file, f"data/{demo}/{key}", "dataset")
        if dataset is None and key == "rewards":
            out[...] = 0
            return
        what = f"{self.name(demo, key)} (shape {dataset.shape})"
        for start in range(0, len(out), BLOCK):
            rows = out[start : start + BLOCK]
            with reading(self.file, f"data/{demo}/{key}"):
                block = dataset[first + start : first + start + len(rows)]
            store_finite(block, rows, what, LEAVE_OUT, first + start)

    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        """Read block by block."""
        name = f"data/{demo}/obs/{key}"
        images: Any = member(self.file, name, "dataset")
        rows = max(1, _IMAGE_BYTES // prod(images.shape[1:]))
        for start in range(0, len(images), rows):
            with reading(self.file, name):
                block = images[start : start + rows]
            yield torch.from_numpy(block).permute(0, 3, 1, 2)

    @override
    def name(self, demo: str, key: str) -> str:
        return f"{self.file.filename}: data/{demo}/{key}"


class RobomimicDemonstrations(Demonstrations):
    """The demonstrations of a robomimic or MimicGen HDF5 file.

    By default the observations are those of the task, or for an unknown environment the object, every robot's
    pose and gripper, and all other vectors but those of a robot with such a pose or gripper (``robot0_...``).
    """

    prefix = ""

    @property
    def path(self) -> Path:
        """The file."""
        return Path(self.place)

    @property
    @override
    def title(self) -> str:
        return self.path.stem

    @override
    def check(self) -> None:
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.place}: no such file")

    @override
    def index(
        self, observations: Sequence[str] | None = None, images: Sequence[str] = (), *, poses: bool = False
    ) -> DatasetIndex:
        path = self.path
        with open_robomimic(path) as file:
            selected = selected_demos(file, self.mask)
            check_count(path, self.demos, len(selected))
            count, selected = len(selected), selected[: self.demos]
            group = member(file, f"data/{selected[0]}/obs", "group")
            available = () if group is None else tuple(names(group))
            described = read_described(file, "env_args")
            if described is None and group is None:
                raise DatasetError(
                    f"{path}: its demos have no group 'obs': recordings of robosuite hold states without "
                    f"observations: {_OBSERVE}"
                )
            # A file without a description comes from a robot, or from another simulator than robosuite, whose
            # type is 1 in robomimic.
            if isinstance(described, dict) and (simulator := described.get("type", 1)) != 1:
                if not isinstance(simulator, int):
                    what = f"{path}: data.attrs['env_args'] has type={simulator!r}"
                    raise DatasetError(f"{what}, not the number of a simulator: write 1 for robosuite")
                described = None
            env_args = (
                {} if described is None else check_env_args(f"{path}: data.attrs['env_args']", described)
            )
            task = task_of_env(env_args) if env_args else None
            if observations is not None:
                keys = tuple(observations)
            elif task is not None:
                keys = task.low_dim_keys
            else:
                usual = [key for key in low_dim_keys(arms=len(available)) if key in available]
                # Joints and velocities of a robot say again where its gripper is.
                known = {key.partition("_")[0] for key in usual} - {"object"}
                others = [k for k in available if k not in usual and k.partition("_")[0] not in known]
                keys = (*usual, *(key for key in others if _option(group, key) == "observations"))
            obs_names = [f"obs/{key}" for key in keys]
            if poses:
                actions = member(file, f"data/{selected[0]}/actions", "dataset")
                width = actions.shape[-1] if actions is not None and actions.shape else 0
                obs_names += [f"obs/{key}" for key in pose_keys(width)]
            expected, whose = {}, env_args.get("env_name", str(path))
            if task is not None:
                if declared_poses(path, env_args) is not None:  # other controllers have other widths
                    expected["actions"] = task.action_dim
                if observations is None:
                    expected["obs/object"] = task.object_dim
            lengths: list[int] = []
            shapes: dict[str, tuple[int, int]] = {}
            common, present = set(available), set(available)
            for name in selected:
                demo = member(file["data"], name, "group")
                if demo is None:  # the name is listed, but a damaged index hides the demo
                    raise DatasetError(f"{path}: data/{name} cannot be read. {AGAIN}")
                steps, widths = _widths(demo, obs_names)
                _check_count(demo, "num_samples", steps)
                if lengths and widths.keys() != expected.keys():
                    raise DatasetError(
                        f"{place_of(demo)} and data/{selected[0]}: only one of them has 'rewards'"
                    )
                for key, width in expected.items():
                    if widths[key] != width:
                        leave = "" if key == "actions" else ", or choose observations"
                        raise DatasetError(
                            f"{place_of(demo, key)} has shape {demo[key].shape}; {whose} has {width} "
                            f"columns. Use demos of one environment and controller{leave}."
                        )
                held = names(demo["obs"])
                common, present = common & {*held}, present | {*held}
                expected, whose = widths, f"data/{selected[0]} of {env_args.get('env_name', path)}"
                lengths.append(steps)
                sizes = _image_shapes(demo, images, steps)
                if shapes and sizes != shapes:
                    raise DatasetError(
                        f"{place_of(demo)} has images of {sizes}, and data/{selected[0]} of {shapes}: render "
                        "them again, or leave the demo out"
                    )
                shapes = sizes
            # What some demos lack cannot be chosen.
            taken_by = dict.fromkeys(present - common, "") | _options(group, common - {*keys, *images})
            if self.mask is None and self.demos is None:
                _check_count(file["data"], "total", sum(lengths))
            rate = env_args["env_kwargs"].get("control_freq", 20) if env_args else _rate(file)
        return DatasetIndex(
            path=path,
            demos=selected,
            lengths=tuple(lengths),
            observation_keys=keys,
            observation_dims=tuple(widths[f"obs/{key}"] for key in keys),
            **self.image_entries(images, shapes),
            available_keys=tuple(sorted(present)),
            taken_by=taken_by,
            action_dim=widths["actions"],
            rewards="rewards" in widths,
            env_args=env_args,
            task=task,
            whole=len(selected) == count,
            rate=rate,
        )

    @contextmanager
    @override
    def reader(self, index: DatasetIndex) -> Iterator[RobomimicReader]:
        with open_robomimic(self.path) as file:
            yield RobomimicReader(file)

    @override
    def contents(self, index: DatasetIndex) -> str:
        return file_digest(self.path)

    @override
    def origin(self, index: DatasetIndex) -> tuple[dict[str, Any] | None, np.ndarray | None]:
        with open_robomimic(self.path) as file:
            rendering = read_described(file, "rendering")
            states = member(file, f"data/{index.demos[0]}/states", "dataset")
            with reading(file, f"data/{index.demos[0]}/states"):
                state = np.asarray(states[0], np.float64) if states is not None and states.size else None
        return rendering, state

    def masks(self) -> dict[str, set[str]]:
        """Return the names of the demos in each mask."""
        with open_robomimic(self.path) as file:
            return {name: _mask(file, name) for name in _mask_names(file)}
