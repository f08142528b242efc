"""What a set of demonstrations holds, whatever format it is stored in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from warmprior.data.hdf5_members import DatasetError
from warmprior.envs.tasks import TaskSpec

BLOCK = 4096  # rows handled at once: a bound on temporary memory, whatever the length of a demo
LARGEST = 1e9  # in any unit; a greater value is damage, and would flatten all others of its feature


@dataclass(frozen=True)
class DatasetIndex:
    """What demonstrations hold, without their values.

    Attributes:
        path: the file or folder.
        demos: names of the selected demos, in the order of their numbers.
        observation_keys: the observations to read, in the order of concatenation.
        image_size: side of the images to read in pixels; 0 if there are none.
        available_keys: every observation there is.
        env_args: the environment as it is described there; empty if it is unknown.
        task: the task of :data:`warmprior.envs.TASKS` that uses this environment, or ``None``.
    """

    path: Path
    demos: tuple[str, ...]
    lengths: tuple[int, ...]
    observation_keys: tuple[str, ...]
    observation_dims: tuple[int, ...]
    image_keys: tuple[str, ...]
    image_size: int
    available_keys: tuple[str, ...]
    action_dim: int
    env_args: dict[str, Any]
    task: TaskSpec | None

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras whose images there are."""
        ending = "_image"
        return tuple(k.removesuffix(ending) for k in self.available_keys if k.endswith(ending))


class DemonstrationReader(ABC):
    """Gives the values of demonstrations, whose :class:`DatasetIndex` is known."""

    @abstractmethod
    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read rows of ``"actions"``, ``"rewards"`` or ``"obs/<key>"`` into ``out``, and check them."""

    @abstractmethod
    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the first images of a demo into uint8 ``[rows, 3, size, size]``."""

    @abstractmethod
    def name(self, demo: str, key: str) -> str:
        """What errors call an array of a demo, with the file that holds it."""


def check_env_args(what: str, env_args: Any) -> dict[str, Any]:
    """Refuse what describes no environment as robomimic does: text ``env_name`` and a dict ``env_kwargs``."""
    for key, kind in (("env_name", str), ("env_kwargs", dict)):
        if not (isinstance(env_args, dict) and isinstance(env_args.get(key), kind)):
            raise DatasetError(f"{what} lacks {key}, or it is not a {kind.__name__}")
    return env_args


def check_count(path: Path, demos: int | None, available: int) -> None:
    """Refuse to take more demonstrations than there are."""
    if demos is not None and demos > available:
        raise DatasetError(
            f"{path}: there are {available} demonstrations, fewer than the {demos} to be taken: ask "
            "for no more"
        )


def store_finite(block: np.ndarray, out: np.ndarray, what: str, first: int, advice: str) -> None:
    """Copy numbers to ``out``; a ``DatasetError`` if one is not finite there, or above 1e9."""
    with np.errstate(over="ignore"):  # an overflow is infinite, which is reported below
        out[...] = block.reshape(out.shape)
    usable = (np.abs(out) <= LARGEST).all(-1)  # NaN is not
    if not usable.all():
        worst = int(np.argmin(usable))
        finite = np.isfinite(out[worst]).all()
        found = f"a value beyond {LARGEST:.0e}" if finite else "NaN or infinity"
        raise DatasetError(f"{what} has {found} in row {first + worst}. {advice}")
