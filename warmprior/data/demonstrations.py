"""Places of demonstrations: robomimic HDF5 files, and LeRobot and Minari datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.data.formats.hdf5 import RobomimicDemonstrations, read_index
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.lerobot_index import camera_images, read_lerobot_index
from warmprior.data.formats.minari import MinariDemonstrations, minari_environment, read_minari_index
from warmprior.data.replay import DatasetIndex, DemonstrationReplay
from warmprior.io.files import digest_of, file_digest

LEROBOT, MINARI = "lerobot:", "minari:"
"""The prefixes of a LeRobotDataset's folder or repository, and of a Minari dataset's name."""


def dataset_name(place: str | Path, prefix: str) -> str | None:
    """Return the part of a place after a prefix, :data:`LEROBOT` or :data:`MINARI`, if it begins with it."""
    text = str(place)
    return text.removeprefix(prefix) if text.startswith(prefix) else None


def name_of_place(place: str | Path) -> str:
    """Return the short name of a file, without its ending, or of a folder, repository or dataset."""
    if (name := dataset_name(place, MINARI)) is not None:
        return name.replace("/", "-")
    folder = dataset_name(place, LEROBOT)
    return Path(place).stem if folder is None else Path(folder).resolve().name


class Demonstrations:
    """The demonstrations at one place; their values are only read by :meth:`replay`.

    A place is an HDF5 file, ``lerobot:`` and the folder or repository of a LeRobotDataset, or ``minari:`` and
    the name of a Minari dataset.

    ``env_args`` are for a LeRobotDataset that does not describe its own environment; a ``mask``, such as
    ``"train"``, selects some demonstrations. ``name`` is the name of the place in results.

    Examples:
        >>> from warmprior.data.demonstrations import Demonstrations
        >>> Demonstrations("lerobot:user/square").name  # nothing is fetched yet
        'lerobot:square'
    """

    def __init__(
        self, place: str | Path, env_args: Mapping[str, Any] | None = None, mask: str | None = None
    ) -> None:
        self._mask = mask
        self._options: dict[str, Any] = {"filter_key": mask}
        kinds: dict[str, tuple[Any, Any]] = {
            LEROBOT: (read_lerobot_index, LeRobotDemonstrations),
            MINARI: (read_minari_index, MinariDemonstrations),
            "": (read_index, RobomimicDemonstrations),
        }
        self._prefix = next(prefix for prefix in kinds if str(place).startswith(prefix))
        self._place: Any = str(place).removeprefix(self._prefix)
        self._index, self._replay = kinds[self._prefix]
        if self._prefix == LEROBOT:
            self._options["env_args"] = env_args
        name = f"{self._prefix}{name_of_place(place)}" if self._prefix else Path(place).name
        self.name = name if mask is None else f"{name} (mask {mask})"

    def image_keys(self, names: Sequence[str]) -> list[str]:
        """Return policies' names of images; LeRobot's own, ``observation.images.front``, are converted."""
        images = camera_images(name for name in names if name.startswith("observation."))
        converted = {name: key for key, name in images.items()}
        return [converted.get(name, name) for name in names]

    def index(self, **options: Any) -> DatasetIndex:
        """Return the index, with options of ``read_index`` (``image_keys``, ``demos`` and so on)."""
        return self._index(self._place, **self._options, **options)

    def replay(self, **options: Any) -> DemonstrationReplay:
        """Read the demonstrations, with options of :class:`RobomimicDemonstrations`."""
        return self._replay(self._place, **self._options, **options)

    def environment(self) -> dict[str, Any] | None:
        """Return the recorded Gymnasium environment, for :func:`warmprior.envs.registered_env`, if any."""
        return minari_environment(self._place) if self._prefix == MINARI else None

    def digest(self, **used: Any) -> str:
        """Return the SHA-256 of the contents; in a LeRobotDataset, of those that the options select."""
        if self._prefix == LEROBOT:
            whole = read_lerobot_index(self._place, fetch=True, **self._options, **used).digest()
        elif self._prefix == MINARI:
            files = sorted(path for path in self.index().path.rglob("*") if path.is_file())
            whole = digest_of(*map(file_digest, files))
        else:
            whole = file_digest(self._place)
        return whole if self._mask is None else digest_of(whole, self._mask)
