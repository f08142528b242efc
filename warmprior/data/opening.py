"""Where demonstrations are: a robomimic HDF5 file, or ``lerobot:`` and a LeRobotDataset."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from warmprior.data.hdf5 import read_index
from warmprior.data.hdf5_members import DatasetError
from warmprior.data.index import DatasetIndex
from warmprior.data.lerobot import (
    LeRobotExperienceReplay,
    LeRobotReader,
    fetch_lerobot,
    find_lerobot,
    is_remote,
)
from warmprior.data.lerobot_index import LeRobotIndex
from warmprior.data.replay import DemonstrationReplay
from warmprior.data.robomimic import RobomimicExperienceReplay
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest

__all__ = [
    "LEROBOT",
    "Demonstrations",
    "check_place",
    "name_of_place",
    "open_demonstrations",
    "resolved_place",
]

LEROBOT = "lerobot:"
"""What stands before the folder or repository of a LeRobotDataset where a file could be meant."""


def _lerobot(place: str | Path) -> str | None:
    """The folder or repository behind the prefix, if there is one."""
    text = str(place)
    return text.removeprefix(LEROBOT) if text.startswith(LEROBOT) else None


def check_place(place: str | Path, option: str) -> None:
    """Refuse a place where there can be no demonstrations; nothing is read or fetched.

    A place is an HDF5 file, or ``lerobot:`` and a folder or repository; errors name it by the option.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ImportError: if what reads it is not installed.

    Examples:
        >>> from warmprior.data.opening import check_place
        >>> check_place("lerobot:user/square", "--dataset")
        >>> check_place("lerobot:./square", "--dataset")
        Traceback (most recent call last):
            ...
        FileNotFoundError: --dataset lerobot:./square: no such folder, and no repository user/name of the hub
    """
    dataset = _lerobot(place)
    if dataset is None:
        if not Path(place).is_file():
            folder = (Path(place) / "meta" / "info.json").is_file()
            hint = f"; for a LeRobotDataset write {LEROBOT}{place}" if folder else ""
            raise FileNotFoundError(f"{option} {place}: no such file{hint}")
        return
    require("lerobot.datasets", "lerobot")
    if not is_remote(dataset) and not Path(dataset).expanduser().is_dir():
        raise FileNotFoundError(f"{option} {place}: no such folder, and no repository user/name of the hub")


def name_of_place(place: str | Path) -> str:
    """A short name: that of the file without its ending, of the folder, or of the repository."""
    dataset = _lerobot(place)
    return Path(place).stem if dataset is None else Path(dataset).resolve().name


def resolved_place(place: Path) -> str:
    """The same place as seen from any working directory."""
    dataset = _lerobot(place)
    if dataset is None:
        return str(place.resolve())
    return str(place) if is_remote(dataset) else f"{LEROBOT}{Path(dataset).expanduser().resolve()}"


def open_demonstrations(
    place: str | Path, env_args: Mapping[str, Any] | None = None, mask: str | None = None
) -> Demonstrations:
    """What reads the demonstrations at a place, see :func:`check_place`.

    All of them, or those of a mask, such as ``"train"``. ``env_args`` are of the environment, for a
    LeRobotDataset that does not describe its own.

    Examples:
        >>> from warmprior.data.opening import open_demonstrations
        >>> open_demonstrations("lerobot:user/square").name  # nothing is fetched yet
        'lerobot:square'
    """
    dataset = _lerobot(place)
    return _RobomimicFile(place, mask) if dataset is None else _LeRobotFolder(dataset, env_args, mask)


class Demonstrations(ABC):
    """Demonstrations at one place, of which nothing big is read before :meth:`replay`.

    Examples:
        >>> from warmprior.data.opening import open_demonstrations
        >>> place = open_demonstrations("nowhere.hdf5")  # not looked at yet
        >>> place.index()
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """

    name: str
    """What results call the place."""

    @abstractmethod
    def index(self, **options: Any) -> DatasetIndex:
        """What is there; options (``image_keys``, ``demos`` and so on) as of ``read_index``."""

    @abstractmethod
    def replay(self, **options: Any) -> DemonstrationReplay:
        """Read them; options as of :class:`RobomimicExperienceReplay`."""

    @abstractmethod
    def digest(self, image_keys: Sequence[str] = (), demos: int | None = None) -> str:
        """SHA-256 of the contents, as far as these images and that many demonstrations are used."""

    @abstractmethod
    def with_images(self, cameras: Sequence[str], size: int, *, demos: int | None, fast: bool) -> Self:
        """The same demonstrations with images of some cameras.

        Those that are there are compared with the simulator's; others are rendered where states are known.

        Raises:
            DatasetError: if the images show something else than the simulator, or cannot be rendered.
        """


def _called(name: str, mask: str | None) -> str:
    return name if mask is None else f"{name} (mask {mask})"


class _RobomimicFile(Demonstrations):
    def __init__(self, path: str | Path, mask: str | None = None) -> None:
        self.path, self.mask = Path(path), mask
        self.name = _called(self.path.name, mask)

    def index(self, **options: Any) -> DatasetIndex:
        return read_index(self.path, filter_key=self.mask, **options)

    def replay(self, **options: Any) -> RobomimicExperienceReplay:
        return RobomimicExperienceReplay(self.path, filter_key=self.mask, **options)

    def digest(self, image_keys: Sequence[str] = (), demos: int | None = None) -> str:
        whole = file_digest(self.path)
        return whole if self.mask is None else digest_of(whole, self.mask)

    def with_images(
        self, cameras: Sequence[str], size: int, *, demos: int | None, fast: bool
    ) -> _RobomimicFile:
        from warmprior.data.render import compare_images, render_demonstrations

        if set(cameras) <= set(self.index(demos=demos).cameras):
            compare_images(self.path, [f"{camera}_image" for camera in cameras], fast)
            return self
        if self.mask is not None:
            raise DatasetError(
                f"{self.path} has no images of {', '.join(cameras)}, and files are rendered whole: render it "
                "first (python -m warmprior render), or leave the mask out"
            )
        return _RobomimicFile(render_demonstrations(self.path, cameras, size, demos=demos, fast=fast))


class _LeRobotFolder(Demonstrations):
    def __init__(self, dataset: str, env_args: Mapping[str, Any] | None, mask: str | None) -> None:
        self.dataset, self.mask = dataset, mask
        self._given: dict[str, Any] = {"env_args": env_args, "filter_key": mask}
        self.name = _called(f"{LEROBOT}{name_of_place(LEROBOT + dataset)}", mask)

    def index(self, **options: Any) -> LeRobotIndex:
        return find_lerobot(self.dataset, **self._given, **options)

    def _fetched(self, **options: Any) -> LeRobotIndex:
        return fetch_lerobot(self.dataset, **self._given, **options)

    def replay(self, **options: Any) -> LeRobotExperienceReplay:
        return LeRobotExperienceReplay(self.dataset, **self._given, **options)

    def digest(self, image_keys: Sequence[str] = (), demos: int | None = None) -> str:
        whole = self._fetched(image_keys=image_keys, demos=demos).digest()
        return whole if self.mask is None else digest_of(whole, self.mask)

    def with_images(
        self, cameras: Sequence[str], size: int, *, demos: int | None, fast: bool
    ) -> _LeRobotFolder:
        from warmprior.data.render import compare_first_images

        keys = [f"{camera}_image" for camera in cameras]
        index, images = self._fetched(image_keys=keys, demos=1), {}
        for key in keys:
            image = torch.empty(1, 3, index.image_size, index.image_size, dtype=torch.uint8)
            LeRobotReader(index).images(index.demos[0], key, image)
            images[key] = image[0].permute(1, 2, 0).numpy()
        state = index.described.get("first_state")
        compare_first_images(
            index,
            images,
            state=None if state is None else np.asarray(state, np.float64),
            rendering=index.described.get("rendering"),
            fast=fast,
            advice="render the robomimic file anew (python -m warmprior render) and convert it again",
        )
        return self
