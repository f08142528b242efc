"""What a LeRobotDataset v3 holds, with errors that say which file and key is wrong.

:func:`read_lerobot_index` looks at ``meta/`` alone, and finds all that is wrong with it before anything big
is read or fetched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from warmprior.data.hdf5_members import DatasetError
from warmprior.data.index import DatasetIndex, check_count, task_of_env
from warmprior.data.lerobot_meta import (
    DESCRIPTION,
    LeRobotEpisode,
    check_statistics,
    info_path,
    read_description,
    read_episodes,
    read_info,
)
from warmprior.envs.tasks import TaskSpec

__all__ = [
    "ENVIRONMENT_STATE",
    "REWARD",
    "ROBOT_STATE",
    "SUCCESS",
    "LeRobotIndex",
    "LeRobotSlice",
    "action_names",
    "read_lerobot_index",
    "state_names",
]

ENVIRONMENT_STATE, ROBOT_STATE = "observation.environment_state", "observation.state"
REWARD, SUCCESS = "next.reward", "next.success"
FLOATS = ("float16", "float32", "float64")
_ARM_ACTIONS = ("x", "y", "z", "rx", "ry", "rz", "gripper")


@dataclass(frozen=True)
class LeRobotSlice:
    """Columns of a vector feature.

    Attributes:
        feature: its name, such as ``"observation.state"``.
        start: the first column.
        stop: the one after the last.

    See Also:
        :class:`~warmprior.data.lerobot_index.LeRobotIndex`: has one per observation.

    Examples:
        >>> gripper = LeRobotSlice("observation.state", start=7, stop=9)
        >>> frame = {"observation.state": list(range(9))}
        >>> frame[gripper.feature][gripper.start : gripper.stop]
        [7, 8]
    """

    feature: str
    start: int
    stop: int


@dataclass(frozen=True)
class LeRobotIndex(DatasetIndex):
    """What a LeRobotDataset holds, without its values.

    Attributes:
        episodes: where each selected episode is.
        slices: where each observation is.
        features: all of ``meta/info.json``.
        images: the feature of each of the images to read.
        rendering: how the images were rendered, where that is known.
        first_state: of the simulator in the first step of all, where that is known.

    See Also:
        :func:`~warmprior.data.lerobot_index.read_lerobot_index`: makes it.

    Examples:
        >>> episode = LeRobotEpisode(0, 0, 120, PurePosixPath("data/chunk-000/file-000.parquet"), 0, {})
        >>> index = LeRobotIndex(
        ...     path=Path("square_lerobot"), demos=("0",), lengths=(120,), observation_keys=("object",),
        ...     observation_dims=(14,), image_keys=(), image_size=0, available_keys=("object",),
        ...     action_dim=7, env_args={}, task=None, episodes=(episode,),
        ...     slices={"object": LeRobotSlice(ENVIRONMENT_STATE, 0, 14)}, features={}, images={},
        ...     rendering=None, first_state=None)
        >>> [str(file) for file in index.files]
        ['data/chunk-000/file-000.parquet']
    """

    episodes: tuple[LeRobotEpisode, ...]
    slices: Mapping[str, LeRobotSlice]
    features: Mapping[str, Mapping[str, Any]]
    images: Mapping[str, str]
    rendering: Mapping[str, Any] | None
    first_state: Sequence[float] | None

    @property
    def files(self) -> list[PurePosixPath]:
        """The files outside ``meta/`` that hold what is selected."""
        videos = {
            episode.videos[feature][0]
            for episode in self.episodes
            for feature in self.images.values()
            if feature in episode.videos
        }
        return sorted({episode.file for episode in self.episodes} | videos)


def action_names(arms: int) -> list[str]:
    """What the pose deltas of robosuite are called in a dataset, in their order.

    Args:
        arms: how many.

    See Also:
        - :func:`~warmprior.data.lerobot_index.state_names`: of the observations.
        - :func:`~warmprior.data.convert_robomimic`: writes these names.

    Examples:
        >>> action_names(1)[3:]
        ['robot0_rx', 'robot0_ry', 'robot0_rz', 'robot0_gripper']
    """
    return [f"robot{arm}_{name}" for arm in range(arms) for name in _ARM_ACTIONS]


def state_names(widths: Mapping[str, int]) -> list[str]:
    """What the numbers of observations are called in a dataset.

    Args:
        widths: of the observations, in their order.

    See Also:
        - :func:`~warmprior.data.lerobot_index.action_names`: of the actions.
        - :func:`~warmprior.data.convert_robomimic`: writes these names.

    Examples:
        >>> state_names({"robot0_gripper_qpos": 2})
        ['robot0_gripper_qpos_0', 'robot0_gripper_qpos_1']
    """
    return [f"{key}_{i}" for key, width in widths.items() for i in range(width)]


def read_lerobot_index(
    root: str | Path,
    *,
    filter_key: str | None = None,
    observation_keys: Sequence[str] | None = None,
    image_keys: Sequence[str] = (),
    poses: bool = False,
    demos: int | None = None,
    env_args: Mapping[str, Any] | None = None,
) -> LeRobotIndex:
    """Check the ``meta/`` of a LeRobotDataset v3 and say what it holds. No values are read.

    A dataset that :func:`warmprior.data.convert_robomimic` wrote says in which environment it was recorded,
    and where each of robomimic's observations is. In any other ``env_args`` says the former, and of a task of
    :data:`warmprior.envs.TASKS` the observations are looked for, by their widths, in
    ``observation.environment_state`` (objects) beside ``observation.state`` (robots), in
    ``observation.state`` alone, or each in ``observation.<key>``. Where no environment is known an
    observation is a whole feature.

    Args:
        root: the dataset's folder.
        filter_key: a mask of the converted file, such as ``"train"``; all episodes if ``None``.
        observation_keys: the observations to read; by default those of the task, or of an unknown
            environment ``observation.environment_state`` and ``observation.state`` as far as there.
        image_keys: images to read as well: ``"agentview_image"`` is the feature
            ``observation.images.agentview``.
        poses: also require the hand pose of every arm, from which absolute actions are built.
        demos: how many to take, the first ones by their numbers; all if ``None``.
        env_args: of the environment, for a dataset that does not describe it.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if it is of another version, its files are cut short or disagree, it has another
            frequency or action than the environment, or a key or its statistics are missing.
        ValueError: if no demos are to be taken.

    Examples:
        >>> index = read_lerobot_index("square_lerobot")  # doctest: +SKIP
        >>> len(index.demos), index.action_dim  # doctest: +SKIP
        (200, 7)
        >>> read_lerobot_index("nowhere")
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere: no meta/info.json there, so no LeRobotDataset; check the path
    """
    root = Path(root)
    if demos is not None and demos < 1:
        raise ValueError(f"demos must be at least 1, got {demos}")
    info = read_info(root)
    features = info["features"]
    described = read_description(root, features)
    recorded = _environment(root, described, env_args)
    task = task_of_env(recorded) if recorded else None
    _check_frequency(root, info, recorded)
    vectors = {name: width for name in features if (width := _width(features[name])) is not None}
    action_dim = _action_dim(root, features, vectors, task, recorded)
    slices = _slices(root, features, vectors, described, task)
    if observation_keys is not None:
        keys = tuple(observation_keys)
    elif task is not None:
        keys = task.low_dim_keys
    elif described:
        keys = tuple(slices)
    else:
        keys = tuple(key for key in (ENVIRONMENT_STATE, ROBOT_STATE) if key in slices)
    if not keys:
        raise DatasetError(
            f"{root}: no observations are chosen; name some with observation_keys: "
            f"{', '.join(slices) or 'there are none'}"
        )
    wanted = list(keys)
    if poses:
        for arm in range(min(action_dim // 7, 2)):
            wanted += [f"robot{arm}_eef_pos", f"robot{arm}_eef_quat"]
    for key in wanted:
        if key not in slices:
            raise DatasetError(
                f"{info_path(root)}: there is no observation {key!r} among {', '.join(slices)}: choose "
                "others with observation_keys, or convert or record the dataset with it"
            )
    if task is not None and observation_keys is None:
        _check_widths(root, slices, task)
    check_statistics(root, ["action", *(slices[key].feature for key in wanted)])
    cameras = _cameras(features)
    images, size = _images(root, features, cameras, image_keys)
    videos = [name for name in images.values() if features[name]["dtype"] == "video"]
    episodes = _selected(root, read_episodes(root, info, videos), described, filter_key)
    check_count(root, demos, len(episodes))
    episodes = episodes[:demos]
    return LeRobotIndex(
        path=root,
        demos=tuple(str(episode.number) for episode in episodes),
        lengths=tuple(episode.stop - episode.start for episode in episodes),
        observation_keys=keys,
        observation_dims=tuple(slices[key].stop - slices[key].start for key in keys),
        image_keys=tuple(image_keys),
        image_size=size,
        available_keys=(*slices, *cameras),
        action_dim=action_dim,
        env_args=recorded,
        task=task,
        episodes=tuple(episodes),
        slices=slices,
        features=features,
        images=images,
        rendering=described.get("rendering"),
        first_state=described.get("first_state"),
    )


def _environment(
    root: Path, described: Mapping[str, Any], env_args: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The one that the dataset describes, or else the given one."""
    if not described or env_args is None:
        return described.get("env_args") or dict(env_args or {})
    mine, theirs = described["env_args"]["env_name"], env_args["env_name"]
    if mine != theirs:
        raise DatasetError(
            f"{root / DESCRIPTION}: the dataset was recorded in {mine}, not in {theirs}: leave the task "
            "(env_args) out or correct it"
        )
    return described["env_args"]


def _check_frequency(root: Path, info: Mapping[str, Any], env_args: Mapping[str, Any]) -> None:
    if not env_args:
        return
    control = env_args["env_kwargs"].get("control_freq", 20)
    if info["fps"] != control:
        raise DatasetError(
            f"{info_path(root)}: fps is {info['fps']}, but {env_args['env_name']} is controlled at "
            f"{control} Hz, and one action per control step is needed: resample the dataset, or name "
            "another task"
        )


def _width(feature: Mapping[str, Any]) -> int | None:
    """Of a vector of numbers; ``None`` for any other feature."""
    vector = len(feature["shape"]) == 1 and feature["dtype"] in FLOATS
    return feature["shape"][0] if vector else None


def _names(feature: Mapping[str, Any]) -> list[str] | None:
    """The names of a vector's numbers, of whatever form; ``None`` if there are none."""
    names = feature.get("names")
    if isinstance(names, dict):
        lists = [value for value in names.values() if isinstance(value, list)]
        # {"motors": [...]} or {"x": 0, "y": 1, ...}
        names = [name for value in lists for name in value] if lists else list(names)
    return names or None


def _check_names(
    root: Path, features: Mapping[str, Any], name: str, expected: Sequence[str], what: str
) -> None:
    names = _names(features[name])
    if names is not None and names != list(expected):
        raise DatasetError(
            f"{info_path(root)}: {name!r} is named {', '.join(map(str, names))}, but {what} "
            f"{', '.join(expected)}: choose another task or dataset or, if these are only other names, set "
            f"features[{name!r}]['names'] to null"
        )


def _action_dim(
    root: Path,
    features: Mapping[str, Any],
    vectors: Mapping[str, int],
    task: TaskSpec | None,
    env_args: Mapping[str, Any],
) -> int:
    if "action" not in vectors:
        told = ", ".join(f"{n} {f['dtype']}{f['shape']}" for n, f in features.items())
        raise DatasetError(
            f"{info_path(root)}: there is no feature 'action' that is a vector of floating-point "
            f"numbers, but {told}: rename or flatten it"
        )
    width = vectors["action"]
    if task is not None:
        told = f"{env_args['env_name']} takes"
        if width != task.action_dim:
            raise DatasetError(
                f"{info_path(root)}: 'action' has {width} columns, but {told} {task.action_dim}: choose "
                "another task or dataset"
            )
        _check_names(root, features, "action", action_names(task.arms), told)
    return width


def _slices(
    root: Path,
    features: Mapping[str, Any],
    vectors: Mapping[str, int],
    described: Mapping[str, Any],
    task: TaskSpec | None,
) -> dict[str, LeRobotSlice]:
    """Where the observations are."""
    if described:
        return {key: LeRobotSlice(*value) for key, value in described["observations"].items()}
    prefix = "observation."
    theirs = {name: width for name, width in vectors.items() if name.startswith(prefix)}
    if task is None:
        return {name: LeRobotSlice(name, 0, width) for name, width in theirs.items()}
    widths = task.low_dim_widths
    if all(theirs.get(prefix + key) == width for key, width in widths.items()):
        return {key: LeRobotSlice(prefix + key, 0, width) for key, width in widths.items()}
    robots = {key: width for key, width in widths.items() if key != "object"}
    layouts = [
        {ROBOT_STATE: widths},
        {ENVIRONMENT_STATE: {"object": task.object_dim}, ROBOT_STATE: robots},
    ]
    layout = layouts[ENVIRONMENT_STATE in theirs]
    needed = {name: sum(parts.values()) for name, parts in layout.items()}
    if any(theirs.get(name) != width for name, width in needed.items()):
        told = ", ".join(f"{name} of {width}" for name, width in theirs.items()) or "none"
        ways = " or ".join(
            ", ".join(f"{name} of {sum(parts.values())}" for name, parts in layout.items())
            for layout in layouts
        )
        raise DatasetError(
            f"{info_path(root)}: the observations are {told}, but those of {task.env_name} are {ways}, "
            f"or each of {', '.join(widths)} after 'observation.': choose another task or dataset"
        )
    found = {}
    for name, parts in layout.items():
        _check_names(root, features, name, state_names(parts), f"{task.env_name} has")
        start = 0
        for key, width in parts.items():
            found[key] = LeRobotSlice(name, start, start + width)
            start += width
    return {key: found[key] for key in widths}


def _check_widths(root: Path, slices: Mapping[str, LeRobotSlice], task: TaskSpec) -> None:
    for key, width in task.low_dim_widths.items():
        columns = slices[key].stop - slices[key].start
        if columns != width:
            raise DatasetError(
                f"{root}: the observation {key!r} has {columns} columns, but that of {task.env_name} has "
                f"{width}: convert the file again"
            )


def _cameras(features: Mapping[str, Any]) -> dict[str, str]:
    """The feature of every image, by our names."""
    return {
        f"{name.rpartition('.')[2]}_image": name
        for name, feature in features.items()
        if feature["dtype"] in ("image", "video")
        and not (isinstance(feature.get("info"), dict) and feature["info"].get("is_depth_map"))
    }


def _images(
    root: Path, features: Mapping[str, Any], cameras: Mapping[str, str], keys: Sequence[str]
) -> tuple[dict[str, str], int]:
    """The features of the images to read, and their side in pixels."""
    path, sizes = info_path(root), {}
    for key in keys:
        if key not in cameras:
            known = ", ".join(f"{k} ({name})" for k, name in cameras.items()) or "none"
            raise DatasetError(
                f"{path}: there are no images {key!r}; there are {known}. Choose other cameras, or render "
                "them into a robomimic file (python -m warmprior render) and convert that with --images"
            )
        shape = features[cameras[key]]["shape"]
        if len(shape) != 3 or 3 not in (shape[0], shape[-1]):
            raise DatasetError(f"{path}: {cameras[key]!r} has shape {shape}, not [side, side, 3]")
        height, width = shape[:2] if shape[-1] == 3 else shape[1:]
        if height != width:
            raise DatasetError(
                f"{path}: {cameras[key]!r} has shape {shape}; only square images can be used"
            )
        sizes[key] = height
    if len(set(sizes.values())) > 1:
        told = ", ".join(f"{key} {size}" for key, size in sizes.items())
        raise DatasetError(f"{path}: images have several sizes: {told}. Choose those of one size")
    return {key: cameras[key] for key in keys}, next(iter(sizes.values()), 0)


def _selected(
    root: Path,
    episodes: list[LeRobotEpisode],
    described: Mapping[str, Any],
    filter_key: str | None,
) -> list[LeRobotEpisode]:
    if filter_key is None:
        return episodes
    masks = described.get("masks", {})
    if filter_key not in masks:
        known = f"choose one of {', '.join(masks)}" if masks else "this dataset has none"
        raise DatasetError(f"{root / DESCRIPTION}: unknown filter key {filter_key!r}; {known}")
    numbers = set(masks[filter_key])
    if not numbers or not numbers <= set(range(len(episodes))):
        raise DatasetError(
            f"{root / DESCRIPTION}: masks[{filter_key!r}] names no episodes, or such as there are not: "
            "choose another filter key"
        )
    return [episode for episode in episodes if episode.number in numbers]
