"""Reading robomimic's HDF5 layout, with errors that say which demo, key and row is wrong.

A file can name other files of the machine as its contents, and declare more than it stores, which HDF5 reads
as zeros. Everything here is opened by :func:`member`, which refuses both.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from math import ceil, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from torch import Tensor

from warmprior.data.replay import (
    BLOCK,
    DatasetError,
    DatasetIndex,
    DemonstrationReader,
    check_count,
    check_env_args,
    check_filter_key,
    store_finite,
)
from warmprior.envs.tasks import low_dim_keys, task_of_env
from warmprior.io.extras import require

if TYPE_CHECKING:
    import h5py


CHUNK_BYTES = 2**28  # HDF5 unpacks whole chunks, however few rows are asked for
_MAX_SOFT_LINKS = 16
_AGAIN = "Copy or download the file again."


@contextmanager
def reading(parent: h5py.Group, name: str) -> Iterator[None]:
    """Name the file, and the object below ``parent``, in whatever goes wrong inside."""
    try:
        yield
    except DatasetError:
        raise
    except Exception as error:  # HDF5's errors share no base class: OSError, RuntimeError, KeyError...
        raise DatasetError(
            f"{parent.file.filename}: {_full(parent, name)} cannot be read ({error}). {_AGAIN}"
        ) from error


def names(group: h5py.Group) -> list[str]:
    """The names in a group, sorted."""
    with reading(group, ""):
        return sorted(group)


def member(
    parent: h5py.Group, name: str, kind: Literal["group", "dataset"]
) -> h5py.Group | h5py.Dataset | None:
    """Open a group or dataset that the file itself holds, and has written, below ``parent``; or ``None``."""
    with reading(parent, name):
        found = _follow(parent, name, _MAX_SOFT_LINKS)
        if found is None:
            return None
        is_group = isinstance(found, require("h5py", "sim").Group)
        if is_group != (kind == "group"):
            what, wanted = ("a group", "dataset") if is_group else ("a dataset", "group")
            raise DatasetError(
                f"{parent.file.filename}: {_full(parent, name)} is {what} where a {wanted} belongs; "
                "rebuild the file"
            )
        if not is_group:
            _check_stored(found)
        return found


def _full(parent: h5py.Group, name: str) -> str:
    return f"{parent.name}/{name}".strip("/") or "/"


def _follow(node: h5py.Group, name: str, soft_links: int) -> h5py.Group | h5py.Dataset | None:
    # Link by link, by the low-level calls: h5py's own, ``in`` included, would open the other file.
    h5py = require("h5py", "sim")
    path = node.file.filename
    for part in name.strip("/").split("/"):
        if not isinstance(node, h5py.Group):
            raise DatasetError(
                f"{path}: {_full(node, '')} is a dataset where a group belongs; rebuild the file"
            )
        links, key = node.id.links, part.encode(errors="surrogateescape")
        if not links.exists(key):
            return None
        kind = links.get_info(key).type
        if kind == h5py.h5l.TYPE_HARD:
            node = node[part]
        elif kind == h5py.h5l.TYPE_SOFT:
            if soft_links == 0:
                raise DatasetError(f"{path}: {_full(node, part)} leads through too many links")
            target = links.get_val(key).decode(errors="surrogateescape")
            start = node.file if target.startswith("/") else node
            node = _follow(start, target, soft_links - 1)
            if node is None:
                return None
        else:
            where = links.get_val(key)[0].decode(errors="replace") if kind == h5py.h5l.TYPE_EXTERNAL else ""
            raise DatasetError(
                f"{path}: {_full(node, part)} is a link to another file {where}, which is not read: "
                "copy the data into this file"
            )
    return node


def _check_stored(dataset: h5py.Dataset) -> None:
    """Whether a dataset's values are all in this file, and can be read within bounds."""
    what = f"{dataset.file.filename}: {dataset.name[1:]}"
    if dataset.is_virtual or dataset.external:
        how = "is a virtual dataset over" if dataset.is_virtual else "stores its values in"
        raise DatasetError(f"{what} {how} another file, which is not read: copy the data into this file")
    if not dataset.size:
        return
    places: list[tuple[int, int]] = []  # in the file, of the stored parts: first byte and size
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        complete = stored >= dataset.size * dataset.dtype.itemsize
        if dataset.id.get_offset() is not None:  # a compact one lies in its header
            places.append((dataset.id.get_offset(), stored))
    else:
        chunk = prod(dataset.chunks) * dataset.dtype.itemsize
        if chunk > CHUNK_BYTES:
            raise DatasetError(
                f"{what} has shape {dataset.shape} in chunks of {chunk:.1e} bytes, which would have to "
                "be unpacked whole: write it in smaller ones (h5repack -l CHUNK=...)"
            )
        steps = list(zip(dataset.shape, dataset.chunks, strict=True))
        complete = dataset.id.get_num_chunks() >= prod(ceil(n / c) for n, c in steps)
        if complete:
            parts: dict[tuple[int, ...], tuple[int, int]] = {}
            dataset.id.chunk_iter(lambda p: parts.update({p.chunk_offset: (p.byte_offset, p.size)}))
            places = sorted(parts.values())
            # HDF5 reads a part that its index does not find as zeros.
            if not all(start in parts for start in product(*(range(0, n, c) for n, c in steps))):
                raise DatasetError(f"{what}: its index of chunks is damaged. {_AGAIN}")
    ends = [*(first for first, _ in places[1:]), dataset.file.id.get_filesize()]
    if any(first + size > end for (first, size), end in zip(places, ends, strict=bool(places))):
        raise DatasetError(f"{what}: its values overlap, or lie behind the file's end. {_AGAIN}")
    if not complete:
        raise DatasetError(
            f"{what} has shape {dataset.shape}, but some of its values were never written: the recording "
            "was cut short. Rebuild or remove the demo, or leave it out with a mask."
        )


_IMAGE_BYTES = 2**24  # of images read at once
_LEAVE_OUT = "Rebuild or remove the demo, or leave it out with a mask."


@contextmanager
def open_robomimic(path: str | Path) -> Iterator[h5py.File]:
    """Open a robomimic file for reading; a ``DatasetError`` if it is not whole or has no demos."""
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
        data = member(file, "data", "group")
        if data is None:
            found = ", ".join(names(file)) or "nothing"
            raise DatasetError(f"{path}: no group 'data' (found {found}): not a robomimic file")
        if not names(data):
            raise DatasetError(f"{path}: the group 'data' holds no demos: record or copy some")
        yield file


def _number(path: Path, name: str) -> int:
    if not (name.startswith("demo_") and name[5:].isdecimal()):
        raise DatasetError(f"{path}: data/{name} is not called demo_<number>; rename the group")
    return int(name[5:])


def read_masks(path: str | Path) -> dict[str, set[str]]:
    """The names of the demos in each mask of a robomimic file."""
    with open_robomimic(path) as file:
        return {name: _mask(file, Path(path), name) for name in _mask_names(file)}


def _mask_names(file: h5py.File) -> list[str]:
    group = member(file, "mask", "group")
    return [] if group is None else names(group)


def _mask(file: h5py.File, path: Path, filter_key: str) -> set[str]:
    check_filter_key(path, filter_key, _mask_names(file))
    entries, demos = member(file["mask"], filter_key, "dataset"), len(names(file["data"]))
    what = f"{path}: mask/{filter_key}"
    if entries is None or entries.shape is None or entries.ndim != 1 or entries.dtype.kind not in "SO":
        found = "leads to nothing" if entries is None else f"is {entries}"
        raise DatasetError(
            f"{what} {found}, no list of the names of demos. Choose another filter key or rebuild the mask."
        )
    if len(entries) > demos:
        raise DatasetError(f"{what} has {len(entries)} names, but data holds {demos} demos; rebuild the mask")
    with reading(file, f"mask/{filter_key}"):
        return {entry.decode() for entry in entries[()]}


def _selected(file: h5py.File, path: Path, filter_key: str | None) -> tuple[str, ...]:
    present = set(names(file["data"]))
    selected = present
    if filter_key is not None:
        selected = _mask(file, path, filter_key)
        absent = sorted(selected - present)
        if absent or not selected:
            what = f"demos that data does not hold: {', '.join(absent)}" if absent else "no demos"
            raise DatasetError(
                f"{path}: mask/{filter_key} names {what}. Choose another filter key or rebuild the mask."
            )
    # Numbers are not zero padded: demo_10 comes after demo_9.
    return tuple(sorted(selected, key=lambda name: _number(path, name)))


def _described(file: h5py.File, name: str, default: str | None = None) -> Any:
    """What an attribute of the demos says in JSON."""
    attribute = f"data.attrs[{name!r}]"
    with reading(file, attribute):
        text = file["data"].attrs.get(name, default)
    what = f"{file.filename}: {attribute}"
    if not isinstance(text, str | bytes):
        raise DatasetError(f"{what} is missing, or no text: copy it from the file this one was made from")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # not UTF-8 included
        raise DatasetError(f"{what} is not JSON ({error})") from error


def read_origin(path: Path, demo: str) -> tuple[dict[str, Any] | None, np.ndarray | None]:
    """How the images of a file were rendered, and the first simulator state of a demo, if it says so."""
    with open_robomimic(path) as file:
        rendering = _described(file, "rendering", "null")
        states = member(file, f"data/{demo}/states", "dataset")
        with reading(file, f"data/{demo}/states"):
            state = np.asarray(states[0], np.float64) if states is not None and states.size else None
    return rendering, state


def _widths(path: Path, demo: h5py.Group, keys: Sequence[str]) -> tuple[int, dict[str, int]]:
    """Return the steps of a demo and the width of each key, after checking that they agree."""
    name = demo.name[1:]
    if member(demo, "obs", "group") is None:
        raise DatasetError(
            f"{path}: {name} has no group 'obs'. Raw files (demo_v15.hdf5) have no observations: "
            "use the low_dim file, or add them with robomimic's dataset_states_to_obs.py."
        )
    steps, widths = 0, {}
    for key in ("actions", "rewards", *keys):
        dataset = member(demo, key, "dataset")
        if dataset is None:
            group = demo["obs"] if key.startswith("obs/") else demo
            raise DatasetError(
                f"{path}: {name} has no {key!r}; {group.name[1:]} has {', '.join(names(group))}. "
                "Choose other keys or rebuild the file."
            )
        shape: tuple[int, ...] = dataset.shape or ()
        kind = dataset.dtype.kind
        steps = shape[0] if key == "actions" and shape else steps
        if steps == 0:
            raise DatasetError(f"{path}: {name} has no steps (actions {shape}). {_LEAVE_OUT}")
        if shape[:1] != (steps,):
            raise DatasetError(
                f"{path}: {name}/{key} has shape {shape} but actions has {steps} rows. {_LEAVE_OUT}"
            )
        if len(shape) > 2 or kind not in "fiub":
            raise DatasetError(
                f"{path}: {name}/{key} has shape {shape} and type {dataset.dtype}; only vectors "
                "of numbers can be used. Leave the key out of observation_keys."
            )
        widths[key] = 1 if len(shape) == 1 else shape[1]
    return steps, widths


def _image_sizes(path: Path, demo: h5py.Group, keys: Sequence[str], steps: int) -> dict[int, str]:
    """The sides in pixels of a demo's images, after checking that they are what they should be."""
    name, sizes = demo.name[1:], {}
    for key in keys:
        images = member(demo, f"obs/{key}", "dataset")
        if images is None:
            known = ", ".join(k for k in names(demo["obs"]) if k.endswith("_image")) or "none"
            raise DatasetError(
                f"{path}: {name} has no images {key!r}; it has {known}. Choose other cameras, or render them"
            )
        shape: tuple[int, ...] = images.shape or ()
        wrong = ""
        if images.dtype != "uint8" or len(shape) != 4 or shape[-1] != 3:
            wrong = "images are uint8 [steps, height, width, 3]"
        elif shape[0] != steps:
            wrong = f"but actions has {steps} rows"
        elif shape[1] != shape[2]:
            wrong = "only square images can be used"
        if wrong:
            raise DatasetError(
                f"{path}: {name}/obs/{key} has shape {shape} and type {images.dtype}; {wrong}. Render them "
                "anew"
            )
        sizes[shape[1]] = f"{name}/obs/{key}"
    return sizes


def read_index(
    path: str | Path,
    *,
    filter_key: str | None = None,
    observation_keys: Sequence[str] | None = None,
    image_keys: Sequence[str] = (),
    poses: bool = False,
    demos: int | None = None,
) -> DatasetIndex:
    """Say what a robomimic file holds, by names, shapes and attributes alone; errors name what is wrong.

    Options as of :class:`~warmprior.data.RobomimicExperienceReplay`; ``poses`` also requires the hand pose of
    every arm.
    """
    path = Path(path)
    with open_robomimic(path) as file:
        selected = _selected(file, path, filter_key)
        check_count(path, demos, len(selected))
        selected = selected[:demos]
        env_args = check_env_args(f"{path}: data.attrs['env_args']", _described(file, "env_args"))
        task = task_of_env(env_args)
        observations = member(file, f"data/{selected[0]}/obs", "group")
        available = () if observations is None else tuple(names(observations))
        if observation_keys is not None:
            keys = tuple(observation_keys)
        elif task is not None:
            keys = task.low_dim_keys
        else:
            keys = tuple(key for key in low_dim_keys(arms=2) if key in available)
        if available and not keys:
            raise DatasetError(
                f"{path}: no observations are chosen; name some with observation_keys: {', '.join(available)}"
            )
        wanted = [f"obs/{key}" for key in keys]
        if poses:
            actions = member(file, f"data/{selected[0]}/actions", "dataset")
            width = actions.shape[-1] if actions is not None and actions.shape else 0
            for arm in range(min(width // 7, 2)):
                wanted += [f"obs/robot{arm}_eef_pos", f"obs/robot{arm}_eef_quat"]
        expected, whose = {}, env_args["env_name"]
        if task is not None:
            expected["actions"] = task.action_dim
            if observation_keys is None:
                expected["obs/object"] = task.object_dim
        lengths: list[int] = []
        sides: dict[int, str] = {}
        for name in selected:
            demo = member(file["data"], name, "group")
            if demo is None:  # listed, but not to be found: its index is damaged
                raise DatasetError(f"{path}: data/{name} cannot be read. {_AGAIN}")
            steps, widths = _widths(path, demo, wanted)
            if other := [key for key, width in expected.items() if widths[key] != width]:
                raise DatasetError(
                    f"{path}: data/{name}/{other[0]} has shape {demo[other[0]].shape}; {whose} has "
                    f"{expected[other[0]]} columns. Use data of one environment with pose-delta actions; if "
                    "other observations are meant, name them with observation_keys."
                )
            expected, whose = widths, f"data/{selected[0]} of {env_args['env_name']}"
            lengths.append(steps)
            sides = _image_sizes(path, demo, image_keys, steps) | sides
    if len(sides) > 1:
        listed = ", ".join(f"{size} in {name}" for size, name in sides.items())
        raise DatasetError(f"{path}: images have sides of {listed}, several sizes. Render them anew")
    return DatasetIndex(
        path=path,
        demos=selected,
        lengths=tuple(lengths),
        observation_keys=keys,
        observation_dims=tuple(widths[f"obs/{key}"] for key in keys),
        image_keys=tuple(image_keys),
        image_size=next(iter(sides), 0),
        available_keys=available,
        action_dim=widths["actions"],
        env_args=env_args,
        task=task,
    )


class RobomimicReader(DemonstrationReader):
    """The values of an open file."""

    def __init__(self, file: h5py.File) -> None:
        self.file = file

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read rows of one array of a demo, block by block; ``out`` may be a strided view."""
        dataset = member(self.file, f"data/{demo}/{key}", "dataset")
        if dataset is None:
            raise DatasetError(f"{self.file.filename}: there is no data/{demo}/{key}")
        what = f"{self.name(demo, key)} (shape {dataset.shape})"
        for start in range(0, len(out), BLOCK):
            rows = out[start : start + BLOCK]
            with reading(self.file, f"data/{demo}/{key}"):
                block = dataset[first + start : first + start + len(rows)]
            store_finite(block, rows, what, first + start, _LEAVE_OUT)

    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the images of a demo, block by block."""
        name, target = f"data/{demo}/obs/{key}", out.numpy()
        images: Any = member(self.file, name, "dataset")
        rows = max(1, _IMAGE_BYTES // max(1, out[0].numel()))
        for start in range(0, len(out), rows):
            with reading(self.file, name):
                target[start : start + rows] = images[start : start + rows].transpose(0, 3, 1, 2)

    def name(self, demo: str, key: str) -> str:
        """What errors call an array of a demo."""
        return f"{self.file.filename}: data/{demo}/{key}"
