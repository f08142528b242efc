"""MimicGen's demonstrations as a TorchRL replay buffer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warmprior.data.download import download_mimicgen
from warmprior.data.hdf5 import DatasetError, read_env_args
from warmprior.data.robomimic import RobomimicExperienceReplay
from warmprior.envs.mimicgen import is_mimicgen

__all__ = ["MimicGenExperienceReplay"]


class MimicGenExperienceReplay(RobomimicExperienceReplay):
    """Demonstrations of a file of MimicGen, which has robomimic's layout.

    Args:
        dataset: path of an HDF5 file, or with ``download=True`` the name of a task.
        style: which official file (see :func:`warmprior.data.download_mimicgen`): the ten human
            demonstrations (``"source"``) or those that MimicGen made of them (``"core"``). Ignored for a
            path.
        download: fetch the official file if ``dataset`` is no file.
        root: folder for downloads; by default the hub client's cache.
        **kwargs: further arguments of :class:`RobomimicExperienceReplay`, such as ``demos=10`` for the first
            ten.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file is not as it should be, or its environment is none of MimicGen's.
        OSError: if a download fails.

    Examples:
        >>> from warmprior.data import MimicGenExperienceReplay
        >>> data = MimicGenExperienceReplay("coffee_d0", download=True)  # doctest: +SKIP
        >>> data.num_episodes, data.data["observation"].shape[-1]  # doctest: +SKIP
        (10, 66)
        >>> MimicGenExperienceReplay("coffee_d0")
        Traceback (most recent call last):
            ...
        FileNotFoundError: coffee_d0: no such file; check the path
    """

    def __init__(
        self,
        dataset: str | Path,
        *,
        style: str = "source",
        download: bool = False,
        root: str | Path | None = None,
        **kwargs: Any,
    ) -> None:
        path = Path(dataset)
        if download and not path.is_file():
            path = download_mimicgen(str(dataset), style, root=root)
        name = read_env_args(path)["env_name"]
        if not is_mimicgen(name):
            raise DatasetError(
                f"{path}: {name} is none of MimicGen's environments (such as Stack_D0): read the file with "
                "RobomimicExperienceReplay"
            )
        super().__init__(path, **kwargs)
