"""The formats of demonstrations, by what their places begin with."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any

from warmprior.checks import check_choice
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.hdf5_folder import RobomimicFolder
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.minari import MinariDemonstrations

FORMATS: tuple[type[Demonstrations], ...] = (
    LeRobotDemonstrations,
    MinariDemonstrations,
    RobomimicFolder,
    RobomimicDemonstrations,
)
"""The formats; the first whose ``reads`` accepts a place opens it.

Help says what places they have: ``PLACES`` in ``warmprior/options/data.py``.
"""


def open_demonstrations(
    place: str | Path,
    *,
    demos: int | None = None,
    mask: str | None = None,
    style: str | None = None,
    task: str | Mapping[str, Any] | None = None,
    **options: Any,
) -> Demonstrations:
    """Return the demonstrations at a place, raw as recorded; values are only read by their ``steps``.

    Args:
        place: a robomimic or MimicGen HDF5 file, or a folder of them; ``lerobot:`` and the folder or
            repository of a LeRobotDataset v3; or ``minari:`` and the name of a Minari dataset.

    Keyword Args:
        demos: number of demonstrations to take, from the first on; all by default.
        mask: a mask of the place, such as ``"train"``; all demonstrations by default.
        style: style of the recording, which decides robosuite's time limit: ``"ph"`` by default, and
            ``"human"`` outside robosuite.
        task: the task of robosuite, or its ``env_args``, for a LeRobotDataset that does not describe its
            environment.
        options: ``image_size`` and ``resize`` of images, see :class:`Demonstrations`; and options of the
            format: of a LeRobotDataset ``episodes``, the numbers of the episodes to read (files of others are
            not needed), and ``revision``, a branch, tag or commit of a repository.

    Examples:
        >>> from warmprior.data import open_demonstrations
        >>> open_demonstrations("lerobot:user/square").name  # nothing is fetched yet
        'lerobot:square'
        >>> open_demonstrations("square.hdf5", mask="train").steps()["observation"].shape  # doctest: +SKIP
        torch.Size([30154, 23])
        >>> open_demonstrations("nowhere.hdf5").steps()
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """
    kind = next(kind for kind in FORMATS if kind.reads(str(place)))
    # A format passes what it does not know on to its base class.
    known = [name for base in kind.__mro__[:-1] for name in signature(base).parameters]
    for name in options:
        check_choice(f"an option of {place}", name, sorted({*known} - {"place", "options"}))
    place = str(place).removeprefix(kind.prefix)
    return kind(place, demos=demos, mask=mask, style=style, task=task, **options)
