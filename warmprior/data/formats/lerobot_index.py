"""The index of a LeRobotDataset v3, read from its ``meta/``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import accumulate, pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, override

from warmprior.data.checks import (
    DatasetError,
    check_count,
    check_env_args,
    declared_poses,
    reading,
    unknown_name_error,
)
from warmprior.data.index import DatasetIndex, pose_keys
from warmprior.envs.robosuite_tasks import TaskSpec, task_of_env
from warmprior.io.extras import require
from warmprior.io.files import check_regular, digest_of, file_digest, is_repository, read_json
from warmprior.lerobot.names import ROBOT_STATE, named_joints, number_names, short_names, unseen_tasks

if TYPE_CHECKING:
    from warmprior.data.formats.lerobot import LeRobotDemonstrations

DESCRIPTION = "meta/warmprior.json"
"""The file that :func:`warmprior.data.convert_robomimic` adds to LeRobot's own, and that LeRobot ignores."""

ENVIRONMENT_STATE = "observation.environment_state"
REWARD, SUCCESS = "next.reward", "next.success"
_COUNTERS = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
_ARM_ACTIONS = ("x", "y", "z", "rx", "ry", "rz", "gripper")

LEROBOT_VERSION = "v3.0"
"""The tag by which the hub's LeRobotDatasets name the version of their format."""


def download_lerobot(
    repository: str, files: Sequence[str] = ("meta/*",), *, revision: str | None = None
) -> Path:
    """Fetch the files of a LeRobotDataset that match patterns, if needed; return the dataset's folder.

    As in LeRobot, ``$HF_LEROBOT_HOME/REPOSITORY`` comes first, then its cache, which needs no connection.
    """
    default = Path(require("huggingface_hub.constants", "lerobot").HF_HOME) / "lerobot"
    home = Path(os.environ.get("HF_LEROBOT_HOME") or default).expanduser()
    if revision is None and (home / repository / "meta" / "info.json").is_file():
        return home / repository
    revision = LEROBOT_VERSION if revision is None else revision
    try:
        folder = require("huggingface_hub", "lerobot").snapshot_download(
            repository,
            repo_type="dataset",
            revision=revision,
            cache_dir=home / "hub",
            allow_patterns=list(files),
        )
    except Exception as error:  # the client's errors share no base class
        raise OSError(
            f"there is no folder {repository}, and it could not be downloaded at {revision} ({error!r}): "
            "check name and connection; older datasets lack this revision until python -m "
            "lerobot.scripts.convert_dataset_v21_to_v30"
        ) from error
    return Path(folder)


@dataclass(frozen=True, kw_only=True)
class LeRobotIndex(DatasetIndex):
    """The index of a LeRobotDataset, without its values.

    Attributes:
        metadata: LeRobot's own ``LeRobotDatasetMetadata``.
        episodes: the rows of ``meta/episodes`` of the selected episodes.
        columns: for each observation, the feature that holds it and its columns there.
        described: the content of ``meta/warmprior.json``; empty for datasets that were not converted.
    """

    metadata: Any
    episodes: tuple[Mapping[str, Any], ...]
    columns: Mapping[str, tuple[str, slice]]
    described: Mapping[str, Any]

    @property
    @override
    def numbers(self) -> dict[str, list[str]]:
        features, whole = self.metadata.features, slice(None)
        parts = {key: self.columns[key] for key in self.observation_keys} | {"action": ("action", whole)}
        named = {key: number_names(features[name])[columns] for key, (name, columns) in parts.items()}
        return {key: names for key, names in named.items() if names}

    @property
    @override
    def left_out(self) -> dict[str, list[str]]:
        others = super().left_out
        seen = "task_index" in self.observation_keys
        tasks = [] if seen else unseen_tasks(row.get("tasks") for row in self.episodes)
        return others | {"": [*others.get("", []), *tasks]} if tasks else others

    @property
    def videos(self) -> list[str]:
        """The features of the selected images that are videos."""
        return [name for name in self.images.values() if name in self.metadata.video_keys]

    @property
    def files(self) -> list[str]:
        """The files outside ``meta/`` that hold the selection, relative to the folder."""
        return sorted(
            {episode_file(self.metadata, e, n) for e in self.episodes for n in [None, *self.videos]}
        )

    def digest(self) -> str:
        """Return the SHA-256 of all files of numbers, and of those with selected images."""
        meta = ("meta/info.json", DESCRIPTION, "meta/episodes/*/*.parquet")
        files = {path for pattern in meta for path in self.path.glob(pattern)}
        files |= {self.path / file for file in self.files}
        return digest_of([[str(p.relative_to(self.path)), file_digest(p)] for p in sorted(files)])


def episode_file(metadata: Any, episode: Mapping[str, Any], video: str | None = None) -> str:
    """Return the file, relative to the dataset's folder, with an episode's numbers or its video."""
    part = "data" if video is None else f"videos/{video}"
    numbers = {f"{n}_index": episode[f"{part}/{n}_index"] for n in ("chunk", "file")}
    template = metadata.data_path if video is None else metadata.video_path
    file = template.format(video_key=video, **numbers)
    if file.startswith("/") or ".." in file.split("/"):
        raise DatasetError(f"{metadata.root}: meta/info.json names {file!r}, which is not in the folder")
    return file


def is_remote(dataset: str | Path) -> bool:
    """Return True if a name is a repository on the hub, ``user/name``, and not a local folder."""
    return is_repository(str(dataset)) and not Path(dataset).exists()


def _metadata(root: Path) -> Any:
    """Check the metadata in a folder, and let LeRobot read it without a request to the hub."""
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"{root}: no meta/info.json there, so no LeRobotDataset; check the path")
    datasets = require("lerobot.datasets", "lerobot")
    again = "Copy, download, record or convert it again."
    with reading(f"{root}: LeRobot's meta/", again):
        for opened in ("info.json", "stats.json", "tasks.parquet", "episodes/*/*.parquet"):
            for path in (root / "meta").glob(opened):
                check_regular(path)
        version = _check_info(read_json(root / "meta" / "info.json"))
    if version != LEROBOT_VERSION:
        raise DatasetError(
            f"{root} is a LeRobotDataset {version}, but {LEROBOT_VERSION} is needed: convert v2.1 with "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30"
        )
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet"):
        if not any(root.glob(pattern)):  # LeRobot would look for it on the hub
            raise DatasetError(f"{root} has no {pattern}; recordings end with finalize(). {again}")
    with reading(f"{root}: LeRobot's meta/", again):
        metadata = datasets.LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    used = ("episode_index", "length", "dataset_from_index", "data/chunk_index", "data/file_index")
    _check_columns(root, metadata, used)
    numbers, steps = sorted(metadata.episodes["episode_index"]), sum(metadata.episodes["length"])
    count, frames = metadata.total_episodes, metadata.total_frames
    if not count or numbers != list(range(count)) or steps != frames:
        raise DatasetError(
            f"{root}: meta/info.json counts {count} episodes with {frames} steps, but meta/episodes "
            f"{len(numbers)} with {steps}. {again}"
        )
    return metadata


_TEMPLATE = re.compile(r"([^{}]|\{(video_key|(chunk_index|file_index)(:0?\d{1,2}d?)?)\})*")
"""Paths with these fields and plain formats only: others could expand to any length."""


def _check_info(info: Any) -> str:
    """Check the entries of ``meta/info.json`` that are used, and return its version; may raise ValueError."""

    def need(name: str, value: Any, good: bool) -> None:
        if not good:
            raise ValueError(f"meta/info.json has {name}={str(value)[:80]}")

    need("its content", info, isinstance(info, dict))
    version, features, fps = (info.get(name) for name in ("codebase_version", "features", "fps"))
    need("codebase_version", version, isinstance(version, str))
    if version != LEROBOT_VERSION:
        return version  # whose other entries are different
    need("fps", fps, isinstance(fps, int | float) and fps > 0)
    for name in ("total_episodes", "total_frames"):
        need(name, info.get(name), type(info.get(name)) is int)
    need("features", features, isinstance(features, dict))
    for name, feature in features.items():
        need(f"features.{name}", feature, isinstance(feature, dict))
        dtype, shape = feature.get("dtype"), feature.get("shape")
        need(f"features.{name}.dtype", dtype, isinstance(dtype, str))
        good = isinstance(shape, list) and all(type(size) is int and size >= 0 for size in shape)
        need(f"features.{name}.shape", shape, good)
        for part, kinds in {"names": (list, dict), "info": (dict,), "video_info": (dict,)}.items():
            value = feature.get(part)
            need(f"features.{name}.{part}", value, value is None or isinstance(value, kinds))
    videos = any(feature["dtype"] == "video" for feature in features.values())
    for name, used in {"data_path": True, "video_path": videos}.items():
        path = info.get(name)
        if path is not None or (used and name in info):  # LeRobot's own by default
            good = isinstance(path, str) and _TEMPLATE.fullmatch(path) is not None
            need(name, path, good and (name == "video_path" or "{video_key}" not in path))
    return version


def _check_columns(root: Path, metadata: Any, names: Sequence[str]) -> None:
    """Raise DatasetError unless ``meta/episodes`` has columns of whole numbers of at least 0."""
    for name in names:
        values = metadata.episodes[name][:] if name in metadata.episodes.column_names else [None]
        if not all(type(value) is int and value >= 0 for value in values):
            raise DatasetError(
                f"{root}: meta/episodes has no whole numbers of at least 0 as {name}: download or convert it "
                "again"
            )


def _check_frames(root: Path, metadata: Any, video: str, chosen: Set[int]) -> None:
    """Raise DatasetError if one of the chosen episodes has frames of a video that are another's as well."""
    names = [f"videos/{video}/{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
    with reading(f"{root}: {names[-1]} of meta/episodes", "Download or convert it again."):
        columns = (metadata.episodes[name][:] for name in (*names, "length", "episode_index"))
        last: tuple[list[Any], float, int] = [], 0.0, 0  # the file, and where which episode ends there
        for *file, start, length, number in sorted(zip(*columns, strict=True)):
            before, end, other = last
            if file == before and start < end and not chosen.isdisjoint((number, other)):
                raise ValueError(
                    f"the frames of the episodes {other} and {number} overlap in {video} at "
                    f"{metadata.fps:g} fps, the rate of meta/info.json"
                )
            # A video may lack its last frame.
            ends = start + max(length - 1.5, 0.5) / metadata.fps
            if file != before or ends > end:
                last = file, ends, number


def _chosen(root: Path, what: str, numbers: Any, count: int) -> list[int]:
    """Check episode numbers, and return them sorted and without repetition."""
    if any(type(number) is not int or not 0 <= number < count for number in numbers):
        raise DatasetError(
            f"{root}: {what} must be some of the episodes 0 to {count - 1}, got {list(numbers)}"
        )
    return sorted(set(numbers))


def camera_images(features: Iterable[str]) -> dict[str, str]:
    """Return cameras by the names of their images, ``front_image`` for ``observation.images.front``."""
    return {f"{short}_image": name for name, short in short_names(features).items()}


def action_names(arms: int) -> list[str]:
    """Return a dataset's names for the pose deltas of robosuite arms, such as ``robot0_rx``."""
    return [f"robot{arm}_{name}" for arm in range(arms) for name in _ARM_ACTIONS]


def state_names(widths: Mapping[str, int]) -> list[str]:
    """Return a dataset's names for the numbers of observations of these widths, in the same order."""
    return [f"{key}_{i}" for key, width in widths.items() for i in range(width)]


def layout_of(widths: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Return the features of a converted dataset, each with its robomimic observations and their widths."""
    robots = {key: width for key, width in widths.items() if key.startswith("robot")}
    others = {key: width for key, width in widths.items() if key not in robots}
    layout = {ENVIRONMENT_STATE: others, ROBOT_STATE: robots}
    return {feature: parts for feature, parts in layout.items() if parts}


def read_lerobot_index(
    demonstrations: LeRobotDemonstrations,
    observations: Sequence[str] | None,
    images: Sequence[str],
    poses: bool,
) -> LeRobotIndex:
    """Return the index of a LeRobotDataset v3 from its ``meta/``, without reading values.

    From a dataset on the hub only ``meta/`` is fetched.
    """
    dataset, revision, env_args = demonstrations.place, demonstrations.revision, demonstrations.env_args
    remote = is_remote(dataset)
    root = download_lerobot(str(dataset), revision=revision) if remote else Path(dataset).expanduser()
    metadata = _metadata(root)
    described = _description(root)
    recorded = described.get("env_args") or dict(env_args)
    name = recorded.get("env_name")
    if env_args and name != env_args["env_name"]:
        raise DatasetError(f"{root} was recorded in {name}, not in {env_args['env_name']}: correct env_args")
    task = task_of_env(recorded) if recorded else None
    widths = {
        name: feature["shape"][0]
        for name, feature in metadata.features.items()
        if len(feature["shape"]) == 1 and feature["dtype"].startswith(("float", "int", "uint", "bool"))
    }
    if "action" not in widths:
        raise unknown_name_error(root, "vector of numbers", "action", widths)
    if recorded:
        _check_actions(root, metadata, recorded, task)
    named = _named_columns(root, metadata.features, widths, described, task)
    vectors = {name: (name, slice(0, width)) for name, width in widths.items() if name != "action"}
    columns = named | vectors
    if observations is None:
        observations = tuple(named)
        if task is not None:
            observations = task.low_dim_keys
        elif not described:
            observations = [key for key in (ENVIRONMENT_STATE, ROBOT_STATE) if key in columns]
    for key in [*observations, *(pose_keys(widths["action"]) if poses else ())]:
        if key in metadata.camera_keys:
            raise DatasetError(f"{root}: {key!r} is an image, not a vector: name it in images")
        if key not in columns and (feature := metadata.features.get(key)):
            raise DatasetError(
                f"{root}: {key!r} has dtype {feature['dtype']} and shape {list(feature['shape'])}, but "
                "observations must be vectors of numbers: leave it out, or write it as a vector"
            )
        if key not in columns:
            options = [name for name in columns if name in named or name.startswith("observation")]
            raise unknown_name_error(root, "observation", key, options)
    cameras = camera_images(name for name in metadata.camera_keys if name not in metadata.depth_keys)
    own = {feature: image for image, feature in cameras.items()}  # LeRobot's own names are known as well
    images = [own.get(name, name) for name in images]
    rows = sorted(metadata.episodes.to_list(), key=lambda row: row["episode_index"])
    count = len(rows)
    if demonstrations.episodes is not None:
        rows = [rows[number] for number in _chosen(root, "episodes", demonstrations.episodes, count)]
    mask = demonstrations.mask
    if mask is not None:
        masks = described.get("masks", {})
        if mask not in masks:
            raise unknown_name_error(root, "filter key", mask, masks)
        chosen = _chosen(root, f"the mask {mask!r}", masks[mask], count)
        if not chosen:
            raise DatasetError(f"{root}: the mask {mask!r} names no episode: choose another, or none")
        rows = [row for row in rows if row["episode_index"] in chosen]
    check_count(root, demonstrations.demos, len(rows))
    rows = rows[: demonstrations.demos]
    others = [name for name in metadata.features if name not in widths and name not in cameras.values()]
    # What counts steps is no observation, nor is a feature whose parts have names of their own.
    hidden = _COUNTERS | {feature for feature, _ in named.values()}
    available = [n for n in (*columns, *cameras, *others) if n not in hidden and not n.startswith("next.")]
    index = LeRobotIndex(
        path=root,
        demos=tuple(str(row["episode_index"]) for row in rows),
        lengths=tuple(row["length"] for row in rows),
        observation_keys=tuple(observations),
        observation_dims=tuple(columns[key][1].stop - columns[key][1].start for key in observations),
        **demonstrations.image_entries(
            images, {key: _image_shape(root, metadata.features, cameras, key) for key in images}
        ),
        available_keys=tuple(available),
        taken_by=dict.fromkeys(cameras, "images") | dict.fromkeys(others, ""),
        action_dim=widths["action"],
        env_args=recorded,
        task=task,
        whole=len(rows) == count,
        rate=metadata.fps,
        metadata=metadata,
        episodes=tuple(rows),
        columns=columns,
        images={key: cameras[key] for key in images},
        joints=named_joints(metadata.features, observations),
        described=described,
    )
    parts = product(index.videos, ("chunk", "file"))
    _check_columns(root, metadata, [f"videos/{name}/{part}_index" for name, part in parts])
    for name in index.videos:
        _check_frames(root, metadata, name, {row["episode_index"] for row in rows})
    return index


def _description(root: Path) -> dict[str, Any]:
    path = root / DESCRIPTION
    if not path.exists():
        return {}
    with reading(f"{path}", "Convert the file again."):
        description = read_json(path)
    if not (isinstance(description, dict) and description.get("format") == 1):
        raise DatasetError(f"{path} is from another version: convert the file again, or remove it")
    observations, masks = description.get("observations"), description.get("masks", {})
    for name, value, good in (
        ("observations", observations, _is_column_range),
        ("masks", masks, lambda numbers: isinstance(numbers, list)),
    ):
        if not (isinstance(value, dict) and all(map(good, value.values()))):
            raise DatasetError(f"{path}: {name} is {str(value)[:80]}: convert the file again, or remove it")
    check_env_args(f"{path}: env_args", description.get("env_args"))
    return description


def _is_column_range(value: Any) -> bool:
    """Return True if a value names a feature and the columns of an observation there."""
    return isinstance(value, list) and [type(part) for part in value] == [str, int, int]


def _check_names(root: Path, feature: Mapping[str, Any], expected: list[str], what: str) -> None:
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]} or {"x": 0, "y": 1, ...}
        lists = [value for value in names.values() if isinstance(value, list)]
        names = [name for value in lists for name in value] if lists else list(names)
    # Names are compared because seven numbers may be joints or a pose.
    if names and names != expected:
        raise DatasetError(
            f"{root}: {what} {', '.join(expected)}, but here {', '.join(map(str, names))}: choose another "
            "task, or set names in meta/info.json to null if they mean the same"
        )


def _check_actions(root: Path, metadata: Any, env_args: Mapping[str, Any], task: TaskSpec | None) -> None:
    """Raise DatasetError unless the actions are those of an environment, one per control step."""
    name, control = env_args["env_name"], env_args["env_kwargs"].get("control_freq", 20)
    if metadata.fps != control:
        raise DatasetError(f"{root}: fps is {metadata.fps}, but {name} runs at {control} Hz: resample it")
    if task is None or declared_poses(root, env_args) is None:
        return
    action = metadata.features["action"]
    if (columns := action["shape"][0]) != task.action_dim:
        raise DatasetError(f"{root}: 'action' has {columns} columns, but {name} takes {task.action_dim}")
    _check_names(root, action, action_names(task.arms), f"the actions of {name} are")


def _named_columns(
    root: Path,
    features: Mapping[str, Any],
    widths: Mapping[str, int],
    described: Mapping[str, Any],
    task: TaskSpec | None,
) -> dict[str, tuple[str, slice]]:
    """Return the feature that holds each of robomimic's observations, and its columns there."""
    vectors = {name: width for name, width in widths.items() if name.startswith("observation.")}
    if described:
        places = {key: (name, slice(*ends)) for key, (name, *ends) in described["observations"].items()}
        needed = {} if task is None else task.low_dim_widths
        for key, (name, part) in places.items():
            width = needed.get(key, part.stop - part.start)
            if not 0 <= part.start < part.stop == part.start + width <= vectors.get(name, 0):
                what = f"observations[{key!r}], columns {part.start} to {part.stop} of {name},"
                raise DatasetError(f"{root / DESCRIPTION}: {what} do not fit: convert the file again")
        return places
    if task is None:
        return {}
    layouts: list[dict[str, dict[str, int]]] = [
        {f"observation.{key}": {key: width} for key, width in task.low_dim_widths.items()},
        layout_of(task.low_dim_widths),
        {ROBOT_STATE: task.low_dim_widths},
    ]
    sums = [{name: sum(parts.values()) for name, parts in layout.items()} for layout in layouts]
    fits = [total.items() <= vectors.items() for total in sums]
    # A robot's state may be as wide as the whole state of another task.
    fits[2] = fits[2] and ENVIRONMENT_STATE not in vectors
    if not any(fits):
        raise DatasetError(
            f"{root}: the observations are {vectors}, but those of {task.env_name} "
            f"{' or '.join(map(str, reversed(sums)))}: choose another task or dataset"
        )
    layout = layouts[fits.index(True)]
    columns: dict[str, tuple[str, slice]] = {}
    for name, parts in layout.items():
        if name in (ENVIRONMENT_STATE, ROBOT_STATE):
            what = f"the numbers of {name} in {task.env_name} are"
            _check_names(root, features[name], state_names(parts), what)
        ends = pairwise(accumulate(parts.values(), initial=0))
        columns |= {key: (name, slice(*end)) for key, end in zip(parts, ends, strict=True)}
    return {key: columns[key] for key in task.low_dim_widths}


def _image_shape(
    root: Path, features: Mapping[str, Any], cameras: Mapping[str, str], key: str
) -> tuple[int, int]:
    """Return height and width of an image as it is stored."""
    if key not in cameras:
        raise unknown_name_error(root, "images", key, cameras)
    match features[cameras[key]]["shape"]:
        case (3, height, width) | (height, width, 3) if min(height, width) > 0:
            return height, width
        case shape:
            kind = f"{cameras[key]!r} has shape {tuple(shape)}"
            raise DatasetError(f"{root}: {kind}, but images have height, width and 3 colours: leave it out")
