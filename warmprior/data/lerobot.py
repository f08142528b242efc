"""LeRobot's demonstrations: what a LeRobotDataset v3 holds, and its values as a replay buffer or as steps."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior.data.replay import (
    DatasetError,
    DatasetIndex,
    DemonstrationReader,
    DemonstrationReplay,
    check_count,
    check_env_args,
    store_finite,
)
from warmprior.envs.tasks import TaskSpec, task_of_env
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest, is_repository, read_json
from warmprior.keys import ACTION, EPISODE, OBSERVATION

DESCRIPTION = "meta/warmprior.json"
"""What :func:`warmprior.data.convert_robomimic` writes beside LeRobot's own files, which LeRobot ignores."""

ENVIRONMENT_STATE, ROBOT_STATE = "observation.environment_state", "observation.state"
REWARD, SUCCESS = "next.reward", "next.success"
_ARM_ACTIONS = ("x", "y", "z", "rx", "ry", "rz", "gripper")


LEROBOT_VERSION = "v3.0"
"""The tag by which the hub's LeRobotDatasets name the version of their format."""


def download_lerobot(
    repository: str, files: Sequence[str] = ("meta/*",), *, revision: str | None = None
) -> Path:
    """Fetch files of a LeRobotDataset, by their patterns, unless they are here already; the dataset's folder.

    ``$HF_LEROBOT_HOME/REPOSITORY`` comes first, as in LeRobot, then its cache, without a connection.
    """
    default = Path(require("huggingface_hub.constants", "lerobot").HF_HOME) / "lerobot"
    home = Path(os.environ.get("HF_LEROBOT_HOME") or default).expanduser()
    if revision is None and (home / repository / "meta" / "info.json").is_file():
        return home / repository
    revision = LEROBOT_VERSION if revision is None else revision
    try:
        found = require("huggingface_hub", "lerobot").snapshot_download(
            repository,
            repo_type="dataset",
            revision=revision,
            cache_dir=home / "hub",
            allow_patterns=list(files),
        )
    except Exception as error:  # the client's errors share no base class
        reason = str(error).strip() or "no message"
        raise OSError(
            f"could not download {repository} at {revision}: {type(error).__name__}: {reason}\n"
            "Check the name and the connection. A dataset of an older version has no such revision: convert "
            "it with python -m lerobot.scripts.convert_dataset_v21_to_v30. A folder fetched by other means "
            "can be given by its path."
        ) from error
    return Path(found)


@dataclass(frozen=True)
class LeRobotIndex(DatasetIndex):
    """What a LeRobotDataset holds, without its values.

    Attributes:
        metadata: LeRobot's own, a ``LeRobotDatasetMetadata``.
        episodes: the rows of ``meta/episodes`` of the selected episodes.
        columns: of each observation the feature that holds it, and where in it.
        images: the feature of each of the images to read.
        described: what ``meta/warmprior.json`` says; empty for datasets that were not converted.
    """

    metadata: Any
    episodes: tuple[Mapping[str, Any], ...]
    columns: Mapping[str, tuple[str, slice]]
    images: Mapping[str, str]
    described: Mapping[str, Any]

    @property
    def files(self) -> list[str]:
        """The files outside ``meta/`` that hold what is selected, below the folder."""
        videos = [name for name in self.images.values() if name in self.metadata.video_keys]
        return sorted(
            {episode_file(self.metadata, e, name) for e in self.episodes for name in [None, *videos]}
        )

    def digest(self) -> str:
        """SHA-256 of what can be read: all files of numbers, and those of the images that are selected."""
        meta = ("meta/info.json", DESCRIPTION, "meta/episodes/*/*.parquet")
        files = {path for pattern in meta for path in self.path.glob(pattern)}
        files |= {self.path / file for file in self.files}
        return digest_of([[str(p.relative_to(self.path)), file_digest(p)] for p in sorted(files)])


def episode_file(metadata: Any, episode: Mapping[str, Any], video: str | None = None) -> str:
    """The file, below the dataset's folder, that holds an episode's numbers, or its video of a feature."""
    part = "data" if video is None else f"videos/{video}"
    numbers = {f"{n}_index": episode[f"{part}/{n}_index"] for n in ("chunk", "file")}
    template = metadata.data_path if video is None else metadata.video_path
    file = template.format(video_key=video, **numbers)
    if file.startswith("/") or ".." in file.split("/"):
        raise DatasetError(f"{metadata.root}: meta/info.json names {file!r}, which is not in the folder")
    return file


def is_remote(dataset: str | Path) -> bool:
    """Whether a name is a repository of the hub, ``user/name``, and no folder here."""
    return is_repository(str(dataset)) and not Path(dataset).exists()


def _metadata(root: Path) -> Any:
    """Let LeRobot read what describes a dataset in a folder, checked; the hub is never asked."""
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"{root}: no meta/info.json there, so no LeRobotDataset; check the path")
    datasets = require("lerobot.datasets", "lerobot")
    again = "Copy or download it again, or record or convert it anew"
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet"):
        if not any(root.glob(pattern)):  # LeRobot would look for it at the hub
            raise DatasetError(
                f"{root} has no {pattern}: the dataset has no episodes, or its recording did not end with "
                f"LeRobotDataset.finalize(). {again}."
            )
    try:
        metadata = datasets.LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    except Exception as error:  # of json, pyarrow, datasets and LeRobot itself
        raise DatasetError(
            f"{root}: LeRobot cannot read the meta/ of this dataset ({error}). {again}."
        ) from error
    if not metadata.total_episodes:
        raise DatasetError(f"{root}: the dataset has no episodes: record some")
    numbers, steps = sorted(metadata.episodes["episode_index"]), sum(metadata.episodes["length"])
    if numbers != list(range(metadata.total_episodes)) or steps != metadata.total_frames:
        raise DatasetError(
            f"{root}: meta/info.json counts {metadata.total_episodes} episodes of {metadata.total_frames} "
            f"steps, and meta/episodes {len(numbers)} of {steps}. {again}."
        )
    return metadata


def action_names(arms: int) -> list[str]:
    """What the pose deltas of so many arms of robosuite are called in a dataset, such as ``robot0_rx``."""
    return [f"robot{arm}_{name}" for arm in range(arms) for name in _ARM_ACTIONS]


def state_names(widths: Mapping[str, int]) -> list[str]:
    """What the numbers of observations of these widths are called in a dataset, in the same order."""
    return [f"{key}_{i}" for key, width in widths.items() for i in range(width)]


def layout_of(widths: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Which feature of a converted dataset holds each observation of robomimic, and their widths."""
    robots = {key: width for key, width in widths.items() if key.startswith("robot")}
    others = {key: width for key, width in widths.items() if key not in robots}
    layout = {ENVIRONMENT_STATE: others, ROBOT_STATE: robots}
    return {feature: parts for feature, parts in layout.items() if parts}


def read_lerobot_index(
    dataset: str | Path,
    *,
    revision: str | None = None,
    fetch: bool = False,
    filter_key: str | None = None,
    observation_keys: Sequence[str] | None = None,
    image_keys: Sequence[str] = (),
    poses: bool = False,
    demos: int | None = None,
    env_args: Mapping[str, Any] | None = None,
) -> LeRobotIndex:
    """Say what a LeRobotDataset v3 holds, by its ``meta/``. No values are read.

    Of a dataset in the hub nothing else is fetched, unless ``fetch`` asks for what is to be read. Options and
    errors are those of :class:`~warmprior.data.LeRobotExperienceReplay`; ``poses`` also requires the hand
    pose of every arm, from which absolute actions are built.
    """
    remote = is_remote(dataset)
    root = download_lerobot(str(dataset), revision=revision) if remote else Path(dataset).expanduser()
    if demos is not None and demos < 1:
        raise ValueError(f"demos must be at least 1, got {demos}")
    metadata = _metadata(root)
    described = _description(root)
    recorded = described.get("env_args") or dict(env_args or {})
    if env_args and recorded["env_name"] != env_args["env_name"]:
        raise DatasetError(
            f"{root}: the dataset was recorded in {recorded['env_name']}, not in {env_args['env_name']}: "
            "leave the task (env_args) out or correct it"
        )
    task = task_of_env(recorded) if recorded else None
    widths = {
        name: feature["shape"][0]
        for name, feature in metadata.features.items()
        if len(feature["shape"]) == 1 and feature["dtype"].startswith(("float", "int", "uint"))
    }
    if "action" not in widths:
        raise DatasetError(f"{root}: there is no feature 'action' that is a vector of numbers, but {widths}")
    if recorded:
        _check_actions(root, metadata, recorded, task)
    named = _named_columns(root, metadata.features, widths, described, task)
    whole = {name: (name, slice(0, width)) for name, width in widths.items() if name != "action"}
    columns = named | whole
    if observation_keys is None:
        observation_keys = tuple(named)
        if task is not None:
            observation_keys = task.low_dim_keys
        elif not described:
            observation_keys = [key for key in (ENVIRONMENT_STATE, ROBOT_STATE) if key in columns]
    arms = range(min(widths["action"] // 7, 2)) if poses else ()
    for key in [*observation_keys, *(f"robot{a}_eef_{end}" for a in arms for end in ("pos", "quat"))]:
        if key not in columns:
            raise DatasetError(
                f"{root}: there is no observation {key!r} among {', '.join(columns)}: choose others with "
                "observation_keys, or convert or record the dataset with it"
            )
    if not observation_keys:
        raise DatasetError(
            f"{root}: no observations are chosen; name some with observation_keys: "
            f"{', '.join(columns) or 'there are none'}"
        )
    cameras = {
        f"{name.rpartition('.')[2]}_image": name
        for name in metadata.camera_keys
        if name not in metadata.depth_keys
    }
    episodes = sorted(metadata.episodes.to_list(), key=lambda row: row["episode_index"])
    if filter_key is not None:
        masks = described.get("masks", {})
        if filter_key not in masks:
            known = f"choose one of {', '.join(masks)}" if masks else "this dataset has none"
            raise DatasetError(f"{root}: unknown filter key {filter_key!r}; {known}")
        episodes = [row for row in episodes if row["episode_index"] in masks[filter_key]]
    check_count(root, demos, len(episodes))
    episodes = episodes[:demos]
    index = LeRobotIndex(
        path=root,
        demos=tuple(str(row["episode_index"]) for row in episodes),
        lengths=tuple(row["length"] for row in episodes),
        observation_keys=tuple(observation_keys),
        observation_dims=tuple(columns[key][1].stop - columns[key][1].start for key in observation_keys),
        image_keys=tuple(image_keys),
        image_size=_image_size(root, metadata.features, cameras, image_keys),
        available_keys=(*columns, *cameras),
        action_dim=widths["action"],
        env_args=recorded,
        task=task,
        metadata=metadata,
        episodes=tuple(episodes),
        columns=columns,
        images={key: cameras[key] for key in image_keys},
        described=described,
    )
    if fetch and remote and not all((root / file).is_file() for file in index.files):
        index = replace(index, path=download_lerobot(str(dataset), index.files, revision=revision))
    return index


def _description(root: Path) -> dict[str, Any]:
    path = root / DESCRIPTION
    if not path.exists():
        return {}
    try:
        found = read_json(path)
    except ValueError as error:
        raise DatasetError(f"{error}. Convert the file again.") from error
    if not isinstance(found, dict) or found.get("format") != 1 or "observations" not in found:
        raise DatasetError(f"{path} is not of this version: convert the file again, or remove it")
    check_env_args(f"{path}: env_args", found.get("env_args"))
    return found


def _check_names(root: Path, feature: Mapping[str, Any], expected: list[str], what: str) -> None:
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]} or {"x": 0, "y": 1, ...}
        lists = [value for value in names.values() if isinstance(value, list)]
        names = [name for value in lists for name in value] if lists else list(names)
    # Seven numbers may be joints as well as a pose.
    if names and names != expected:
        raise DatasetError(
            f"{root}: {what} {', '.join(expected)}, but here they are named {', '.join(map(str, names))}: "
            "choose another task or dataset or, if these are only other names, set the feature's names in "
            "meta/info.json to null"
        )


def _check_actions(root: Path, metadata: Any, env_args: Mapping[str, Any], task: TaskSpec | None) -> None:
    """Whether the actions are those of an environment, one per control step."""
    control = env_args["env_kwargs"].get("control_freq", 20)
    if metadata.fps != control:
        raise DatasetError(
            f"{root}: fps is {metadata.fps}, but {env_args['env_name']} is controlled at {control} Hz, and "
            "one action per control step is needed: resample the dataset, or name another task"
        )
    if task is None:
        return
    action = metadata.features["action"]
    if tuple(action["shape"]) != (task.action_dim,):
        raise DatasetError(
            f"{root}: 'action' has {action['shape'][0]} columns, but {task.env_name} takes "
            f"{task.action_dim}: choose another task or dataset"
        )
    _check_names(root, action, action_names(task.arms), f"the actions of {task.env_name} are")


def _named_columns(
    root: Path,
    features: Mapping[str, Any],
    widths: Mapping[str, int],
    described: Mapping[str, Any],
    task: TaskSpec | None,
) -> dict[str, tuple[str, slice]]:
    """Where robomimic's observations are."""
    theirs = {name: width for name, width in widths.items() if name.startswith("observation.")}
    if described:
        found = {key: (name, slice(*ends)) for key, (name, *ends) in described["observations"].items()}
        needed = {} if task is None else task.low_dim_widths
        for key, (name, part) in found.items():
            width = needed.get(key, part.stop - part.start)
            if not 0 <= part.start < part.stop == part.start + width <= theirs.get(name, 0):
                raise DatasetError(
                    f"{root / DESCRIPTION}: observations[{key!r}] are columns {part.start} to {part.stop} of "
                    f"{name}, which do not fit the dataset or its task: convert the file again"
                )
        return found
    if task is None:
        return {}
    layouts: list[dict[str, dict[str, int]]] = [
        {f"observation.{key}": {key: width} for key, width in task.low_dim_widths.items()},
        layout_of(task.low_dim_widths),
        {ROBOT_STATE: task.low_dim_widths},
    ]
    sums = [{name: sum(parts.values()) for name, parts in layout.items()} for layout in layouts]
    fits = [total.items() <= theirs.items() for total in sums]
    # Robots alone may be as wide as the whole state of another task.
    fits[2] = fits[2] and ENVIRONMENT_STATE not in theirs
    if not any(fits):
        raise DatasetError(
            f"{root}: the observations are {theirs}, but those of {task.env_name} are "
            f"{' or '.join(map(str, reversed(sums)))}: choose another task or dataset"
        )
    layout = layouts[fits.index(True)]
    found = {}
    for name, parts in layout.items():
        if name in (ENVIRONMENT_STATE, ROBOT_STATE):
            what = f"the numbers of {name} in {task.env_name} are"
            _check_names(root, features[name], state_names(parts), what)
        ends = pairwise(accumulate(parts.values(), initial=0))
        found |= {key: (name, slice(*end)) for key, end in zip(parts, ends, strict=True)}
    return {key: found[key] for key in task.low_dim_widths}


def _image_size(
    root: Path, features: Mapping[str, Any], cameras: Mapping[str, str], keys: Sequence[str]
) -> int:
    """The side of the images to read, in pixels; 0 if there are none."""
    sizes = set()
    for key in keys:
        if key not in cameras:
            known = ", ".join(f"{k} ({name})" for k, name in cameras.items()) or "none"
            raise DatasetError(
                f"{root}: there are no images {key!r}; there are {known}. Choose other cameras, or render "
                "them into a robomimic file (python -m warmprior render) and convert that with --images"
            )
        shape = tuple(features[cameras[key]]["shape"])
        side = max(shape)
        if shape not in ((side, side, 3), (3, side, side)):
            raise DatasetError(
                f"{root}: {cameras[key]!r} has shape {shape}; only square images of three colours can be used"
            )
        sizes.add(side)
    if len(sizes) > 1:
        raise DatasetError(f"{root}: the images have several sizes, {sizes}: choose those of one size")
    return next(iter(sizes), 0)


DECODED = 2**26  # bytes of frames unpacked at once
TOLERANCE = 1e-4  # seconds between a step and its frame, LeRobot's own
_REBUILD = "Record the episode again or remove it (lerobot-edit-dataset), or leave it out."


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Name the file in whatever goes wrong while it is read."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # pyarrow's own, OSError, KeyError for its columns...
        raise DatasetError(
            f"{path}: damaged, or not of this dataset ({error}). Copy or download it again, or record or "
            "convert the dataset anew; a recording has to end with LeRobotDataset.finalize()."
        ) from error


class LeRobotReader(DemonstrationReader):
    """The values of a dataset."""

    def __init__(self, index: LeRobotIndex) -> None:
        self.index = index
        self._file = ""
        self._read: dict[str, np.ndarray] = {}
        self._episodes = dict(zip(index.demos, index.episodes, strict=True))
        features = index.metadata.features
        self._reward = next((name for name in (REWARD, SUCCESS) if name in features), None)

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Rewards of a dataset without ``next.reward`` are its ``next.success``, or else zeros."""
        feature, part = self._place(key)
        if feature is None:
            out[...] = 0
            return
        block = self._rows(self._episodes[demo], feature)[first : first + len(out), part]
        store_finite(block, out, self.name(demo, key), first, _REBUILD)

    def _rows(self, episode: Mapping[str, Any], feature: str) -> np.ndarray:
        """All rows of an episode, ``[rows, width]``."""
        file = episode_file(self.index.metadata, episode)
        if file != self._file:  # one at a time
            self._file, self._read = file, {}
        start, number = episode["dataset_from_index"], episode["episode_index"]
        with _reading(self.index.path / file):
            index, numbers = self._column("index")[:, 0], self._column("episode_index")[:, 0]
            first = int(np.searchsorted(index, start))
            rows = slice(first, first + episode["length"])
            expected = np.arange(start, start + episode["length"])
            if not np.array_equal(index[rows], expected) or (numbers[rows] != number).any():
                raise ValueError(f"episode {number} is not where meta/episodes says")
            return self._column(feature)[rows]

    def _column(self, name: str) -> np.ndarray:
        """A column of the file, ``[rows, width]``, read once."""
        if name not in self._read:
            arrow, parquet = (require(module, "lerobot") for module in ("pyarrow", "pyarrow.parquet"))
            column = parquet.read_table(self.index.path / self._file, columns=[name]).column(name)
            rows, width = len(column), self.index.metadata.features[name]["shape"][0]
            column = column.combine_chunks()
            if arrow.types.is_nested(column.type):  # the cast refuses rows of another length
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
        """What errors call an array of an episode, with the file that holds it."""
        file = episode_file(self.index.metadata, self._episodes[demo])
        feature, observation = self._place(key)[0], key.removeprefix("obs/")
        inside = f" ({observation})" if key != observation != feature else ""
        return f"{self.index.path / file}: {feature}{inside} of episode {demo}"

    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the first frames of an episode; see the base class."""
        episode, feature = self._episodes[demo], self.index.images[key]
        video = feature if feature in self.index.metadata.video_keys else None
        path = self.index.path / episode_file(self.index.metadata, episode, video)
        step = max(1, DECODED // max(1, out[0].numel()))
        with _reading(path):
            frames = self._video(episode, path, feature) if video else _pictures(episode, path, feature)
            for first in range(0, len(out), step):
                part = out[first : first + step]
                found = frames(first, first + len(part))
                if found.shape != part.shape:
                    raise ValueError(
                        f"{feature} of episode {demo} has frames of shape {tuple(found.shape[1:])}, but "
                        f"meta/info.json says {tuple(part.shape[1:])}"
                    )
                part.copy_(found)

    def _video(self, episode: Mapping[str, Any], path: Path, feature: str) -> Any:
        decode = require("lerobot.datasets.video_utils", "lerobot").decode_video_frames
        times = self._rows(episode, "timestamp")[:, 0].astype(np.float64)
        times += episode[f"videos/{feature}/from_timestamp"]
        return lambda first, stop: decode(path, times[first:stop].tolist(), TOLERANCE, return_uint8=True)


def _pictures(episode: Mapping[str, Any], path: Path, feature: str) -> Any:
    image, parquet = require("PIL.Image", "lerobot"), require("pyarrow.parquet", "lerobot")
    mine = [("episode_index", "==", episode["episode_index"])]
    column = parquet.read_table(path, columns=[feature], filters=mine).column(feature)

    def frames(first: int, stop: int) -> Tensor:
        # Their bytes alone: a path in them could lead anywhere.
        files = [io.BytesIO(value["bytes"]) for value in column[first:stop].to_pylist()]
        pictures = [np.array(image.open(file).convert("RGB")) for file in files]
        return torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)

    return frames


class LeRobotExperienceReplay(DemonstrationReplay):
    """Demonstrations of a LeRobotDataset v3, as one immutable TorchRL replay buffer.

    The counterpart of :class:`RobomimicExperienceReplay`, with the same entries and properties.
    :class:`~warmprior.ActionWindow` makes windows, whose history and padding are those of
    ``delta_timestamps``, but that what lies outside an episode is masked and zero where LeRobot repeats its
    first action, which is part of the target.

    Of images only those that ``image_keys`` names are fetched and decoded, once and by LeRobot's own decoder,
    and of the selected episodes alone. Without ``next.reward`` the rewards are ``next.success``, or zeros.

    Args:
        dataset: the dataset's folder, or its repository in the hub (``"user/name"``).
        revision: branch, tag or commit of a repository.
        env_args: of the environment in which it was recorded
            (:func:`warmprior.envs.simulator.task_env_args`), for datasets that :func:`convert_robomimic`
            did not write; those are refused if it names another. Frequency, widths and names are checked
            against it, and robomimic's observations found by it. Without, whole features are observations.
        observation_keys: observations to concatenate; by default those of the task, or of an unknown
            environment ``"observation.environment_state"`` and ``"observation.state"`` as far as there.
        image_keys: images to read as well: ``"agentview_image"`` is the feature
            ``observation.images.agentview``, of pictures or a video. Take ``storage="memmap"`` where they
            are many.
        filter_key: a mask of the converted file. It, ``demos``, ``absolute_actions`` and ``**kwargs`` are as
            of :class:`RobomimicExperienceReplay`.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if the dataset is not as it should be, or does not fit the environment; says which
            folder or file, and why.
        ValueError: see :class:`RobomimicExperienceReplay`.
        OSError: if a download fails, or there is no space for memory maps.

    Examples:
        >>> from warmprior.data import LeRobotExperienceReplay
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
        **kwargs: Any,
    ) -> None:
        index = read_lerobot_index(
            dataset,
            revision=revision,
            fetch=True,
            filter_key=filter_key,
            observation_keys=observation_keys,
            image_keys=image_keys,
            poses=absolute_actions,
            demos=demos,
            env_args=env_args,
        )
        super().__init__(index, LeRobotReader(index), absolute_actions=absolute_actions, **kwargs)


def lerobot_steps(
    dataset: str | Path, observation_keys: Sequence[str] = ("observation.state",)
) -> TensorDictBase:
    """Read the steps of a LeRobotDataset of any robot, in raw units.

    Args:
        dataset: its folder, or ``user/name`` of its repository at the hub.
        observation_keys: features that make the observation, concatenated in this order.

    Returns:
        ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]``, float32, and ``"episode"`` ``[N]``, as
        :meth:`Task.of <warmprior.training.Task.of>` takes them.

    Raises:
        FileNotFoundError: if there is no such dataset.
        DatasetError: if there is no such feature, or it is no vector of numbers; if the dataset is damaged.
        OSError: if a download fails.

    Examples:
        >>> from warmprior.data import lerobot_steps
        >>> steps = lerobot_steps("lerobot/pusht_keypoints")  # doctest: +SKIP
        >>> steps["action"].shape  # doctest: +SKIP
        torch.Size([25650, 2])
    """
    data = LeRobotExperienceReplay(dataset, observation_keys=observation_keys).data
    return data.select(OBSERVATION, ACTION, EPISODE)
