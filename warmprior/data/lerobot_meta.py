"""Reading the ``meta/`` of a LeRobotDataset v3, with errors that say which file and key is wrong."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

from warmprior.data.hdf5_members import DatasetError
from warmprior.data.index import check_env_args
from warmprior.io.extras import require
from warmprior.io.files import read_json

__all__ = [
    "AGAIN",
    "DESCRIPTION",
    "LeRobotEpisode",
    "check_statistics",
    "info_path",
    "read_description",
    "read_episodes",
    "read_info",
    "reading_parquet",
]

DESCRIPTION = PurePosixPath("meta/warmprior.json")
"""What :func:`warmprior.data.convert_robomimic` writes beside LeRobot's own files, which LeRobot ignores."""

AGAIN = "Copy or download it again, or record or convert the dataset anew"
"""What to do about files that are not whole."""


@dataclass(frozen=True)
class LeRobotEpisode:
    """Where an episode is.

    Attributes:
        number: its ``episode_index``.
        start: the ``index`` of its first step.
        stop: that after its last.
        file: the parquet file below the dataset's folder.
        file_start: the ``index`` of the file's first step.
        videos: of each video feature the file, and the time in it at which the episode begins, in seconds.

    See Also:
        :class:`~warmprior.data.lerobot_index.LeRobotIndex`: has one per selected episode.

    Examples:
        >>> file = PurePosixPath("data/chunk-000/file-001.parquet")
        >>> episode = LeRobotEpisode(number=2, start=251, stop=375, file=file, file_start=120, videos={})
        >>> episode.stop - episode.start, episode.start - episode.file_start  # steps, first row in the file
        (124, 131)
    """

    number: int
    start: int
    stop: int
    file: PurePosixPath
    file_start: int
    videos: Mapping[str, tuple[PurePosixPath, float]]


@contextmanager
def reading_parquet(path: Path) -> Iterator[None]:
    """Name the file in whatever goes wrong while it is read.

    Args:
        path: of the parquet file.

    Raises:
        DatasetError: for any error inside.
    """
    try:
        yield
    except (DatasetError, MemoryError):
        raise
    except Exception as error:  # pyarrow's own, OSError, KeyError for its columns...
        there = (
            f"{path.stat().st_size} bytes; {error}" if path.is_file() else "there is no such file"
        )
        raise DatasetError(
            f"{path}: not a readable parquet file ({there}). It was cut short, or its recording did not "
            f"end with LeRobotDataset.finalize(). {AGAIN}."
        ) from error


def info_path(root: Path) -> Path:
    """Of the file that describes a dataset, in its folder."""
    return root / "meta" / "info.json"


def _json(path: Path) -> Any:
    try:
        return read_json(path)
    except ValueError as error:
        raise DatasetError(f"{error}. {AGAIN}.") from error


def read_info(root: Path) -> dict[str, Any]:
    """The checked contents of ``meta/info.json``.

    Args:
        root: the dataset's folder.

    Raises:
        FileNotFoundError: if there is none.
        DatasetError: if it is of another version, or not complete.
    """
    path = info_path(root)
    if not path.exists():
        raise FileNotFoundError(
            f"{root}: no meta/info.json there, so no LeRobotDataset; check the path"
        )
    info = _json(path)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str):
        raise DatasetError(f"{path} has no codebase_version: not of a LeRobotDataset")
    major = version.removeprefix("v").partition(".")[0]
    if major != "3":
        older = major.isdecimal() and int(major) < 3
        raise DatasetError(
            f"{path}: codebase_version is {version}, and v3 is read. "
            + (
                "Convert the dataset: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=REPO"
                if older
                else "Update this library, or save the dataset with lerobot 0.6"
            )
        )
    for key, kind in {
        "fps": (int, float),
        "features": dict,
        "total_episodes": int,
        "total_frames": int,
        "data_path": str,
    }.items():
        if not isinstance(info.get(key), kind) or isinstance(info[key], bool):  # type: ignore[arg-type]
            raise DatasetError(f"{path}: {key} is missing, or of another type. {AGAIN}.")
    for name, feature in info["features"].items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        if not (
            isinstance(shape, list)
            and all(isinstance(n, int) and n > 0 for n in shape)
            and isinstance(feature.get("dtype"), str)
        ):
            raise DatasetError(f"{path}: the feature {name!r} has no dtype or shape. {AGAIN}.")
    if info["total_episodes"] < 1:
        raise DatasetError(f"{path}: the dataset has no episodes: record some")
    return info


def read_description(root: Path, features: Mapping[str, Any]) -> dict[str, Any]:
    """What :data:`DESCRIPTION` holds; nothing in datasets that were not converted.

    Args:
        root: the dataset's folder.
        features: of ``meta/info.json``.

    Raises:
        DatasetError: if it is of another version or dataset.
    """
    path = root / DESCRIPTION
    if not path.exists():
        return {}
    found = _json(path)
    if not isinstance(found, dict) or found.get("format") != 1:
        raise DatasetError(f"{path} is not of this version: convert the file again, or remove it")
    check_env_args(f"{path}: env_args", found.get("env_args"))
    observations, masks = found.get("observations"), found.get("masks", {})
    for key, value in (observations if isinstance(observations, dict) else {"": None}).items():
        if not _is_slice(value, features):
            raise DatasetError(
                f"{path}: observations[{key!r}] names no columns of a feature of meta/info.json, but "
                f"{value}: convert the file again, or remove {path.name}"
            )
    rendering, state = found.get("rendering"), found.get("first_state")
    checks = {
        "masks": isinstance(masks, dict)
        and all(isinstance(m, list) and all(type(n) is int for n in m) for m in masks.values()),
        "rendering": rendering is None or (isinstance(rendering, dict) and "fast" in rendering),
        "first_state": state is None
        or (isinstance(state, list) and all(isinstance(x, float) for x in state)),
    }
    for name, well in checks.items():
        if not well:
            raise DatasetError(f"{path}: {name} is not what a conversion writes: convert again")
    return found


def _is_slice(value: Any, features: Mapping[str, Any]) -> bool:
    """Whether a value is the name of a feature that is a vector, and two of its columns."""
    if not (isinstance(value, list) and len(value) == 3 and isinstance(value[0], str)):
        return False
    shape = features[value[0]]["shape"] if value[0] in features else []
    start, stop = value[1:]
    whole = type(start) is int and type(stop) is int
    return whole and len(shape) == 1 and 0 <= start < stop <= shape[0]


def check_statistics(root: Path, features: Sequence[str]) -> None:
    """Refuse a dataset without the statistics of some features.

    Args:
        root: the dataset's folder.
        features: their names.

    Raises:
        DatasetError: naming the first that ``meta/stats.json`` lacks.
    """
    path = root / "meta" / "stats.json"
    statistics = _json(path) if path.exists() else None
    missing = [n for n in features if not isinstance(statistics, dict) or n not in statistics]
    if missing:
        told = "there is no such file" if statistics is None else f"it lacks {missing[0]!r}"
        raise DatasetError(
            f"{path}: {told}, and LeRobot's policies need the statistics: the dataset is not complete. "
            f"Copy it again, or run: lerobot-edit-dataset --repo_id REPO --root {root} --new_repo_id REPO "
            "--operation.type recompute_stats --operation.overwrite true"
        )


def _file(root: Path, template: Any, **numbers: Any) -> PurePosixPath:
    """A file that ``meta/info.json`` names by a template."""
    try:
        # Nothing else than the numbers, and of no width that would fill the memory.
        for _, name, spec, conversion in Formatter().parse(template):
            known = name is None or name in numbers
            if not known or conversion or not re.fullmatch(r"(0?\d{1,2}d)?", spec or ""):
                raise ValueError(template)
        path = PurePosixPath(template.format(**numbers))
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{info_path(root)}: {template!r} is no path of the format") from error
    if path.is_absolute() or ".." in path.parts:
        raise DatasetError(f"{info_path(root)}: {template!r} leads out of the dataset")
    return path


def read_episodes(
    root: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> list[LeRobotEpisode]:
    """Where every episode is, after checking that they follow each other.

    Args:
        root: the dataset's folder.
        info: see :func:`read_info`.
        videos: the video features to find as well.

    Raises:
        DatasetError: if the files cannot be read, or disagree with each other or with ``info``.
    """
    rows = _episode_rows(root, videos)
    folder, told = root / "meta" / "episodes", []
    if [row["episode_index"] for row in rows] != list(range(info["total_episodes"])):
        told.append(
            f"episode_index is not 0 to {info['total_episodes'] - 1}, as total_episodes of info.json has it, "
            f"but {len(rows)} numbers"
        )
    borders = [row["dataset_from_index"] for row in rows] + [info["total_frames"]]
    for row, (start, stop) in zip(rows, pairwise(borders), strict=True):
        given = (row["dataset_from_index"], row["dataset_to_index"], row["length"])
        if given != (start, stop, stop - start) or stop <= start:
            told.append(
                f"episode {row['episode_index']} of length {given[2]} goes from {given[0]} to {given[1]}, "
                f"but the next one (or total_frames of info.json) begins at {stop}"
            )
    if borders[0] != 0:
        told.append(f"dataset_from_index begins at {borders[0]}, not at 0")
    if told:
        raise DatasetError(
            f"{folder}: {told[0]}. The episodes do not follow each other: the recording did not end with "
            f"LeRobotDataset.finalize(), or files are missing or of another version. {AGAIN}."
        )
    file_starts: dict[PurePosixPath, int] = {}
    found = []
    for row in rows:
        numbers = {f"{part}_index": row[f"data/{part}_index"] for part in ("chunk", "file")}
        file, start = _file(root, info["data_path"], **numbers), row["dataset_from_index"]
        found.append(
            LeRobotEpisode(
                number=row["episode_index"],
                start=start,
                stop=row["dataset_to_index"],
                file=file,
                file_start=file_starts.setdefault(file, start),
                videos={name: _video(root, info, row, name) for name in videos},
            )
        )
    return found


def _episode_rows(root: Path, videos: Sequence[str]) -> list[dict[str, Any]]:
    parquet = require("pyarrow.parquet", "lerobot")
    paths = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    if not paths:
        raise DatasetError(
            f"{root}: there is no meta/episodes/chunk-*/file-*.parquet: the recording did not end with "
            f"LeRobotDataset.finalize(). {AGAIN}."
        )
    names = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
    names += ["data/chunk_index", "data/file_index"]
    for video in videos:
        names += [
            f"videos/{video}/{end}" for end in ("chunk_index", "file_index", "from_timestamp")
        ]
    rows: list[dict[str, Any]] = []
    for path in paths:
        with reading_parquet(path), parquet.ParquetFile(path) as file:
            missing = [name for name in names if name not in file.schema_arrow.names]
            if missing:
                raise DatasetError(f"{path}: there is no column {missing[0]!r}. {AGAIN}.")
            table = file.read(columns=names)
            if any(column.null_count for column in table.columns):
                raise DatasetError(f"{path}: there are empty entries. {AGAIN}.")
            rows += table.to_pylist()
            if any(not isinstance(value, int | float) for row in rows for value in row.values()):
                raise DatasetError(f"{path}: there is text where a number belongs. {AGAIN}.")
    return sorted(rows, key=lambda row: row["episode_index"])


def _video(
    root: Path, info: Mapping[str, Any], row: Mapping[str, Any], name: str
) -> tuple[PurePosixPath, float]:
    numbers = {f"{part}_index": row[f"videos/{name}/{part}_index"] for part in ("chunk", "file")}
    file = _file(root, info.get("video_path"), video_key=name, **numbers)
    return file, row[f"videos/{name}/from_timestamp"]
