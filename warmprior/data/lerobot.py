"""LeRobot's demonstrations as a TorchRL replay buffer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

from warmprior.data.download import download_lerobot
from warmprior.data.lerobot_index import LeRobotIndex, read_lerobot_index
from warmprior.data.lerobot_meta import DESCRIPTION
from warmprior.data.lerobot_reader import open_lerobot
from warmprior.data.replay import DemonstrationReplay, check_storage

__all__ = ["LeRobotExperienceReplay", "fetch_lerobot", "find_lerobot", "is_repository"]


def is_repository(dataset: str | Path) -> bool:
    """Whether a name is a repository of the hub, ``user/name``, and no folder here."""
    path = Path(dataset)
    named = (
        len(path.parts) == 2 and not path.is_absolute() and path.parts[0] not in (".", "..", "~")
    )
    return named and not path.exists()


def find_lerobot(
    dataset: str | Path, *, revision: str | None = None, **options: Any
) -> LeRobotIndex:
    """Check what describes a LeRobotDataset; of one in the hub nothing else is fetched.

    Args:
        dataset: its folder, or its repository in the hub.

    Keyword Args:
        revision: of a repository, see :func:`~warmprior.data.download_lerobot`.
        options: of :func:`~warmprior.data.lerobot_index.read_lerobot_index`.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if it is not as it should be.
        OSError: if a download fails.
    """
    root = Path(dataset).expanduser()
    if is_repository(dataset):
        root = download_lerobot(str(dataset), revision=revision)
    return read_lerobot_index(root, **options)


def fetch_lerobot(
    dataset: str | Path, *, revision: str | None = None, **options: Any
) -> LeRobotIndex:
    """Check a LeRobotDataset, and then fetch what is to be read of it, where it is in the hub.

    Args:
        dataset: as of :func:`find_lerobot`.

    Keyword Args:
        revision: likewise.
        options: likewise.

    Raises:
        FileNotFoundError: likewise.
        DatasetError: likewise.
        OSError: likewise.
    """
    index = find_lerobot(dataset, revision=revision, **options)
    if is_repository(dataset) and not all((index.path / file).is_file() for file in index.files):
        needed = [str(file) for file in index.files]
        index = replace(index, path=download_lerobot(str(dataset), needed, revision=revision))
    return index


class LeRobotExperienceReplay(DemonstrationReplay):
    """Demonstrations of a LeRobotDataset v3, as one immutable TorchRL replay buffer.

    The counterpart of :class:`RobomimicExperienceReplay`, with the same entries and properties. Columns of
    the parquet files are read as they lie there, episode by episode, instead of item by item through
    ``LeRobotDataset.__getitem__``; :class:`~warmprior.ActionWindow` makes windows of them, whose history and
    padding are those of ``delta_timestamps``, but that what lies outside an episode is masked and zero
    where LeRobot repeats its first action, which is part of the target.

    Of images only those that ``image_keys`` names are fetched and decoded, by LeRobot's own decoder, and of
    the selected episodes alone; without images no video is opened. They are decoded once, into the uint8
    storage: a training sees every frame many times in random order, where decoding a frame of 84 pixels
    takes about ten times as long as gathering it (0.13 and 0.01 ms), and whatever reads the data, in any
    process, finds plain tensors.

    Without ``next.reward`` the rewards are ``next.success``, or zeros.

    Args:
        dataset: the dataset's folder, or its repository in the hub (``"user/name"``).
        revision: branch, tag or commit of a repository.
        env_args: of the environment in which it was recorded (see :func:`warmprior.envs.task_env_args`),
            for datasets that :func:`convert_robomimic` did not write; those are refused if it names
            another. Frequency, widths and names are checked against it, and robomimic's observations found
            by it. Without, whole features are observations.
        filter_key: a mask of the converted file, such as ``"train"``; all episodes if ``None``.
        demos: how many to take, the first ones by their numbers; all if ``None``.
        observation_keys: observations to concatenate; by default those of the task, or of an unknown
            environment ``"observation.environment_state"`` and ``"observation.state"`` as far as there.
        image_keys: images to read as well: ``"agentview_image"`` is the feature
            ``observation.images.agentview``, of pictures or a video. Take ``storage="memmap"`` where they
            are many.
        absolute_actions: see :class:`RobomimicExperienceReplay`; of numbers that were rounded to
            float32.
        storage: ``"memory"``, or ``"memmap"`` for files under ``scratch_dir``.
        scratch_dir: folder of the memory maps; temporary files if ``None``.
        device: device of the tensors; ``"cpu"`` for ``"memmap"``.
        batch_size: steps per :meth:`sample`.
        sampler: a TorchRL sampler; random with replacement by default.
        transform: a TorchRL transform applied to each sample.
        **kwargs: further arguments of :class:`~torchrl.data.TensorDictReplayBuffer`, such as
            ``prefetch``, ``pin_memory`` or ``generator``.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if the dataset is not as it should be, or does not fit the environment; says which
            file and key.
        ValueError: if ``storage`` is unknown or does not fit ``device``, or absolute actions are asked
            of a controller without pose deltas.
        OSError: if a download fails, or there is no space for memory maps.
        ImportError: if pyarrow, or for videos lerobot, is not installed.

    Examples:
        >>> data = LeRobotExperienceReplay("square_lerobot", batch_size=256)  # doctest: +SKIP
        >>> data.sample()["observation"].shape  # doctest: +SKIP
        torch.Size([256, 23])
        >>> LeRobotExperienceReplay("square_lerobot")
        Traceback (most recent call last):
            ...
        FileNotFoundError: square_lerobot: no meta/info.json there, so no LeRobotDataset; ...
    """

    def __init__(
        self,
        dataset: str | Path,
        *,
        revision: str | None = None,
        env_args: Mapping[str, Any] | None = None,
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
        device = check_storage(storage, device)
        index = fetch_lerobot(
            dataset,
            revision=revision,
            filter_key=filter_key,
            observation_keys=observation_keys,
            image_keys=image_keys,
            poses=absolute_actions,
            demos=demos,
            env_args=env_args,
        )
        told = f"{index.path / DESCRIPTION}: env_args" if env_args is None else "env_args"
        super().__init__(
            index,
            open_lerobot(index),
            described=told,
            absolute_actions=absolute_actions,
            storage=storage,
            scratch_dir=scratch_dir,
            device=device,
            batch_size=batch_size,
            sampler=sampler,
            transform=transform,
            **kwargs,
        )
