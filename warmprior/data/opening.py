"""Where demonstrations are: a robomimic HDF5 file, or ``lerobot:`` and a LeRobotDataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.data.hdf5 import read_index
from warmprior.data.lerobot import LeRobotDemonstrations
from warmprior.data.lerobot_index import read_lerobot_index
from warmprior.data.replay import DatasetIndex, DemonstrationReplay
from warmprior.data.robomimic import RobomimicDemonstrations
from warmprior.io.files import digest_of, file_digest

LEROBOT = "lerobot:"
"""What stands before the folder or repository of a LeRobotDataset where a file could be meant."""


def lerobot_name(place: str | Path) -> str | None:
    """The folder or repository behind the prefix, if there is one."""
    text = str(place)
    return text.removeprefix(LEROBOT) if text.startswith(LEROBOT) else None


def name_of_place(place: str | Path) -> str:
    """A short name: that of the file without its ending, of the folder, or of the repository."""
    dataset = lerobot_name(place)
    return Path(place).stem if dataset is None else Path(dataset).resolve().name


class Demonstrations:
    """Demonstrations at one place, of which nothing big is read before :meth:`replay`.

    A place is an HDF5 file, or ``lerobot:`` and the folder or repository of a LeRobotDataset.

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
        dataset = lerobot_name(place)
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
        """Read them; options as of :class:`RobomimicDemonstrations`."""
        kind = LeRobotDemonstrations if self._lerobot else RobomimicDemonstrations
        return kind(self._path, **self._options, **options)

    def digest(self, image_keys: Sequence[str] = (), demos: int | None = None) -> str:
        """SHA-256 of the contents, as far as these images and that many demonstrations are used."""
        used: dict[str, Any] = {"image_keys": image_keys, "demos": demos}
        if self._lerobot:
            whole = read_lerobot_index(self._path, fetch=True, **self._options, **used).digest()
        else:
            whole = file_digest(Path(self._path))
        return whole if self._mask is None else digest_of(whole, self._mask)
