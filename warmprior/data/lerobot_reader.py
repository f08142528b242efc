"""Reading the values of a LeRobotDataset v3: numbers column by column, frames by LeRobot's decoder."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warmprior.data.hdf5_members import DatasetError
from warmprior.data.index import store_finite
from warmprior.data.lerobot_index import REWARD, SUCCESS, LeRobotIndex
from warmprior.data.lerobot_meta import AGAIN, DESCRIPTION, LeRobotEpisode, reading_parquet
from warmprior.data.replay import DemonstrationReader
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest

__all__ = ["LeRobotReader", "lerobot_digest", "open_lerobot"]

DECODED = 2**26  # bytes of frames unpacked at once
TOLERANCE = 1e-4  # seconds between a step and its frame, LeRobot's own
_REBUILD = "Record the episode again or remove it (lerobot-edit-dataset), or leave it out."


@contextmanager
def open_lerobot(index: LeRobotIndex) -> Iterator[LeRobotReader]:
    """Open what an index selects.

    Args:
        index: see :func:`~warmprior.data.lerobot_index.read_lerobot_index`.

    Yields:
        The reader.
    """
    with ExitStack() as stack:
        yield LeRobotReader(index, stack)


def lerobot_digest(index: LeRobotIndex) -> str:
    """SHA-256 of the contents that can be read through an index: names and bytes of their files.

    These are all numbers, however few episodes are selected, and the images that are. What LeRobot or the hub
    keeps beside (statistics, a card, a cache) does not count.

    Args:
        index: of the dataset, with the images that are used.

    See Also:
        :func:`~warmprior.data.lerobot_index.read_lerobot_index`: makes the index.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from types import SimpleNamespace
        >>> with TemporaryDirectory() as folder:
        ...     index = SimpleNamespace(path=Path(folder), files=[PurePosixPath("file-000.parquet")])
        ...     def digest(content):
        ...         _ = (index.path / "file-000.parquet").write_bytes(content)
        ...         return lerobot_digest(index)
        ...     len({digest(b"one"), digest(b"other"), digest(b"one")})
        2
    """
    root = index.path
    described = [
        path for path in (root / DESCRIPTION, root / "meta" / "info.json") if path.is_file()
    ]
    episodes = root.glob("meta/episodes/*/*.parquet")
    files = sorted({*described, *episodes, *(root / file for file in index.files)})
    return digest_of([[str(path.relative_to(root)), file_digest(path)] for path in files])


class LeRobotReader(DemonstrationReader):
    """The values of a dataset, see :func:`open_lerobot`.

    Args:
        index: what is selected.
        stack: closes the files.
    """

    def __init__(self, index: LeRobotIndex, stack: ExitStack) -> None:
        self.index, self._stack = index, stack
        self._episodes = dict(zip(index.demos, index.episodes, strict=True))
        self._open: tuple[PurePosixPath | None, Any, np.ndarray] = (None, None, np.zeros(1))
        # Of each set of columns: the row groups read last, and the rows of the episode read last.
        self._groups: dict[tuple[str, ...], tuple[Any, Any]] = {}
        self._rows: dict[tuple[str, ...], tuple[int, Any]] = {}
        wanted = [part.feature for part in index.slices.values()]
        rewards = [name for name in (REWARD, SUCCESS) if name in index.features][:1]
        self._reward = rewards[0] if rewards else None
        timestamps = ["timestamp"] if index.images else []
        fixed = ("index", "episode_index", *timestamps, "action", *rewards)
        self._numbers = tuple(dict.fromkeys([*fixed, *wanted]))

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read rows of one array of an episode; see the base class.

        Rewards of a dataset without ``next.reward`` are its ``next.success``, or else zeros.
        """
        episode = self._episodes[demo]
        if key == "rewards":
            feature, columns = self._reward, slice(None)
            if feature is None:
                out[...] = 0
                return
        elif key == "actions":
            feature, columns = "action", slice(None)
        else:
            part = self.index.slices[key.removeprefix("obs/")]
            feature, columns = part.feature, slice(part.start, part.stop)
        block = self._vectors(episode, feature)[first : first + len(out), columns]
        store_finite(block, out, self.name(demo, key), first, _REBUILD)

    def name(self, demo: str, key: str) -> str:
        """What errors call an array of an episode, with the file that holds it."""
        told = {"actions": "action", "rewards": str(self._reward)}.get(key)
        if told is None:
            observation = key.removeprefix("obs/")
            feature = self.index.slices[observation].feature
            told = feature if feature.endswith(observation) else f"{feature} ({observation})"
        return f"{self.index.path / self._episodes[demo].file}: {told} of episode {demo}"

    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the first frames of an episode; see the base class."""
        episode, feature = self._episodes[demo], self.index.images[key]
        step = max(1, DECODED // max(1, out[0].numel()))
        for first in range(0, len(out), step):
            part = out[first : first + step]
            rows = range(first, first + len(part))
            if self.index.features[feature]["dtype"] == "video":
                frames, what = self._video(episode, feature, rows)
            else:
                frames, what = self._pictures(episode, feature, rows)
            if frames.shape != part.shape:
                raise DatasetError(
                    f"{what} has frames of shape {tuple(frames.shape[1:])}, but meta/info.json says "
                    f"{tuple(part.shape[1:])}: record or convert the dataset anew"
                )
            part.copy_(frames)

    def _video(self, episode: LeRobotEpisode, feature: str, rows: range) -> tuple[Tensor, str]:
        file, begin = episode.videos[feature]
        path = self.index.path / file
        if not path.is_file():
            raise DatasetError(f"{path}: there is no such file. {AGAIN}.")
        videos = require("lerobot.datasets.video_utils", "lerobot")
        times = self._vectors(episode, "timestamp")[rows.start : rows.stop, 0].astype(np.float64)
        try:
            frames = videos.decode_video_frames(
                path, (begin + times).tolist(), TOLERANCE, return_uint8=True
            )
        except Exception as error:  # of several decoders, whose errors share no base class
            raise DatasetError(
                f"{path}: the frames of episode {episode.number} cannot be decoded ({error}). {AGAIN}; or "
                "the decoder misses FFmpeg's libraries: see LeRobot's installation"
            ) from error
        return frames, str(path)

    def _pictures(self, episode: LeRobotEpisode, feature: str, rows: range) -> tuple[Tensor, str]:
        image = require("PIL.Image", "lerobot")
        table = self._table(episode, (feature,))
        what = f"{self.index.path / episode.file}: {feature} of episode {episode.number}"
        frames = []
        for row, value in enumerate(table.column(feature)[rows.start : rows.stop].to_pylist()):
            if not isinstance(value, dict) or not isinstance(value.get("bytes"), bytes):
                raise DatasetError(
                    f"{what} holds no picture itself in row {rows.start + row}. {AGAIN}."
                )
            try:
                picture = np.asarray(image.open(io.BytesIO(value["bytes"])).convert("RGB"))
            except Exception as error:  # PIL's errors of damaged pictures share no base class
                raise DatasetError(
                    f"{what} is damaged in row {rows.start + row} ({error}). {AGAIN}."
                ) from error
            frames.append(torch.from_numpy(picture.copy()).permute(2, 0, 1))
        shapes = {frame.shape for frame in frames}
        if len(shapes) > 1:
            raise DatasetError(f"{what} has pictures of several sizes: {AGAIN.lower()}")
        return torch.stack(frames), what

    def _vectors(self, episode: LeRobotEpisode, feature: str) -> np.ndarray:
        """All rows of a feature, ``[rows, width]``."""
        path = self.index.path / episode.file
        with reading_parquet(path):
            column = self._table(episode, self._numbers).column(feature)
            width = int(np.prod(self.index.features.get(feature, {"shape": 1})["shape"]))
            return _as_array(column, width, f"{path}: {feature} of episode {episode.number}")

    def _table(self, episode: LeRobotEpisode, names: Sequence[str]) -> Any:
        """The rows of an episode, of the columns that are always read together."""
        path, key = self.index.path / episode.file, tuple(names)
        number, rows = self._rows.get(key, (None, None))
        if number == episode.number:
            return rows
        with reading_parquet(path):
            file, borders = self._file(episode.file, path)
            start, stop = (n - episode.file_start for n in (episode.start, episode.stop))
            if stop > borders[-1]:
                raise DatasetError(
                    f"{path} has {borders[-1]} rows, but episode {episode.number} ends at row {stop} by "
                    f"meta/episodes: they are not of one recording. {AGAIN}."
                )
            groups = [i for i, (a, b) in enumerate(pairwise(borders)) if a < stop and b > start]
            where = (episode.file, *groups)
            if self._groups.get(key, (None, None))[0] != where:
                missing = [name for name in names if name not in file.schema_arrow.names]
                if missing:
                    raise DatasetError(
                        f"{path}: there is no column {missing[0]!r}, which meta/info.json has. {AGAIN}."
                    )
                self._groups[key] = (where, file.read_row_groups(groups, columns=list(names)))
            table = self._groups[key][1]
            rows = table.slice(start - int(borders[groups[0]]), stop - start)
            if key == self._numbers:
                _check_place(path, episode, rows)
            self._rows[key] = (episode.number, rows)
            return rows

    def _file(self, name: PurePosixPath, path: Path) -> tuple[Any, np.ndarray]:
        """A parquet file, and the first rows of its groups."""
        if self._open[0] != name:
            self._stack.close()
            parquet = require("pyarrow.parquet", "lerobot")
            file = self._stack.enter_context(parquet.ParquetFile(path))
            counts = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
            self._open = (name, file, np.cumsum([0, *counts]))
        return self._open[1], self._open[2]


def _check_place(path: Path, episode: LeRobotEpisode, rows: Any) -> None:
    """Whether rows are those that ``meta/episodes`` says."""
    n = episode.stop - episode.start
    expected = {
        "index": np.arange(episode.start, episode.stop),
        "episode_index": np.full(n, episode.number),
    }
    for name, value in expected.items():
        found = _as_array(rows.column(name), 1, f"{path}: {name}")[:, 0]
        if not np.array_equal(found, value):
            worst = int(np.argmax(found != value))
            raise DatasetError(
                f"{path}: {name} is {found[worst]} in step {worst} of episode {episode.number}, but "
                f"{value[worst]} by meta/episodes: they are not of one recording. {AGAIN}."
            )


def _as_array(column: Any, width: int, what: str) -> np.ndarray:
    """A column of a parquet file as ``[rows, width]``, copied only where it has to be."""
    arrow = require("pyarrow", "lerobot")
    parts = []
    for chunk in column.chunks:
        fixed = arrow.types.is_fixed_size_list(chunk.type)
        listed = fixed or arrow.types.is_list(chunk.type) or arrow.types.is_large_list(chunk.type)
        flat = chunk.flatten() if listed else chunk
        if chunk.null_count or flat.null_count:
            raise DatasetError(f"{what} has empty entries. {_REBUILD}")
        even = fixed or not listed or len(np.unique(np.diff(chunk.offsets.to_numpy()))) < 2
        if not even or len(flat) != width * len(chunk):
            raise DatasetError(f"{what} does not have {width} numbers in every row. {AGAIN}.")
        parts.append(flat.to_numpy(zero_copy_only=False).reshape(len(chunk), width))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
