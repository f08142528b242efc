"""The index of demonstrations in any format, and what their readers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor

from warmprior.checks import (
    check_choice,
    check_distinct,
    check_positive,
    given,
)
from warmprior.data.checks import DatasetError
from warmprior.envs.robosuite_tasks import TaskSpec
from warmprior.keys import OBSERVATION, STATE
from warmprior.options.data import Resize

BLOCK = 4096  # rows handled at once, to bound temporary memory for demos of any length


@dataclass(frozen=True, kw_only=True)
class DatasetIndex:
    """The index of demonstrations, without their values.

    Attributes:
        path: the file or folder.
        demos: names of the selected demos, in the order of their numbers.
        observation_keys: the observations to read, in the order of concatenation.
        image_shapes: heights and widths of the images to read, as they are stored.
        image_size: side in pixels to which these are resized; 0 if there are none.
        resize: how they are resized, see :func:`~warmprior.modules.resize.resized`.
        images: the place's own names of images that have another here.
        available_keys: all observations.
        taken_by: the option that takes an observation: ``"observations"`` by default, ``"images"``, or ``""``
            for one that no option takes.
        env_args: the description of the environment; empty if it is unknown.
        task: the task of :data:`warmprior.envs.TASKS` that uses this environment, or ``None``.
        whole: False if only some of the demonstrations were asked for.
        rate: control steps per second, if they are known.
        rewards: False if none are recorded.
        joints: the observation whose numbers the actions may set, by their names; ``""`` if there is none.
    """

    path: Path
    demos: tuple[str, ...]
    lengths: tuple[int, ...]
    observation_keys: tuple[str, ...]
    observation_dims: tuple[int, ...]
    image_keys: tuple[str, ...] = ()
    image_shapes: tuple[tuple[int, int], ...] = ()
    image_size: int = 0
    resize: Resize = "squeeze"
    images: Mapping[str, str] = field(default_factory=dict)
    available_keys: tuple[str, ...]
    taken_by: Mapping[str, str] = field(default_factory=dict)
    action_dim: int
    env_args: dict[str, Any] = field(default_factory=dict)
    task: TaskSpec | None = None
    whole: bool = True
    rate: float | None = None
    rewards: bool = True
    joints: str = ""

    def __post_init__(self) -> None:
        if not self.demos:
            raise DatasetError(f"{self.path}: there is no demonstration, or the mask names none")
        if 0 in self.lengths:
            empty = self.demos[self.lengths.index(0)]
            raise DatasetError(f"{self.path}: demonstration {empty} has no steps: delete it")
        if not self.observation_keys:
            listed = ", ".join(self.available_keys)
            raise DatasetError(f"{self.path}: no observations are chosen; name observations: {listed}")
        check_positive(**given(**{f"{self.path}: control steps per second": self.rate}))
        check_distinct(f"{self.path}: the observations", (*self.observation_keys, *self.image_keys))

    @property
    def numbers(self) -> dict[str, list[str]]:
        """The place's own names of the numbers of observations, and of the action, if they have some."""
        return {}

    @property
    def left_out(self) -> dict[str, list[str]]:
        """The observations that are not read, by the option that would take them."""
        others: dict[str, list[str]] = {}
        for key in sorted(set(self.available_keys) - {*self.observation_keys, *self.image_keys}):
            others.setdefault(self.taken_by.get(key, "observations"), []).append(key)
        return others

    @property
    def vector_key(self) -> NestedKey:
        """The key of the steps' vector, beside which images are."""
        return (OBSERVATION, STATE) if self.image_keys else OBSERVATION

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that have images."""
        ending = "_image"
        return tuple(k.removesuffix(ending) for k in self.available_keys if k.endswith(ending))

    @property
    def task_name(self) -> str:
        """The short name of the task, or its environment's name if no task of robosuite has it."""
        return str(self.env_args["env_name"]).lower() if self.task is None else self.task.name

    @property
    def pose_columns(self) -> Tensor:
        """The columns of ``"observation"`` with grippers' positions and quaternions, int64 ``[arms, 7]``."""
        first = dict(zip(self.observation_keys, np.cumsum([0, *self.observation_dims]), strict=False))
        columns: list[list[int]] = []
        while not columns or f"robot{len(columns)}_eef_pos" in first:
            position, quaternion = (first[f"robot{len(columns)}_eef_{end}"] for end in ("pos", "quat"))
            columns.append([*range(position, position + 3), *range(quaternion, quaternion + 4)])
        return torch.tensor(columns)

    def joint_columns(self, key: str) -> list[int]:
        """Return for each action the column of ``"observation"``, within ``key``, that it sets, or -1."""
        check_choice("joints", key, self.observation_keys)
        position = self.observation_keys.index(key)
        first, width = sum(self.observation_dims[:position]), self.observation_dims[position]
        return [first + action if action < width else -1 for action in range(self.action_dim)]


class DemonstrationReader(ABC):
    """A reader of demonstrations' values, given their :class:`DatasetIndex`."""

    @abstractmethod
    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read and check rows of ``"actions"``, ``"rewards"`` or ``"obs/<key>"``, from ``first`` on.

        Rewards that are not recorded are zeros.
        """

    def terminated(self, demo: str) -> bool | None:
        """Return whether a demo ended by itself, as recorded; None if only its rewards tell."""
        return None

    @abstractmethod
    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        """Yield the images of a demo as they are stored, in blocks, uint8 ``[n, 3, h, w]``."""

    def decoders(self, key: str) -> Sequence[str]:
        """Return the packages of which another version may give other images; none by default."""
        return ()

    @abstractmethod
    def name(self, demo: str, key: str) -> str:
        """Return the name of a demo's array for errors, with the file that holds it."""


def pose_keys(action_dim: int) -> list[str]:
    """Return the observations of the hands' poses, for as many arms as the pose deltas have."""
    arms = range(min(action_dim // 7, 2))
    return [f"robot{arm}_eef_{part}" for arm in arms for part in ("pos", "quat")]
