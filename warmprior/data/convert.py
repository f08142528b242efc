"""Conversion of demonstrations in robomimic's layout to a LeRobotDataset v3."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from warmprior.checks import check_choice
from warmprior.data.checks import DatasetError, declared_poses
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.lerobot_index import (
    DESCRIPTION,
    REWARD,
    SUCCESS,
    action_names,
    layout_of,
    state_names,
)
from warmprior.data.index import DatasetIndex
from warmprior.data.steps import solved
from warmprior.io.extras import require
from warmprior.io.files import check_writable, exclusive, file_digest, write_atomic
from warmprior.keys import ACTION, OBSERVATION

KINDS = ("image", "video")
VIDEO_SIZE = 32  # the smallest side in pixels; the AV1 encoder ends the process below it


def convert_robomimic(
    path: str | Path,
    folder: str | Path,
    *,
    images: Literal["image", "video"] | None = None,
    demos: int | None = None,
    observations: Sequence[str] | None = None,
) -> Path:
    """Write the demonstrations of a robomimic HDF5 file as a LeRobotDataset v3, which LeRobot reads.

    :doc:`/data` has a table of all entries and features. Numbers become float32. The first simulator state is
    kept, so that images can be compared with the simulator's before training. The folder, which is
    returned, is written atomically: an interrupted call leaves none.

    Args:
        path: a robomimic HDF5 file, such as one of scripted demonstrations.
        folder: the folder to write; it must not exist.

    Keyword Args:
        images: format of the file's images, if they are written too: pictures (``"image"``, lossless PNG) or
            videos (``"video"``, lossy, smaller).
        demos: number of demos to convert, the first ones by their numbers; all if ``None``.
        observations: observations to write; by default the task's. If they differ from these, name them
            again when opening the dataset.

    Raises:
        FileNotFoundError: if there is no such file.
        FileExistsError: if ``folder`` exists.
        DatasetError: if the file is invalid, does not describe its environment, or has no images to write.
        ValueError: if ``images`` is unknown, or the file's images are too small for a video.
        OSError: if the disk is full, or another process converts to the same folder.

    Examples:
        >>> from warmprior.data import convert_robomimic
        >>> convert_robomimic("square.hdf5", "square_lerobot")  # doctest: +SKIP
        PosixPath('square_lerobot')
        >>> convert_robomimic("nowhere.hdf5", "out")
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """
    path, folder = Path(path), Path(folder).expanduser()
    demonstrations = RobomimicDemonstrations(path, demos=demos)
    index = demonstrations.index(observations)
    if not index.env_args:
        raise DatasetError(
            f"{path} has no data.attrs['env_args'], which say how fast it was recorded (control_freq): write "
            "them, or train on the file itself"
        )
    if images is not None:
        check_choice("images", images, KINDS)
        keys = [f"{camera}_image" for camera in index.cameras]
        if not keys:
            raise DatasetError(f"{path} has no images: render them first, or use images=None")
        index = demonstrations.index(observations, keys)
        side = min(map(min, index.image_shapes))
        if images == "video" and side < VIDEO_SIZE:
            raise ValueError(f"{path}: a video needs {VIDEO_SIZE} pixels, not {side}; use images='image'")
    if os.path.lexists(folder):
        raise FileExistsError(f"{folder} exists: choose another folder, or remove it")
    fps = index.env_args["env_kwargs"].get("control_freq", 20)
    if fps != int(fps):
        raise DatasetError(f"{path}: control_freq is {fps}, and LeRobot needs a whole number")
    datasets = require("lerobot.datasets", "lerobot")
    check_writable(folder.parent)
    parts = folder.with_name(f".{folder.name}.converting")
    with exclusive(parts):
        whole = parts / folder.name
        try:
            # The files that a killed process left are incomplete.
            shutil.rmtree(whole, ignore_errors=True)
            _write(datasets, demonstrations, index, whole, int(fps), images)
            os.rename(whole, folder)
        finally:
            shutil.rmtree(parts, ignore_errors=True)
    return folder


def _features(
    index: DatasetIndex,
    layout: Mapping[str, Mapping[str, int]],
    outcome: Mapping[str, torch.Tensor],
    images: str | None,
) -> dict[str, Any]:
    def feature(dtype: str, shape: tuple[int, ...], names: list[str] | None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": shape, "names": names}

    arms, rest = divmod(index.action_dim, 7)
    poses = not rest and declared_poses(index.path, index.env_args) is not None
    names = {"action": action_names(arms) if poses else None}
    names |= {name: state_names(widths) for name, widths in layout.items()}
    sizes = {"action": index.action_dim} | {name: sum(w.values()) for name, w in layout.items()}
    features = {name: feature("float32", (size,), names[name]) for name, size in sizes.items()}
    kinds = {name: "bool" if value.dtype == torch.bool else "float32" for name, value in outcome.items()}
    features |= {name: feature(kind, (1,), None) for name, kind in kinds.items()}
    sides, shapes = ["height", "width", "channels"], zip(index.image_keys, index.image_shapes, strict=True)
    return features | {_camera(key): feature(str(images), (*shape, 3), sides) for key, shape in shapes}


def _camera(key: str) -> str:
    return f"observation.images.{key.removesuffix('_image')}"


def _write(
    datasets: Any,
    demonstrations: RobomimicDemonstrations,
    index: DatasetIndex,
    root: Path,
    fps: int,
    images: Literal["image", "video"] | None,
) -> None:
    layout = layout_of(dict(zip(index.observation_keys, index.observation_dims, strict=True)))
    data = demonstrations.steps(index.observation_keys, actions="stored")
    outcome = _outcome(data, index)
    dataset = datasets.LeRobotDataset.create(
        f"local/{root.name}",
        fps,
        _features(index, layout, outcome, images),
        root=root,
        use_videos=images == "video",
    )
    numbers = {"action": data[ACTION], **outcome}
    vectors = data[OBSERVATION].split(index.observation_dims, -1)
    parts = dict(zip(index.observation_keys, vectors, strict=True))
    for feature, widths in layout.items():
        numbers[feature] = torch.cat([parts[key] for key in widths], -1)
    rows = np.cumsum([0, *index.lengths])
    bar = tqdm(pairwise(rows), f"convert {index.path.stem}", len(index.lengths), unit="demo")
    with quietly(), demonstrations.reader(index) as reader:
        try:
            for demo, (start, stop) in zip(index.demos, bar, strict=True):
                pictures = {key: chain.from_iterable(reader.images(demo, key)) for key in index.image_keys}
                for row in range(start, stop):
                    frame = {name: value[row].numpy() for name, value in numbers.items()}
                    frame |= {_camera(k): next(p).permute(1, 2, 0).numpy() for k, p in pictures.items()}
                    dataset.add_frame(frame | {"task": index.task_name})
                # Parallel encoding would start a process, which imports LeRobot, per camera and episode.
                dataset.save_episode(parallel_encoding=False)
        except BaseException:
            # Without this, the garbage collector would write its files after the folder is removed.
            with suppress(Exception):
                dataset.finalize()
            raise
        dataset.finalize()
    described = json.dumps(_description(demonstrations, index, layout), indent=1)
    write_atomic(root / DESCRIPTION, lambda file: file.write_text(described))


def _outcome(data: TensorDictBase, index: DatasetIndex) -> dict[str, torch.Tensor]:
    """Return the features of the outcome; rewards that are all zero tell neither success nor failure."""
    reward = data["next", "reward"]
    success = solved(reward, index.env_args)
    features = {"next.done": data["next", "done"]}
    features |= {REWARD: reward} if reward.any() else {}
    return features | ({SUCCESS: success} if success.any() else {})


def _description(
    demonstrations: RobomimicDemonstrations, index: DatasetIndex, layout: Mapping[str, Mapping[str, int]]
) -> dict[str, Any]:
    """Return the facts for which LeRobot's own files have no place."""
    observations: dict[str, tuple[str, int, int]] = {}
    for feature, widths in layout.items():
        borders = pairwise(np.cumsum([0, *widths.values()]).tolist())
        observations |= {key: (feature, *border) for key, border in zip(widths, borders, strict=True)}
    rendering, state = demonstrations.origin(index)
    masks = {
        name: [index.demos.index(demo) for demo in demos if demo in index.demos]
        for name, demos in demonstrations.masks().items()
    }
    return {
        "format": 1,
        "source": {"file": index.path.name, "sha256": file_digest(index.path)},
        "env_args": index.env_args,
        "observations": {key: observations[key] for key in index.observation_keys},
        "masks": {name: sorted(numbers) for name, numbers in masks.items()},
        "rendering": rendering,
        "first_state": None if state is None else state.tolist(),
    }


@contextmanager
def quietly() -> Iterator[None]:
    """Hide the bars and banners of LeRobot's libraries, and undo the priority of its AV1 encoder.

    As root it would run at real-time priority and starve all other processes.
    """
    utils = require("lerobot.utils.utils", "lerobot")
    linux = hasattr(os, "sched_setscheduler")
    scheduled = (os.sched_getscheduler(0), os.sched_getparam(0)) if linux else None
    try:
        os.environ.setdefault("SVT_LOG", "1")  # the encoder prints errors only
        with utils.SuppressProgressBars():
            yield
    finally:
        if scheduled is not None and os.sched_getscheduler(0) != scheduled[0]:
            os.sched_setscheduler(0, *scheduled)
