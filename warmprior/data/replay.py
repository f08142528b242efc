"""What replay buffers of demonstrations share, whatever format these are stored in."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from tqdm import tqdm

from warmprior.data.hdf5_members import DatasetError
from warmprior.data.index import BLOCK, DatasetIndex, DemonstrationReader
from warmprior.envs.env_args import absolute_actions as to_absolute
from warmprior.envs.env_args import delta_conventions, modernize_env_args
from warmprior.envs.tasks import TaskSpec
from warmprior.io.machine import available_memory
from warmprior.keys import ACTION, EPISODE, FRAME, OBSERVATION, STATE

UNIT_TOLERANCE = 1e-2  # of the length of a quaternion; recorded ones are off by 1e-6


def _allocate(
    index: DatasetIndex, action_dim: int, storage: str, scratch_dir: str | Path | None
) -> TensorDict:
    steps = sum(index.lengths)
    vector = (torch.float32, (sum(index.observation_dims),))
    image = (torch.uint8, (3, index.image_size, index.image_size))
    widths = {
        _vector_key(index): vector,
        **{(OBSERVATION, key): image for key in index.image_keys},
        ACTION: (torch.float32, (action_dim,)),
        ("next", "reward"): (torch.float32, (1,)),
        ("next", "done"): (torch.bool, (1,)),
        ("next", "terminated"): (torch.bool, (1,)),
        ("next", "truncated"): (torch.bool, (1,)),
        EPISODE: (torch.int64, ()),
        FRAME: (torch.int64, ()),
    }
    # Expanded scalars cost nothing, and the real memory is taken once.
    data = TensorDict(batch_size=[steps])
    for key, (dtype, width) in widths.items():
        data.set(key, torch.zeros((), dtype=dtype).expand(steps, *width))
    needed = sum(value.numel() * value.element_size() for value in data.values(True, True))
    available = available_memory()
    if storage == "memory" and needed > available:
        raise DatasetError(
            f"{index.path}: {steps} steps need {needed / 1e9:.1f} GB of memory, but "
            f"{available / 1e9:.1f} GB are free: use storage='memmap', or choose fewer with demos "
            "or filter_key"
        )
    if storage == "memory":
        return torch.empty_like(data)
    data = data.memmap_like(scratch_dir)
    try:
        for value in data.values(True, True):
            _reserve(value)
    except OSError as error:
        raise OSError(
            f"{scratch_dir or 'the folder of temporary files'}: cannot take {needed / 1e9:.3g} GB for "
            f"{index.path} ({error}). Free some space or choose another scratch_dir."
        ) from error
    return data


def _vector_key(index: DatasetIndex) -> NestedKey:
    return (OBSERVATION, STATE) if index.image_keys else OBSERVATION


def _reserve(mapped: Any) -> None:
    """Take the space of a memory map: writing to one without it kills the process (SIGBUS)."""
    if not hasattr(os, "posix_fallocate"):
        return
    handler = getattr(mapped, "_handler", None)  # of a file without a name
    file = os.open(mapped.filename, os.O_RDWR) if handler is None else os.dup(handler.fd)
    try:
        os.posix_fallocate(file, 0, max(1, mapped.numel() * mapped.element_size()))
    finally:
        os.close(file)


def _read_absolute(
    reader: DemonstrationReader, demo: str, out: np.ndarray, output_max: Tensor, base_rotation: Tensor
) -> None:
    arms = len(base_rotation)
    for first in range(0, len(out), BLOCK):
        rows = out[first : first + BLOCK]
        deltas, positions, quaternions = (np.empty((len(rows), n * arms)) for n in (7, 3, 4))
        reader.numbers(demo, "actions", deltas, first)
        for arm in range(arms):
            position, quaternion = (f"obs/robot{arm}_eef_{what}" for what in ("pos", "quat"))
            reader.numbers(demo, position, positions[:, 3 * arm : 3 * arm + 3], first)
            turns = quaternions[:, 4 * arm : 4 * arm + 4]
            reader.numbers(demo, quaternion, turns, first)
            off = np.abs(np.linalg.norm(turns, axis=-1) - 1)
            if off.max() > UNIT_TOLERANCE:
                worst = int(off.argmax())
                raise DatasetError(
                    f"{reader.name(demo, quaternion)} is no rotation in row {first + worst}: "
                    f"the quaternion {turns[worst].tolist()} does not have length 1. Rebuild or remove "
                    "the demo, or leave it out."
                )
        rows[...] = to_absolute(
            torch.from_numpy(deltas),
            torch.from_numpy(positions),
            torch.from_numpy(quaternions),
            output_max=output_max,
            base_rotation=base_rotation,
        ).numpy()


def _fill(index: DatasetIndex, data: TensorDictBase, reader: DemonstrationReader, absolute: bool) -> None:
    observation, action = data[_vector_key(index)].numpy(), data[ACTION].numpy()
    reward = data["next", "reward"].numpy()
    columns = np.cumsum([0, *index.observation_dims])
    rows = np.cumsum([0, *index.lengths])
    if absolute:
        output_max, base_rotation = delta_conventions(index.env_args)
    # Of what takes long: images are unpacked one by one.
    bar = tqdm(index.demos, f"read {index.path.name}", unit="demo", disable=not index.image_keys)
    for episode, (demo, (start, stop)) in enumerate(zip(bar, pairwise(rows), strict=True)):
        for key, (left, right) in zip(index.observation_keys, pairwise(columns), strict=True):
            reader.numbers(demo, f"obs/{key}", observation[start:stop, left:right])
        if absolute:
            _read_absolute(reader, demo, action[start:stop], output_max, base_rotation)
        else:
            reader.numbers(demo, "actions", action[start:stop])
        reader.numbers(demo, "rewards", reward[start:stop])
        for key in index.image_keys:
            reader.images(demo, key, data[OBSERVATION, key][start:stop])
        data[EPISODE][start:stop] = episode
    torch.arange(len(data), out=data[FRAME])
    last = torch.from_numpy(rows[1:] - 1)
    success = data["next", "reward"][last] > 0
    for key, value in (("done", True), ("terminated", success), ("truncated", ~success)):
        flag = data["next", key]
        flag.zero_()
        flag[last] = value


class DemonstrationReplay(TensorDictReplayBuffer):
    """What buffers of all formats share; entries and options as :class:`RobomimicExperienceReplay` tells."""

    def __init__(
        self,
        index: DatasetIndex,
        reader: DemonstrationReader,
        *,
        absolute_actions: bool = False,
        storage: Literal["memory", "memmap"] = "memory",
        scratch_dir: str | Path | None = None,
        device: torch.device | str = "cpu",
        **kwargs: Any,
    ) -> None:
        if storage not in ("memory", "memmap"):
            raise ValueError(f"storage must be 'memory' or 'memmap', got {storage!r}")
        device = torch.device(device)
        if storage == "memmap" and device.type != "cpu":
            raise ValueError(f"memory maps live on the CPU; use storage='memory' for {device}")
        action_dim = index.action_dim
        self._env_args: dict[str, Any] = {}
        if index.env_args or absolute_actions:
            try:
                self._env_args = modernize_env_args(index.env_args, absolute=absolute_actions)
                arms = len(delta_conventions(index.env_args)[1]) if absolute_actions else 0
            except Exception as error:  # whatever their unexpected structure leads to
                reason = str(error) if isinstance(error, ValueError) else repr(error)
                raise DatasetError(
                    f"{index.path}: env_args describes no environment as these actions need it: {reason}"
                ) from error
        if absolute_actions:
            if action_dim != 7 * arms:
                raise DatasetError(
                    f"{index.path}: actions have {action_dim} columns, but env_args names {arms} robot(s) "
                    f"with 7 each; absolute actions cannot be built"
                )
            action_dim = 10 * arms
        data = _allocate(index, action_dim, storage, scratch_dir)
        _fill(index, data, reader, absolute_actions)
        self._index = index
        super().__init__(
            storage=TensorStorage(data if storage == "memmap" else data.to(device)),
            writer=ImmutableDatasetWriter(),
            **kwargs,
        )

    @property
    def data(self) -> TensorDictBase:
        """All steps, ``[N]``; shares memory with the storage."""
        return self._storage.get(slice(None))

    @property
    def path(self) -> Path:
        """The file or folder that was read."""
        return self._index.path

    def _described(self, env_args: Mapping[str, Any]) -> dict[str, Any]:
        if not env_args:
            raise ValueError(f"{self.path} does not say which environment it was recorded in")
        return modernize_env_args(env_args)

    @property
    def env_args(self) -> dict[str, Any]:
        """The environment of the data, for robosuite 1.5, fit for the actions as they are stored; a copy.

        A ``ValueError`` if it is unknown; see :func:`warmprior.envs.modernize_env_args`.
        """
        return self._described(self._env_args)

    @property
    def recorded_env_args(self) -> dict[str, Any]:
        """The same, fit for the actions as they were recorded, where those that are stored are absolute."""
        return self._described(self._index.env_args)

    @property
    def task(self) -> TaskSpec | None:
        """The task of :data:`warmprior.envs.TASKS` recorded here, or ``None`` if it is another."""
        return self._index.task

    @property
    def observation_keys(self) -> tuple[str, ...]:
        """The keys whose values stand side by side in the observation's vector."""
        return self._index.observation_keys

    @property
    def image_size(self) -> int:
        """Side of the images in pixels, 0 if there are none."""
        return self._index.image_size

    @property
    def pose_columns(self) -> Tensor:
        """Where in ``"observation"`` each gripper's position and quaternion are, int64 ``[arms, 7]``."""
        first = dict(zip(self.observation_keys, np.cumsum([0, *self._index.observation_dims]), strict=False))
        columns: list[list[int]] = []
        while not columns or f"robot{len(columns)}_eef_pos" in first:
            position, quaternion = (first[f"robot{len(columns)}_eef_{end}"] for end in ("pos", "quat"))
            columns.append([*range(position, position + 3), *range(quaternion, quaternion + 4)])
        return torch.tensor(columns)

    @property
    def num_episodes(self) -> int:
        """The number of demos read."""
        return len(self._index.demos)
