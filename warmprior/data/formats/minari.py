"""Minari's demonstrations: datasets in the Farama Foundation's format, read by its own package.

That believes every file, follows links out of it, and waits for pipes; :mod:`.hdf5` has the checks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from torch import Tensor

from warmprior.checks import check_shape
from warmprior.data.checks import DatasetError, check_count, reading, store_finite, unknown_name_error
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.formats.hdf5_file import check_members, member, names, open_hdf5
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.io.extras import require
from warmprior.io.files import check_regular_files, digest_of, file_digest, read_json

_AGAIN = "Download it again."

FORMATS = ("hdf5", "parquet", "arrow")
"""Minari's forms of files that are checked and read here."""

SUCCESS_NAMES = ("success", "is_success")
"""The names of success in the ``info`` of Gymnasium's environments."""


def load_minari(name: str | Path) -> Any:
    """Return the dataset with a name such as ``"D4RL/door/human-v2"``, after downloading it if needed.

    Raises:
        FileNotFoundError: if the dataset is not on this machine and cannot be downloaded.
        DatasetError: if the dataset is damaged.
    """
    minari = require("minari", "minari")
    folder = Path(minari.storage.get_dataset_path(name)) / "data"
    try:
        if not folder.exists():
            minari.download_dataset(name)
    except Exception as error:
        raise FileNotFoundError(
            f"minari:{name}: no such dataset at {folder} ({error}): `minari list remote` shows public "
            "datasets, and MINARI_DATASETS_PATH is the folder of local ones"
        ) from error
    with reading(f"{folder}: the Minari dataset", _AGAIN):
        _check_files(folder)
        return _parsed(name, folder, (folder / "metadata.json").read_bytes())


@lru_cache(maxsize=2)
def _parsed(name: str | Path, folder: Path, metadata: bytes) -> Any:
    """Return the dataset of these metadata: to parse the bounds of every pixel takes seconds."""
    return require("minari", "minari").load_dataset(name)


def _check_files(folder: Path) -> None:
    """Raise an error for files that cannot be opened, and if the metadata count other episodes."""
    check_regular_files(folder)
    metadata = read_json(folder / "metadata.json")
    if (form := metadata["data_format"]) not in FORMATS:
        raise DatasetError(
            f"{folder}: metadata.json has data_format={str(form)[:80]!r}, but those known here are "
            f"{', '.join(FORMATS)}: convert it to one of them with Minari"
        )
    episodes = [path.name for path in folder.iterdir() if path.is_dir()]
    for episode in episodes if form != "hdf5" else ():
        files = sorted(path.name for path in (folder / episode).iterdir())
        parts = [file for file in files if file[0] not in "_." and file != "metadata.json"]
        if len(parts) != 1:  # Minari reads one of them
            what = f"{len(parts)} files of steps, not 1 ({', '.join(parts)})"
            raise DatasetError(f"{folder / episode} has {what}. {_AGAIN}")
    if (data := folder / "main_data.hdf5").exists():
        with open_hdf5(data) as file:
            episodes = names(file)
            for episode in episodes:
                if (group := member(file, episode, "group")) is not None:
                    with reading(f"{data}: the metadata of {episode}", _AGAIN):
                        dict(group.attrs)  # which checks their heaps
    count = metadata["total_episodes"]
    if count != len(episodes):
        raise DatasetError(f"{folder}: metadata.json counts {count} episodes, not {len(episodes)}. {_AGAIN}")


def _spaces(space: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a space by name; those of nested dictionaries are ``"outer/inner"``."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping):
        for key, part in inner.items():
            yield from _spaces(part, f"{name}/{key}" if name else str(key))
    else:
        yield name or "observation", space


def _is_vector(space: Any) -> bool:
    return len(space.shape or ()) == 1 and space.dtype.kind in "fiub"


def _is_picture(space: Any) -> bool:
    shape: tuple[int, ...] = space.shape or ()
    return len(shape) == 3 and min(shape) > 0 and shape[2] == 3 and space.dtype == np.uint8


class MinariReader(DemonstrationReader):
    """A reader of a dataset's values."""

    def __init__(self, name: str | Path, index: DatasetIndex) -> None:
        self._dataset, self._path = load_minari(name), index.path
        self._shapes = dict(zip(index.image_keys, index.image_shapes, strict=True))
        self._steps = dict(zip(index.demos, index.lengths, strict=True))
        self.episode = lru_cache(maxsize=1)(self._read)  # arrays of one episode are read one after another

    def _read(self, demo: str) -> Any:
        with reading(f"{self._path}: episode {demo}", _AGAIN):
            if (data := self._path / "main_data.hdf5").exists():
                with open_hdf5(data) as file:
                    check_members(file, f"episode_{demo}")
            return next(self._dataset.iterate_episodes([int(demo)]))

    def _values(self, demo: str, key: str) -> np.ndarray:
        """Return an array of an episode, which has a row of numbers for each of its steps."""
        episode, steps = self.episode(demo), self._steps[demo]
        with reading(self.name(demo, key), _AGAIN):
            if key.startswith("obs/"):
                observations = episode.observations
                if isinstance(observations, Mapping):
                    for part in key.removeprefix("obs/").split("/"):
                        observations = observations[part]
                values = np.asarray(observations)[:-1]  # the last one follows the last action
            else:
                values = np.asarray(getattr(episode, key))
            if values.dtype.kind not in "fiub" or len(values) != steps:
                rows = f"{len(values)} rows of {values.dtype}"
                raise ValueError(f"{rows}, but total_steps counts {steps} steps with numbers")
        return values

    @override
    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        values = self._values(demo, key)
        block = values.reshape(len(values), -1)[first : first + len(out)]
        if block.shape != out.shape:
            raise DatasetError(
                f"{self.name(demo, key)} has shape {values.shape}, not {list(out.shape)}: download it again"
            )
        store_finite(block, out, self.name(demo, key), "Delete the episode, or download it again.", first)

    @override
    def terminated(self, demo: str) -> bool | None:
        last = np.empty((1, 1))
        self.numbers(demo, "terminations", last, self._steps[demo] - 1)
        return bool(last)

    @override
    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        images = self._values(demo, f"obs/{key}")
        with reading(self.name(demo, key), _AGAIN):
            check_shape("an image", images[0], (*self._shapes[key], 3))
        yield torch.from_numpy(images).permute(0, 3, 1, 2)

    @override
    def decoders(self, key: str) -> Sequence[str]:
        return "minari", "pillow"  # it may store JPEG

    @override
    def name(self, demo: str, key: str) -> str:
        return f"{self._path}: {key.removeprefix('obs/')} of episode {demo}"


class MinariDemonstrations(Demonstrations):
    """The demonstrations of a Minari dataset, such as ``"minari:D4RL/door/human-v2"``.

    A dataset that is not in Minari's folder (``MINARI_DATASETS_PATH``) is downloaded. Observations are by
    default all vectors; entries of dictionaries have the names ``"outer/inner"``. An observation that follows
    the last action of an episode is left out.
    """

    prefix = "minari:"

    @property
    @override
    def title(self) -> str:
        return str(self.place).replace("/", "-")

    @override
    def check(self) -> None:
        require("minari", "minari")

    @override
    def index(
        self, observations: Sequence[str] | None = None, images: Sequence[str] = (), *, poses: bool = False
    ) -> DatasetIndex:
        dataset = load_minari(self.place)
        where = Path(dataset.storage.data_path)
        if self.mask is not None or poses:
            what = "masks" if poses is False else "poses of a gripper, from which absolute actions are made"
            raise DatasetError(f"{where}: a Minari dataset has no {what}: leave the option out")
        action = dataset.action_space
        if getattr(action, "dtype", None) is None or action.dtype.kind != "f" or len(action.shape) != 1:
            raise DatasetError(f"{where}: actions are {action}, but a flow needs one vector of real numbers")
        spaces = dict(_spaces(dataset.observation_space))
        vectors = {key: math.prod(space.shape) for key, space in spaces.items() if _is_vector(space)}
        if not vectors:
            raise DatasetError(
                f"{where}: observations are {dataset.observation_space}, but a policy needs a vector, or a "
                "dictionary with one: record them with gymnasium.wrappers.FlattenObservation"
            )
        pictures = {key: space.shape[:2] for key, space in spaces.items() if _is_picture(space)}
        chosen = tuple(vectors if observations is None else observations)
        for kind, wanted, present in (("observation", chosen, vectors), ("image", images, pictures)):
            for key in wanted:
                if key not in present:
                    error = unknown_name_error(where, kind, key, present)
                    raise DatasetError(f"{error} ({key!r} is {spaces[key]})") if key in spaces else error
        check_count(where, self.demos, dataset.total_episodes)
        episodes = [int(i) for i in dataset.episode_indices][: self.demos]
        whole = self.demos in (None, dataset.total_episodes)
        with reading(f"{where}: its episodes", _AGAIN):
            steps = [int(facts["total_steps"]) for facts in dataset.storage.get_episode_metadata(episodes)]
            counted = dataset.total_steps if whole else sum(steps)
        if counted != sum(steps):
            differs = f"metadata.json counts {counted} steps, but the episodes {sum(steps)}"
            raise DatasetError(f"{where}: {differs}. {_AGAIN}")
        return DatasetIndex(
            path=where,
            demos=tuple(map(str, episodes)),
            lengths=tuple(steps),
            observation_keys=chosen,
            observation_dims=tuple(vectors[key] for key in chosen),
            **self.image_entries(images, pictures),
            available_keys=tuple(spaces),
            taken_by={key: "images" if key in pictures else "" for key in spaces if key not in vectors},
            action_dim=action.shape[0],
            whole=whole,
        )

    @contextmanager
    @override
    def reader(self, index: DatasetIndex) -> Iterator[MinariReader]:
        yield MinariReader(self.place, index)

    @override
    def contents(self, index: DatasetIndex) -> str:
        return digest_of(*map(file_digest, sorted(path for path in index.path.rglob("*") if path.is_file())))

    def environment(self, index: DatasetIndex) -> dict[str, Any]:
        """Return also the steps' name of success, if they have one."""
        dataset = load_minari(self.place)
        spec = dataset.env_spec
        if spec is None:
            return {}
        infos = MinariReader(self.place, index).episode(index.demos[0]).infos or {}
        described = {
            "id": spec.id,
            "kwargs": spec.kwargs,
            "wrappers": [wrapper.name for wrapper in spec.additional_wrappers or ()],
            "max_episode_steps": spec.max_episode_steps,
            "success": next((key for key in SUCCESS_NAMES if key in infos), None),
            "dataset": str(self),
        }
        return {"gymnasium": described}
