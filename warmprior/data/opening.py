"""Where demonstrations are: a robomimic HDF5 file, or ``lerobot:`` and a LeRobotDataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.data.hdf5 import read_index, read_origin
from warmprior.data.lerobot import LeRobotExperienceReplay
from warmprior.data.lerobot_index import LeRobotIndex, is_remote, read_lerobot_index
from warmprior.data.replay import DatasetError, DatasetIndex, DemonstrationReplay
from warmprior.data.robomimic import RobomimicExperienceReplay
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest
from warmprior.keys import OBSERVATION

LEROBOT = "lerobot:"
"""What stands before the folder or repository of a LeRobotDataset where a file could be meant."""


def _lerobot(place: str | Path) -> str | None:
    """The folder or repository behind the prefix, if there is one."""
    text = str(place)
    return text.removeprefix(LEROBOT) if text.startswith(LEROBOT) else None


def check_place(place: str | Path, option: str) -> None:
    """Refuse a place where there can be no demonstrations; nothing is read or fetched.

    A place is an HDF5 file, or ``lerobot:`` and a folder or repository; errors name it by the option.

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


class Demonstrations:
    """Demonstrations at one place (:func:`check_place`), of which nothing big is read before :meth:`replay`.

    ``env_args`` are for a LeRobotDataset that does not describe its own environment; a ``mask``, such as
    ``"train"``, selects some of them. ``name`` is what results call the place.

    Examples:
        >>> from warmprior.data.opening import Demonstrations
        >>> Demonstrations("lerobot:user/square").name  # nothing is fetched yet
        'lerobot:square'
    """

    def __init__(
        self, place: str | Path, env_args: Mapping[str, Any] | None = None, mask: str | None = None
    ) -> None:
        dataset = _lerobot(place)
        self._lerobot, self._path = dataset is not None, Path(place) if dataset is None else dataset
        self._mask = mask
        self._options: dict[str, Any] = {"filter_key": mask}
        if self._lerobot:
            self._options["env_args"] = env_args
        name = f"{LEROBOT}{name_of_place(place)}" if self._lerobot else Path(place).name
        self.name = name if mask is None else f"{name} (mask {mask})"

    def index(self, **options: Any) -> DatasetIndex:
        """What is there; options (``image_keys``, ``demos`` and so on) as of ``read_index``."""
        read = read_lerobot_index if self._lerobot else read_index
        return read(self._path, **self._options, **options)

    def replay(self, **options: Any) -> DemonstrationReplay:
        """Read them; options as of :class:`RobomimicExperienceReplay`."""
        kind = LeRobotExperienceReplay if self._lerobot else RobomimicExperienceReplay
        return kind(self._path, **self._options, **options)

    def digest(self, image_keys: Sequence[str] = (), demos: int | None = None) -> str:
        """SHA-256 of the contents, as far as these images and that many demonstrations are used."""
        used: dict[str, Any] = {"image_keys": image_keys, "demos": demos}
        if self._lerobot:
            whole = read_lerobot_index(self._path, fetch=True, **self._options, **used).digest()
        else:
            whole = file_digest(Path(self._path))
        return whole if self._mask is None else digest_of(whole, self._mask)

    def with_images(
        self, cameras: Sequence[str], size: int, *, demos: int | None, fast: bool
    ) -> Demonstrations:
        """The same demonstrations with images of some cameras, compared with the simulator's, or rendered.

        A ``DatasetError`` if they show something else than the simulator, or cannot be rendered.
        """
        from warmprior.data.render import compare_first_images, render_demonstrations

        keys = [f"{camera}_image" for camera in cameras]
        advice = "render the robomimic file anew (python -m warmprior render) and convert it again"
        if not self._lerobot:
            path = Path(self._path)
            advice = f"render these anew (python -m warmprior render {path})"
            if not set(cameras) <= set(self.index(demos=demos).cameras):
                if self._mask is not None:
                    raise DatasetError(
                        f"{path} has no images of {', '.join(cameras)}, and files are rendered whole: render "
                        "it first (python -m warmprior render), or leave the mask out"
                    )
                return Demonstrations(render_demonstrations(path, cameras, size, demos=demos, fast=fast))
        index = self.index(image_keys=keys, demos=1)
        if isinstance(index, LeRobotIndex):
            rendering, state = (index.described.get(name) for name in ("rendering", "first_state"))
        else:
            rendering, state = read_origin(index.path, index.demos[0])
        first = self.replay(image_keys=keys, demos=1).data[OBSERVATION][0]
        images = {camera: first[f"{camera}_image"].permute(1, 2, 0).numpy() for camera in cameras}
        compare_first_images(index, images, state, rendering, fast, advice)
        return self
