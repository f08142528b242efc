"""LeRobot's demonstrations: LeRobotDatasets v3."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from torch import Tensor

from warmprior.checks import check_shape
from warmprior.data.checks import DatasetError, reading, store_finite
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.formats.lerobot_index import (
    REWARD,
    SUCCESS,
    LeRobotIndex,
    download_lerobot,
    episode_file,
    is_remote,
    read_lerobot_index,
)
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.envs.simulator import task_env_args
from warmprior.io.extras import require
from warmprior.io.files import check_regular

DECODED = 2**26  # bytes of frames that are unpacked at once
TOLERANCE = 1e-4  # seconds between a step and its frame, as in LeRobot
OTHER_RATE, TELLING = 0.02, 10  # the share by which a rate differs from another, and steps that tell it
_AGAIN = (
    "It is damaged, or from another dataset. Copy, download, record or convert it again; recordings end with "
    "LeRobotDataset.finalize()."
)
_REBUILD = "Record the episode again or remove it (lerobot-edit-dataset), or choose others with episodes=."


def check_times(times: np.ndarray, fps: float, what: str) -> None:
    """Raise DatasetError if the time stamps of an episode ``[rows]`` do not fit its rate, or leap."""
    exact = times.astype(np.float64)
    steps = np.diff(exact) * fps
    coarse = fps * np.spacing(abs(times).max(initial=0))  # time stamps in float32 are, after hours
    # Dropped frames change the mean step, rounded time stamps the median, and another rate both.
    paces = (np.median(steps), np.mean(steps)) if len(steps) >= TELLING else ()
    if paces and all(not abs(pace - 1) <= OTHER_RATE + coarse for pace in paces):
        raise DatasetError(
            f"{what} has time stamps {np.mean(steps) / fps:.4g} s apart, but fps in meta/info.json is "
            f"{fps:g}, steps of {1 / fps:.4g} s: correct fps, or resample the dataset"
        )
    if (even := abs(steps - 1) <= 0.5 + coarse).all():
        return
    row = int(even.argmin())
    raise DatasetError(
        f"{what} leaps from {exact[row]:.9g} to {exact[row + 1]:.9g} s at row {row + 1}, at {fps} fps. "
        f"{_REBUILD}"
    )


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

    @override
    def terminated(self, demo: str) -> bool | None:
        if SUCCESS not in self.index.metadata.features:
            return None
        return bool(self._rows(self._episodes[demo], SUCCESS)[-1].any())

    def _rows(self, episode: Mapping[str, Any], feature: str) -> np.ndarray:
        """Return all rows of an episode, ``[rows, width]``."""
        file = episode_file(self.index.metadata, episode)
        if file != self._file:  # columns of one file are kept at a time
            self._file, self._read = file, {}
        start, number = episode["dataset_from_index"], episode["episode_index"]
        with reading(f"{self.index.path / file}: {feature}", _AGAIN):
            check_regular(self.index.path / file)
            index, numbers = self._column("index")[:, 0], self._column("episode_index")[:, 0]
            first = int(np.searchsorted(index, start))
            rows = slice(first, first + episode["length"])
            expected = np.arange(start, start + episode["length"])
            if not np.array_equal(index[rows], expected) or (numbers[rows] != number).any():
                raise ValueError(f"episode {number} is not where meta/episodes says")
            if "timestamp" in self.index.metadata.features:
                times = self._column("timestamp")[rows, 0]
                check_times(times, self.index.metadata.fps, f"{self.index.path / file}: episode {number}")
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

    @override
    def name(self, demo: str, key: str) -> str:
        file = episode_file(self.index.metadata, self._episodes[demo])
        feature, observation = self._place(key)[0], key.removeprefix("obs/")
        inside = f" ({observation})" if key != observation != feature else ""
        return f"{self.index.path / file}: {feature}{inside} of episode {demo}"

    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        """Decode frames in parts."""
        episode, feature = self._episodes[demo], self.index.images[key]
        video = feature if feature in self.index.videos else None
        path = self.index.path / episode_file(self.index.metadata, episode, video)
        shape = (3, *self.index.image_shapes[self.index.image_keys.index(key)])
        length, step = episode["length"], max(1, DECODED // prod(shape))
        with reading(f"{path}: {feature} of episode {demo}", _AGAIN):
            check_regular(path)
            frames = self._video(episode, path, feature) if video else _pictures(episode, path, feature)
            for first in range(0, length, step):
                stop = min(first + step, length)
                decoded = frames(first, stop)
                check_shape(f"{feature} of episode {demo}", decoded, (stop - first, *shape))
                yield decoded

    @override
    def decoders(self, key: str) -> Sequence[str]:
        if self.index.images[key] not in self.index.videos:
            return ("pillow",)
        return "lerobot", {"pyav": "av"}.get(self._backend, self._backend)

    @cached_property
    def _backend(self) -> str:
        """LeRobot's default decoder; LeRobot prints a traceback each time that it looks for one in vain."""
        return str(require("lerobot.utils.import_utils", "lerobot").get_safe_default_video_backend())

    def _video(self, episode: Mapping[str, Any], path: Path, feature: str) -> Any:
        av, video = (require(name, "lerobot") for name in ("av", "lerobot.datasets.video_utils"))
        with av.open(path) as opened:  # to decode a codec that is unknown here would end the process
            if not (opened.streams.video and all(stream.codec_context for stream in opened.streams.video)):
                kinds = ", ".join(stream.type for stream in opened.streams) or "nothing"
                raise ValueError(f"no video with a known codec among its streams: {kinds}")
        times = self._rows(episode, "timestamp")[:, 0].astype(np.float64)
        times += episode[f"videos/{feature}/from_timestamp"]

        def frames(first: int, stop: int) -> Tensor:
            wanted = times[first:stop].tolist()
            try:
                return video.decode_video_frames(path, wanted, TOLERANCE, self._backend, return_uint8=True)
            # No frame is near a time; torchcodec's error where the video ends before.
            except (video.FrameTimestampError, IndexError) as error:
                raise DatasetError(
                    f"{path} has no frame within {TOLERANCE:g} s of some steps of episode "
                    f"{episode['episode_index']}, from {wanted[0]:.2f} to {wanted[-1]:.2f} s. {_REBUILD}"
                ) from error

        return frames


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


class LeRobotDemonstrations(Demonstrations):
    """The demonstrations of a LeRobotDataset v3, ``"lerobot:folder"`` or ``"lerobot:user/name"`` on the hub.

    Windows of :class:`~warmprior.ActionWindow` equal those of ``delta_timestamps``, except before the start
    of an episode: LeRobot repeats the first action, which is part of the target; here the history is masked
    and zero.

    Only chosen images of the selected episodes are fetched and decoded, once and by LeRobot's own decoder.
    ``"front_image"`` stands for the feature ``observation.images.front``, as pictures or a video. Without
    ``next.reward`` the rewards are ``next.success``, or zeros. Episodes whose ``next.success`` is True at the
    end are terminated. Observations are by default those of the task, or for an unknown environment
    ``"observation.environment_state"`` and ``"observation.state"``, if present.

    For a dataset that :func:`convert_robomimic` did not write, ``task`` names the environment: frequency,
    widths and names are checked against it, and robomimic's observations are found with it. Without it, whole
    features are observations. A mask is one of the converted file.

    Args:
        place: the dataset's folder, or its repository on the hub (``"user/name"``).

    Keyword Args:
        episodes: numbers of the episodes to read; all by default. Files of other episodes are not needed.
        revision: branch, tag or commit of a repository.
        options: options of every format, see :func:`open_demonstrations`.
    """

    prefix = "lerobot:"

    def __init__(
        self,
        place: str | Path,
        *,
        episodes: Sequence[int] | None = None,
        revision: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(place, **options)
        self.episodes, self.revision = episodes, revision

    @override
    def check(self) -> None:
        require("lerobot.datasets", "lerobot")
        if not is_remote(self.place) and not Path(self.place).expanduser().is_dir():
            raise FileNotFoundError(f"{self}: no such folder, and no repository user/name of the hub")

    @override
    def resolved(self) -> str:
        remote = is_remote(self.place)
        return str(self) if remote else f"{self.prefix}{Path(self.place).expanduser().resolve()}"

    @override
    def index(
        self, observations: Sequence[str] | None = None, images: Sequence[str] = (), *, poses: bool = False
    ) -> LeRobotIndex:
        return read_lerobot_index(self, observations, images, poses)

    @property
    def env_args(self) -> Mapping[str, Any]:
        """The description of the environment that the task names; empty without one."""
        if isinstance(self.task, str):
            return task_env_args(self.task) if self.task in TASKS else {}
        return self.task or {}

    def fetched(self, index: DatasetIndex) -> LeRobotIndex:
        """Return an index of files that are on this machine."""
        assert isinstance(index, LeRobotIndex)
        if is_remote(self.place) and not all((index.path / file).is_file() for file in index.files):
            folder = download_lerobot(str(self.place), index.files, revision=self.revision)
            return replace(index, path=folder)
        return index

    @contextmanager
    @override
    def reader(self, index: DatasetIndex) -> Iterator[LeRobotReader]:
        yield LeRobotReader(self.fetched(index))

    def contents(self, index: DatasetIndex) -> str:
        """Return the digest of the files of the selected episodes, numbers and images, alone."""
        here = self.fetched(index)
        with reading(f"{here.path}: its files", _AGAIN):
            return here.digest()

    @override
    def origin(self, index: DatasetIndex) -> tuple[dict[str, Any] | None, np.ndarray | None]:
        assert isinstance(index, LeRobotIndex)
        state = index.described.get("first_state")
        return index.described.get("rendering"), None if state is None else np.array(state, np.float64)
