"""robomimic's demonstrations as a TorchRL replay buffer."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage

from warmprior.data.download import download_robomimic
from warmprior.data.hdf5 import (
    BLOCK,
    DatasetError,
    RobomimicIndex,
    open_robomimic,
    read_index,
    read_rows,
)
from warmprior.data.hdf5_images import read_images
from warmprior.envs.env_args import absolute_actions as to_absolute
from warmprior.envs.env_args import delta_conventions, modernize_env_args
from warmprior.envs.tasks import TASKS, TaskSpec
from warmprior.io.memory import available_memory
from warmprior.keys import ACTION, EPISODE, FRAME, OBSERVATION, STATE

__all__ = ["RobomimicExperienceReplay"]

UNIT_TOLERANCE = 1e-2  # of the length of a quaternion; recorded ones are off by 1e-6


def _locate(dataset: str | Path, style: str, download: bool, root: str | Path | None) -> Path:
    path = Path(dataset)
    if path.is_file() or (str(dataset) not in TASKS and not download):
        return path
    if download:
        return download_robomimic(str(dataset), style, root=root)
    raise FileNotFoundError(
        f"{dataset}: no such file. To fetch the official {dataset} {style} file, pass download=True."
    )


def _allocate(
    index: RobomimicIndex, action_dim: int, storage: str, scratch_dir: str | Path | None
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
    if storage == "memory" and available is not None and needed > available:
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


def _vector_key(index: RobomimicIndex) -> NestedKey:
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
    file: Any, demo: str, out: np.ndarray, output_max: Tensor, base_rotation: Tensor
) -> None:
    arms = len(base_rotation)
    for first in range(0, len(out), BLOCK):
        rows = out[first : first + BLOCK]
        deltas, positions, quaternions = (np.empty((len(rows), n * arms)) for n in (7, 3, 4))
        read_rows(file, demo, "actions", deltas, first)
        for arm in range(arms):
            position, quaternion = (f"obs/robot{arm}_eef_{what}" for what in ("pos", "quat"))
            read_rows(file, demo, position, positions[:, 3 * arm : 3 * arm + 3], first)
            turns = quaternions[:, 4 * arm : 4 * arm + 4]
            read_rows(file, demo, quaternion, turns, first)
            off = np.abs(np.linalg.norm(turns, axis=-1) - 1)
            if off.max() > UNIT_TOLERANCE:
                worst = int(off.argmax())
                raise DatasetError(
                    f"{file.filename}: data/{demo}/{quaternion} is no rotation in row {first + worst}: "
                    f"the quaternion {turns[worst].tolist()} does not have length 1. Rebuild or remove "
                    "the demo, or leave it out with a mask."
                )
        rows[...] = to_absolute(
            torch.from_numpy(deltas),
            torch.from_numpy(positions),
            torch.from_numpy(quaternions),
            output_max=output_max,
            base_rotation=base_rotation,
        ).numpy()


def _fill(index: RobomimicIndex, data: TensorDictBase, absolute: bool) -> None:
    observation, action = data[_vector_key(index)].numpy(), data[ACTION].numpy()
    reward = data["next", "reward"].numpy()
    columns = np.cumsum([0, *index.observation_dims])
    rows = np.cumsum([0, *index.lengths])
    if absolute:
        output_max, base_rotation = delta_conventions(index.env_args)
    with open_robomimic(index.path) as file:
        for episode, (demo, (start, stop)) in enumerate(
            zip(index.demos, pairwise(rows), strict=True)
        ):
            for key, (left, right) in zip(index.observation_keys, pairwise(columns), strict=True):
                read_rows(file, demo, f"obs/{key}", observation[start:stop, left:right])
            if absolute:
                _read_absolute(file, demo, action[start:stop], output_max, base_rotation)
            else:
                read_rows(file, demo, "actions", action[start:stop])
            read_rows(file, demo, "rewards", reward[start:stop])
            for key in index.image_keys:
                read_images(file, demo, key, data[OBSERVATION, key][start:stop])
            data[EPISODE][start:stop] = episode
    torch.arange(len(data), out=data[FRAME])
    last = torch.from_numpy(rows[1:] - 1)
    success = data["next", "reward"][last] > 0
    for key, value in (("done", True), ("terminated", success), ("truncated", ~success)):
        flag = data["next", key]
        flag.zero_()
        flag[last] = value


@contextmanager
def _understanding(path: Path) -> Iterator[None]:
    """Name the file whose ``env_args`` are not understood."""
    try:
        yield
    except Exception as error:  # whatever their unexpected structure leads to
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise DatasetError(
            f"{path}: data.attrs['env_args'] describes no environment as these actions need it: "
            f"{reason}"
        ) from error


class RobomimicExperienceReplay(TensorDictReplayBuffer):
    """Demonstrations of a robomimic HDF5 file, as one immutable TorchRL replay buffer.

    The whole selection becomes a flat, contiguous :class:`~tensordict.TensorDict` of ``N`` steps, in
    the order of the demos' numbers:

    - ``"observation"`` ``[N, d_o]`` float32, the observation keys side by side; with images nested,
      ``("observation", "state")`` ``[N, d_s]`` and each as uint8 ``[N, 3, size, size]``;
    - ``"action"`` ``[N, d_a]`` float32, as recorded (not normalised);
    - ``("next", "reward")`` ``[N, 1]`` float32;
    - ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` ``[N, 1]`` bool: done
      on the last step of each demo, terminated there if its reward is positive, else truncated;
    - ``"episode"`` ``[N]`` int64, counted from 0, and ``"frame"`` ``[N]`` int64, the row itself.

    Names, shapes and masks are checked before values are read, and reading takes little more memory
    than the tensors.

    Args:
        dataset: path of an HDF5 file, or with ``download=True`` the name of a task.
        style: which official file: ``"ph"`` or ``"mh"``. Ignored for a path.
        download: fetch the official file if ``dataset`` is no file
            (see :func:`warmprior.data.download_robomimic`).
        root: folder for downloads; by default the hub client's cache.
        filter_key: a mask of the file, such as ``"train"``; all demos if ``None``.
        demos: how many to take, the first ones by their numbers; all if ``None``.
        observation_keys: observations to concatenate; by default those of the task, or for an
            unknown environment the object and every robot's pose and gripper.
        image_keys: images to read as well, such as ``"agentview_image"``. They stay bytes; take
            ``storage="memmap"`` where they are many.
        absolute_actions: turn the recorded pose deltas into absolute poses
            (see :func:`warmprior.envs.absolute_actions`); ``d_a`` becomes 10 per arm.
        storage: ``"memory"``, or ``"memmap"`` for files under ``scratch_dir``.
        scratch_dir: folder of the memory maps; temporary files if ``None``.
        device: device of the tensors; ``"cpu"`` for ``"memmap"``.
        batch_size: steps per :meth:`sample`.
        sampler: a TorchRL sampler; random with replacement by default.
        transform: a TorchRL transform applied to each sample.
        **kwargs: further arguments of :class:`~torchrl.data.TensorDictReplayBuffer`, such as
            ``prefetch``, ``pin_memory`` or ``generator``.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file is not as it should be; says which demo and key.
        ValueError: if ``storage`` is unknown or does not fit ``device``, or absolute actions are asked
            of a controller without pose deltas.
        OSError: if a download fails, or there is no space for memory maps.
        ImportError: if h5py, or for a download huggingface_hub, is not installed.

    Examples:
        >>> data = RobomimicExperienceReplay("square.hdf5", batch_size=256)  # doctest: +SKIP
        >>> data.sample()["observation"].shape  # doctest: +SKIP
        torch.Size([256, 23])
        >>> RobomimicExperienceReplay("square")
        Traceback (most recent call last):
            ...
        FileNotFoundError: square: no such file. To fetch the official square ph file, ...
    """

    def __init__(
        self,
        dataset: str | Path,
        *,
        style: str = "ph",
        download: bool = False,
        root: str | Path | None = None,
        filter_key: str | None = None,
        demos: int | None = None,
        observation_keys: Sequence[str] | None = None,
        image_keys: Sequence[str] = (),
        absolute_actions: bool = False,
        storage: Literal["memory", "memmap"] = "memory",
        scratch_dir: str | Path | None = None,
        device: torch.device | str = "cpu",
        batch_size: int | None = None,
        sampler: Any = None,
        transform: Any = None,
        **kwargs: Any,
    ) -> None:
        if storage not in ("memory", "memmap"):
            raise ValueError(f"storage must be 'memory' or 'memmap', got {storage!r}")
        device = torch.device(device)
        if storage == "memmap" and device.type != "cpu":
            raise ValueError(f"memory maps live on the CPU; use storage='memory' for {device}")
        path = _locate(dataset, style, download, root)
        index = read_index(
            path,
            filter_key=filter_key,
            observation_keys=observation_keys,
            image_keys=image_keys,
            poses=absolute_actions,
            demos=demos,
        )
        action_dim = index.action_dim
        with _understanding(path):
            self._env_args = modernize_env_args(index.env_args, absolute=absolute_actions)
            arms = len(delta_conventions(index.env_args)[1]) if absolute_actions else 0
        if absolute_actions:
            if action_dim != 7 * arms:
                raise DatasetError(
                    f"{path}: actions have {action_dim} columns, but env_args names {arms} robot(s) "
                    f"with 7 each; absolute actions cannot be built"
                )
            action_dim = 10 * arms
        data = _allocate(index, action_dim, storage, scratch_dir)
        _fill(index, data, absolute_actions)
        self._index = index
        super().__init__(
            storage=TensorStorage(data if storage == "memmap" else data.to(device)),
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            sampler=sampler,
            transform=transform,
            **kwargs,
        )

    @property
    def data(self) -> TensorDictBase:
        """All steps, ``[N]``; shares memory with the storage."""
        return self._storage.get(slice(None))

    @property
    def path(self) -> Path:
        """The HDF5 file that was read."""
        return self._index.path

    @property
    def env_args(self) -> dict[str, Any]:
        """The environment of the data, for robosuite 1.5, fit for the actions as they are stored.

        A copy; see :func:`warmprior.envs.modernize_env_args`.
        """
        return modernize_env_args(self._env_args)

    @property
    def recorded_env_args(self) -> dict[str, Any]:
        """The environment of the data, for robosuite 1.5, fit for the actions as they were recorded.

        That is what :attr:`env_args` is where the actions are not absolute.
        """
        return modernize_env_args(self._index.env_args)

    @property
    def task(self) -> TaskSpec | None:
        """The task of :data:`warmprior.envs.TASKS` recorded here, or ``None`` if it is another."""
        return self._index.task

    @property
    def observation_keys(self) -> tuple[str, ...]:
        """The keys whose values stand side by side in the observation's vector."""
        return self._index.observation_keys

    @property
    def image_keys(self) -> tuple[str, ...]:
        """The images next to ``("observation", "state")``."""
        return self._index.image_keys

    @property
    def image_size(self) -> int:
        """Side of the images in pixels, 0 if there are none."""
        return self._index.image_size

    @property
    def pose_columns(self) -> Tensor:
        """Where in ``"observation"`` each gripper's position and quaternion are, int64 ``[arms, 7]``.

        Raises:
            KeyError: if they were not read.
        """
        first = dict(
            zip(self.observation_keys, np.cumsum([0, *self._index.observation_dims]), strict=False)
        )
        columns: list[list[int]] = []
        while not columns or f"robot{len(columns)}_eef_pos" in first:
            position, quaternion = (
                first[f"robot{len(columns)}_eef_{end}"] for end in ("pos", "quat")
            )
            columns.append([*range(position, position + 3), *range(quaternion, quaternion + 4)])
        return torch.tensor(columns)

    @property
    def num_episodes(self) -> int:
        """The number of demos read."""
        return len(self._index.demos)

    @property
    def episode_lengths(self) -> Tensor:
        """Steps of each episode, ``[num_episodes]`` int64 on the CPU."""
        return torch.tensor(self._index.lengths)
