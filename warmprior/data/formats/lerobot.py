"""LeRobot's demonstrations: the values of a LeRobotDataset v3 as a replay buffer, or as steps."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warmprior.checks import check_shape
from warmprior.data.formats.lerobot_index import (
    REWARD,
    SUCCESS,
    LeRobotIndex,
    episode_file,
    read_lerobot_index,
)
from warmprior.data.replay import (
    DemonstrationReader,
    DemonstrationReplay,
    Opened,
    reading,
    store_finite,
)
from warmprior.io.extras import require

DECODED = 2**26  # bytes of frames that are unpacked at once
TOLERANCE = 1e-4  # seconds between a step and its frame, as in LeRobot
_AGAIN = (
    "It is damaged, or from another dataset. Copy, download, record or convert it again; recordings end with "
    "LeRobotDataset.finalize()."
)
_REBUILD = "Record the episode again or remove it (lerobot-edit-dataset), or leave it out."


class LeRobotReader(DemonstrationReader):
    """A reader of a dataset's values."""

    def __init__(self, index: LeRobotIndex) -> None:
        self.index = index
        self._file = ""
        self._read: dict[str, np.ndarray] = {}
        self._episodes = dict(zip(index.demos, index.episodes, strict=True))
        features = index.metadata.features
        self._reward = next((name for name in (REWARD, SUCCESS) if name in features), None)

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read rows of an array; rewards are ``next.reward``, ``next.success``, or else zeros."""
        feature, part = self._place(key)
        if feature is None:
            out[...] = 0
            return
        block = self._rows(self._episodes[demo], feature)[first : first + len(out), part]
        store_finite(block, out, self.name(demo, key), _REBUILD, first)

    def terminated(self, demo: str) -> bool | None:
        """Do as the base class describes."""
        if SUCCESS not in self.index.metadata.features:
            return None
        return bool(self._rows(self._episodes[demo], SUCCESS)[-1].any())

    def _rows(self, episode: Mapping[str, Any], feature: str) -> np.ndarray:
        """Return all rows of an episode, ``[rows, width]``."""
        file = episode_file(self.index.metadata, episode)
        if file != self._file:  # columns of one file are kept at a time
            self._file, self._read = file, {}
        start, number = episode["dataset_from_index"], episode["episode_index"]
        with reading(f"{self.index.path / file}", _AGAIN):
            index, numbers = self._column("index")[:, 0], self._column("episode_index")[:, 0]
            first = int(np.searchsorted(index, start))
            rows = slice(first, first + episode["length"])
            expected = np.arange(start, start + episode["length"])
            if not np.array_equal(index[rows], expected) or (numbers[rows] != number).any():
                raise ValueError(f"episode {number} is not where meta/episodes says")
            return self._column(feature)[rows]

    def _column(self, name: str) -> np.ndarray:
        """Return a column of the file, ``[rows, width]``, which is read once."""
        if name not in self._read:
            arrow, parquet = (require(module, "lerobot") for module in ("pyarrow", "pyarrow.parquet"))
            column = parquet.read_table(self.index.path / self._file, columns=[name]).column(name)
            rows, width = len(column), self.index.metadata.features[name]["shape"][0]
            column = column.combine_chunks()
            if arrow.types.is_nested(column.type):  # the cast fails if a row has another length
                column = column.cast(arrow.list_(column.type.value_type, width)).flatten()
            self._read[name] = column.to_numpy(zero_copy_only=False).reshape(rows, width)
        return self._read[name]

    def _place(self, key: str) -> tuple[str | None, slice]:
        if key == "rewards":
            return self._reward, slice(None)
        if key == "actions":
            return "action", slice(None)
        return self.index.columns[key.removeprefix("obs/")]

    def name(self, demo: str, key: str) -> str:
        """Return the name of an episode's array for errors, with the file that holds it."""
        file = episode_file(self.index.metadata, self._episodes[demo])
        feature, observation = self._place(key)[0], key.removeprefix("obs/")
        inside = f" ({observation})" if key != observation != feature else ""
        return f"{self.index.path / file}: {feature}{inside} of episode {demo}"

    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the first frames of an episode; see the base class."""
        episode, feature = self._episodes[demo], self.index.images[key]
        video = feature if feature in self.index.videos else None
        path = self.index.path / episode_file(self.index.metadata, episode, video)
        step = max(1, DECODED // max(1, out[0].numel()))
        with reading(f"{path}", _AGAIN):
            frames = self._video(episode, path, feature) if video else _pictures(episode, path, feature)
            for first in range(0, len(out), step):
                part = out[first : first + step]
                decoded = frames(first, first + len(part))
                check_shape(f"{feature} of episode {demo}", decoded, part.shape)
                part.copy_(decoded)

    def _video(self, episode: Mapping[str, Any], path: Path, feature: str) -> Any:
        decode = require("lerobot.datasets.video_utils", "lerobot").decode_video_frames
        times = self._rows(episode, "timestamp")[:, 0].astype(np.float64)
        times += episode[f"videos/{feature}/from_timestamp"]
        return lambda first, stop: decode(path, times[first:stop].tolist(), TOLERANCE, return_uint8=True)


def _pictures(episode: Mapping[str, Any], path: Path, feature: str) -> Any:
    image, parquet = require("PIL.Image", "lerobot"), require("pyarrow.parquet", "lerobot")
    rows = [("episode_index", "==", episode["episode_index"])]
    column = parquet.read_table(path, columns=[feature], filters=rows).column(feature)

    def frames(first: int, stop: int) -> Tensor:
        # Only their bytes are used: a path in them could lead to any file.
        files = [io.BytesIO(value["bytes"]) for value in column[first:stop].to_pylist()]
        pictures = [np.array(image.open(file).convert("RGB")) for file in files]
        return torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)

    return frames


class LeRobotDemonstrations(DemonstrationReplay):
    """The demonstrations of a LeRobotDataset v3, as one immutable TorchRL replay buffer.

    It has the entries and properties of :class:`RobomimicDemonstrations`. Windows of
    :class:`~warmprior.ActionWindow` equal those of ``delta_timestamps``, except before an episode's start:
    LeRobot repeats the first action, which is part of the target; here the history is masked and zero.

    Only the images in ``image_keys`` of the selected episodes are fetched and decoded, once and by LeRobot's
    own decoder. Without ``next.reward`` the rewards are ``next.success``, or zeros. Episodes whose
    ``next.success`` is True at the end are terminated.

    Args:
        place: the dataset's folder, or its repository on the hub (``"user/name"``).
        revision: branch, tag or commit of a repository.
        env_args: description of the environment in which the dataset was recorded
            (:func:`warmprior.envs.simulator.task_env_args`), for datasets that :func:`convert_robomimic`
            did not write; a converted one must name the same environment. Frequency, widths and names are
            checked against it, and robomimic's observations are found with it. Without it, whole features
            are observations.
        episodes: numbers of the episodes to read; all by default. Files of other episodes are not needed.
        **kwargs: options of :class:`RobomimicDemonstrations`. ``observation_keys`` are by default those of
            the task, or for an unknown environment ``"observation.environment_state"`` and
            ``"observation.state"``, if present. Of ``image_keys``, ``"agentview_image"`` is the feature
            ``observation.images.agentview``, as pictures or a video. ``filter_key`` is a mask of the
            converted file.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if the dataset is invalid, or does not fit the environment; the message names the
            folder or file, and the reason.
        ValueError: see :class:`RobomimicDemonstrations`.
        OSError: if a download fails, or there is no space for memory maps.

    Examples:
        >>> from warmprior.data import LeRobotDemonstrations
        >>> data = LeRobotDemonstrations("square_lerobot", batch_size=256)  # doctest: +SKIP
        >>> data.sample()["observation"].shape  # doctest: +SKIP
        torch.Size([256, 23])
        >>> LeRobotDemonstrations("square_lerobot")
        Traceback (most recent call last):
            ...
        FileNotFoundError: square_lerobot: no meta/info.json there, so no LeRobotDataset; ...
    """

    def __init__(
        self,
        place: str | Path,
        *,
        revision: str | None = None,
        env_args: Mapping[str, Any] | None = None,
        episodes: Sequence[int] | None = None,
        **kwargs: Any,
    ) -> None:
        self._own: dict[str, Any] = {"revision": revision, "env_args": env_args, "episodes": episodes}
        super().__init__(place, **kwargs)

    def _opened(self, stack: ExitStack, place: Any, **chosen: Any) -> Opened:
        index = read_lerobot_index(place, fetch=True, **self._own, **chosen)
        return index, LeRobotReader(index)
