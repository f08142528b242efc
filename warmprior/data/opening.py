"""Where demonstrations are: an HDF5 file of robomimic, or a dataset of LeRobot or Minari."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.data.hdf5 import read_index
from warmprior.data.lerobot import LeRobotDemonstrations
from warmprior.data.lerobot_index import image_key, read_lerobot_index
from warmprior.data.minari import MinariDemonstrations, minari_environment, read_minari_index
from warmprior.data.replay import DatasetIndex, DemonstrationReplay
from warmprior.data.robomimic import RobomimicDemonstrations
from warmprior.io.files import digest_of, file_digest

LEROBOT, MINARI = "lerobot:", "minari:"
"""What stands before the folder or repository of a LeRobotDataset, and the name of a Minari dataset."""


def dataset_name(place: str | Path, prefix: str) -> str | None:
    """What stands behind a prefix, :data:`LEROBOT` or :data:`MINARI`, if the place begins with it."""
    text = str(place)
    return text.removeprefix(prefix) if text.startswith(prefix) else None


def name_of_place(place: str | Path) -> str:
    """A short name: that of the file without its ending, of the folder, of the repository or dataset."""
    if (name := dataset_name(place, MINARI)) is not None:
        return name.replace("/", "-")
    folder = dataset_name(place, LEROBOT)
    return Path(place).stem if folder is None else Path(folder).resolve().name


class Demonstrations:
    """Demonstrations at one place, of which nothing big is read before :meth:`replay`.

    A place is an HDF5 file, ``lerobot:`` and the folder or repository of a LeRobotDataset, or ``minari:`` and
    the name of a Minari dataset.

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
        self._mask = mask
        self._options: dict[str, Any] = {"filter_key": mask}
        kinds: dict[str, tuple[Any, Any]] = {
            LEROBOT: (read_lerobot_index, LeRobotDemonstrations),
            MINARI: (read_minari_index, MinariDemonstrations),
        }
        self._prefix = next((p for p in kinds if dataset_name(place, p) is not None), None)
        self._place: Any = Path(place) if self._prefix is None else dataset_name(place, self._prefix)
        self._index, self._replay = kinds.get(self._prefix or "", (read_index, RobomimicDemonstrations))
        if self._prefix == LEROBOT:
            self._options["env_args"] = env_args
        name = Path(place).name if self._prefix is None else f"{self._prefix}{name_of_place(place)}"
        self.name = name if mask is None else f"{name} (mask {mask})"

    def image_keys(self, names: Sequence[str]) -> list[str]:
        """Names of images as policies have them; LeRobot's own, ``observation.images.front``, are known."""
        return [image_key(name) if name.startswith("observation.") else name for name in names]

    def index(self, **options: Any) -> DatasetIndex:
        """What is there; options (``image_keys``, ``demos`` and so on) as of ``read_index``."""
        return self._index(self._place, **self._options, **options)

    def replay(self, **options: Any) -> DemonstrationReplay:
        """Read them; options as of :class:`RobomimicDemonstrations`."""
        return self._replay(self._place, **self._options, **options)

    def environment(self) -> dict[str, Any] | None:
        """Of Gymnasium, as :func:`warmprior.envs.registered_env` takes it, if they were recorded in one."""
        return minari_environment(self._place) if self._prefix == MINARI else None

    def digest(self, **used: Any) -> str:
        """SHA-256 of the contents; of a LeRobotDataset those that the options of :meth:`index` select."""
        if self._prefix == LEROBOT:
            whole = read_lerobot_index(self._place, fetch=True, **self._options, **used).digest()
        elif self._prefix == MINARI:
            files = sorted(path for path in self.index().path.rglob("*") if path.is_file())
            whole = digest_of(*map(file_digest, files))
        else:
            whole = file_digest(self._place)
        return whole if self._mask is None else digest_of(whole, self._mask)
