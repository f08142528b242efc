"""Minari's demonstrations: datasets in the Farama Foundation's format, read by its own package."""

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

from warmprior.data.demonstrations import Demonstrations
from warmprior.data.index import (
    DatasetError,
    DatasetIndex,
    DemonstrationReader,
    check_count,
    reading,
    store_finite,
    unknown_name_error,
)
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest

_AGAIN = "Download it again."

SUCCESS_NAMES = ("success", "is_success")
"""The names of success in the ``info`` of Gymnasium's environments."""


def load_minari(name: str | Path) -> Any:
    """Return the dataset with a name such as ``"D4RL/door/human-v2"``, after downloading it if needed.

    Raises:
        FileNotFoundError: if the dataset is not on this machine and cannot be downloaded.
        DatasetError: if the dataset is damaged.
    """
    minari = require("minari", "minari")
    try:
        return minari.load_dataset(name, download=True)
    except Exception as error:
        folder = Path(minari.storage.get_dataset_path(name))
        if (folder / "data").exists():
            raise DatasetError(
                f"{folder}: not a readable Minari dataset ({error}): download it again"
            ) from error
        raise FileNotFoundError(
            f"minari:{name}: no such dataset at {folder} ({error}): `minari list remote` shows public "
            "datasets, and MINARI_DATASETS_PATH is the folder of local ones"
        ) from error


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

    def __init__(self, name: str | Path, path: Path) -> None:
        self._dataset, self._path = load_minari(name), path
        self._episode = lru_cache(maxsize=1)(self._read)  # arrays of one episode are read one after another

    def _read(self, demo: str) -> Any:
        with reading(f"{self._path}: episode {demo}", _AGAIN):
            return next(self._dataset.iterate_episodes([int(demo)]))

    def _values(self, demo: str, key: str) -> np.ndarray:
        episode = self._episode(demo)
        if not key.startswith("obs/"):
            return np.asarray(getattr(episode, key))
        observations = episode.observations
        if isinstance(observations, Mapping):
            for part in key.removeprefix("obs/").split("/"):
                observations = observations[part]
        return np.asarray(observations)[:-1]  # the last one follows the last action

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
        return bool(self._values(demo, "terminations")[-1])

    @override
    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        yield torch.from_numpy(self._values(demo, f"obs/{key}")).permute(0, 3, 1, 2)

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
        where = Path(dataset.spec.data_path)
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
                    raise unknown_name_error(where, kind, key, present)
        check_count(where, self.demos, dataset.total_episodes)
        episodes = [int(i) for i in dataset.episode_indices][: self.demos]
        with reading(f"{where}: its episodes", _AGAIN):
            steps = [int(facts["total_steps"]) for facts in dataset.storage.get_episode_metadata(episodes)]
        if not steps or min(steps) < 1:
            raise DatasetError(f"{where}: there is no demonstration, or an empty one: delete it")
        return DatasetIndex(
            path=where,
            demos=tuple(map(str, episodes)),
            lengths=tuple(steps),
            observation_keys=chosen,
            observation_dims=tuple(vectors[key] for key in chosen),
            **self.pictured(images, pictures),
            available_keys=tuple(spaces),
            taken_by={key: "images" if key in pictures else "" for key in spaces if key not in vectors},
            action_dim=action.shape[0],
            whole=self.demos in (None, dataset.total_episodes),
        )

    @contextmanager
    @override
    def reader(self, index: DatasetIndex) -> Iterator[MinariReader]:
        yield MinariReader(self.place, index.path)

    @override
    def contents(self, index: DatasetIndex) -> str:
        return digest_of(*map(file_digest, sorted(path for path in index.path.rglob("*") if path.is_file())))

    def environment(self, index: DatasetIndex) -> dict[str, Any]:
        """Return also the steps' name of success, if they have one."""
        dataset = load_minari(self.place)
        spec = dataset.env_spec
        if spec is None:
            return {}
        with reading(f"{dataset.spec.data_path}: the first episode", _AGAIN):
            infos = next(dataset.iterate_episodes()).infos or {}
        described = {
            "id": spec.id,
            "kwargs": dict(spec.kwargs or {}),
            "wrappers": [wrapper.name for wrapper in spec.additional_wrappers or ()],
            "max_episode_steps": spec.max_episode_steps,
            "success": next((key for key in SUCCESS_NAMES if key in infos), None),
        }
        return {"gymnasium": described}
