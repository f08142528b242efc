"""The index of demonstrations in any format, and the replay buffer with their values."""

from __future__ import annotations

import os
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage

from warmprior.checks import check_choice, check_distinct, check_whole_numbers
from warmprior.envs.env_args import absolute_actions as to_absolute
from warmprior.envs.env_args import declared_actions, delta_conventions, modernize_env_args
from warmprior.envs.tasks import TaskSpec
from warmprior.io.machine import available_memory
from warmprior.io.progress import progress_bar
from warmprior.keys import ACTION, EPISODE, FRAME, OBSERVATION, STATE
from warmprior.rotation import matrix_to_rotation_6d, rotvec_to_matrix

BLOCK = 4096  # rows handled at once, to bound temporary memory for demos of any length
MISFIT = "They do not fit these actions: correct one or the other."
LARGEST = 1e9  # in any unit; a larger value is damage, and would squash all others of its feature


class DatasetError(ValueError):
    """An invalid demonstration file; the message says where it is wrong and what to do.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.data import RobomimicDemonstrations
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "square.hdf5"
        ...     _ = path.write_bytes(b"a download that broke off")
        ...     RobomimicDemonstrations(path)
        Traceback (most recent call last):
            ...
        warmprior.data.replay.DatasetError: ...square.hdf5: not a readable HDF5 file (25 bytes; ...
    """


@dataclass(frozen=True)
class DatasetIndex:
    """The index of demonstrations, without their values.

    Attributes:
        path: the file or folder.
        demos: names of the selected demos, in the order of their numbers.
        observation_keys: the observations to read, in the order of concatenation.
        image_size: side of the images to read in pixels; 0 if there are none.
        available_keys: all observations.
        env_args: the description of the environment; empty if it is unknown.
        task: the task of :data:`warmprior.envs.TASKS` that uses this environment, or ``None``.
    """

    path: Path
    demos: tuple[str, ...]
    lengths: tuple[int, ...]
    observation_keys: tuple[str, ...]
    observation_dims: tuple[int, ...]
    image_keys: tuple[str, ...]
    image_size: int
    available_keys: tuple[str, ...]
    action_dim: int
    env_args: dict[str, Any]
    task: TaskSpec | None

    def __post_init__(self) -> None:
        if not self.demos:
            raise DatasetError(f"{self.path}: no demonstrations are chosen; the mask names none")
        if not self.observation_keys:
            listed = ", ".join(self.available_keys)
            raise DatasetError(f"{self.path}: no observations are chosen; name observation_keys: {listed}")
        check_distinct(f"{self.path}: the observations", (*self.observation_keys, *self.image_keys))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that have images."""
        ending = "_image"
        return tuple(k.removesuffix(ending) for k in self.available_keys if k.endswith(ending))


class DemonstrationReader(ABC):
    """A reader of demonstrations' values, given their :class:`DatasetIndex`."""

    @abstractmethod
    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read and check rows of ``"actions"``, ``"rewards"`` or ``"obs/<key>"``, from ``first`` on.

        Rewards that are not recorded are zeros.
        """

    def terminated(self, demo: str) -> bool | None:
        """Return whether a demo ended by itself, as recorded; None if only its rewards tell."""
        return None

    @abstractmethod
    def images(self, demo: str, key: str, out: Tensor) -> None:
        """Read the first images of a demo into uint8 ``[rows, 3, size, size]``."""

    @abstractmethod
    def name(self, demo: str, key: str) -> str:
        """Return the name of a demo's array for errors, with the file that holds it."""


Opened = tuple[DatasetIndex, DemonstrationReader]
"""The index of demonstrations, and a reader of their values."""


def check_env_args(what: str, env_args: Any) -> dict[str, Any]:
    """Raise DatasetError unless there are robomimic's text ``env_name`` and dict ``env_kwargs``."""
    for key, kind in (("env_name", str), ("env_kwargs", dict)):
        if not (isinstance(env_args, dict) and isinstance(env_args.get(key), kind)):
            raise DatasetError(
                f"{what} lacks {key}, or it is not a {kind.__name__}: write it, or remove the description to "
                "train without an environment"
            )
    return env_args


def declared_poses(path: Path, env_args: Mapping[str, Any]) -> tuple[str, str] | None:
    """Call :func:`~warmprior.envs.env_args.declared_actions`; raise DatasetError if it fails."""
    with reading(f"{path}: env_args", MISFIT):
        return declared_actions(env_args)


@contextmanager
def reading(what: str, advice: str) -> Iterator[None]:
    """Turn any error inside into a DatasetError that says what cannot be read, with advice."""
    try:
        yield
    except (DatasetError, MemoryError):
        raise
    except Exception as error:  # errors of h5py, pyarrow and the like, OSError, KeyError for columns, ...
        raise DatasetError(f"{what} cannot be read ({error}). {advice}") from error


def check_count(path: Path, demos: int | None, available: int) -> None:
    """Raise an error for no demonstrations, or for more than there are."""
    if demos is not None:
        check_whole_numbers(demos=demos)
        if demos > available:
            raise DatasetError(f"{path}: there are {available} demonstrations, fewer than demos={demos}")


def unknown(where: Any, kind: str, name: str, names: Iterable[str]) -> DatasetError:
    """Return the error for a name that is not among those of its kind."""
    return DatasetError(f"{where}: no {kind} {name!r}; there are {', '.join(names) or 'none'}")


def common_size(path: Path, sides: Mapping[int, str]) -> int:
    """Return the common side of all images in pixels, 0 without images; raise DatasetError if they differ."""
    if len(sides) > 1:
        raise DatasetError(f"{path}: images must have one size, got {sides}: render them again")
    return next(iter(sides), 0)


def pose_keys(action_dim: int) -> list[str]:
    """Return the observations of the hands' poses, for as many arms as the pose deltas have."""
    arms = range(min(action_dim // 7, 2))
    return [f"robot{arm}_eef_{part}" for arm in arms for part in ("pos", "quat")]


def store_finite(block: np.ndarray, out: np.ndarray, what: str, advice: str, first: int = 0) -> None:
    """Copy numbers to ``out``; raise DatasetError if one is not finite there, or above 1e9."""
    with np.errstate(over="ignore"):  # an overflow is infinite, which is reported below
        out[...] = block.reshape(out.shape)
    usable = np.abs(out) <= LARGEST  # False for NaN
    if not usable.all():
        value, row = out[~usable][0], first + int(np.argmin(usable.all(-1)))
        raise DatasetError(f"{what} has {value:g} in row {row}, expected numbers up to {LARGEST:g}. {advice}")


UNIT_TOLERANCE = 1e-2  # error of a quaternion's length; recorded ones are off by 1e-6

LOOKED_AT = 20  # number of demos that decide if actions are poses
POSES = 0.25  # between 0.01, for poses a control step ahead of the hand, and 1, for unrelated numbers


def _are_poses(index: DatasetIndex, reader: DemonstrationReader, declared: tuple[str, str] | None) -> bool:
    """Return True if actions are world poses that ``env_args`` declare as deltas (``low_dim_abs.hdf5``).

    The positions decide: poses are near the hand, and deltas are not, whatever their length. Raises
    DatasetError if ``env_args`` are wrong in another way.
    """
    arms, rest = divmod(index.action_dim, 7)
    hands = [f"robot{arm}_eef_pos" for arm in range(arms)]
    if declared is None or rest or not set(hands) <= set(index.available_keys):
        return False
    lengths = [min(length, BLOCK) for length in index.lengths[:LOOKED_AT]]
    ends = np.cumsum([0, *lengths])
    actions, here = np.empty((ends[-1], arms, 7)), np.empty((ends[-1], arms, 3))
    for demo, (start, stop) in zip(index.demos, pairwise(ends), strict=False):
        reader.numbers(demo, "actions", actions[start:stop].reshape(-1, 7 * arms))
        for arm, key in enumerate(hands):
            reader.numbers(demo, f"obs/{key}", here[start:stop, arm])
    there = actions[..., :3]
    in_world = _share(there - here, there)
    (kind, frame), path = declared, index.path
    if kind == "absolute":
        if frame == "world" and in_world > 1:
            raise DatasetError(
                f"{path}: actions are not poses near robot0_eef_pos, but env_args declare absolute ones: "
                "correct control_delta (input_type) there"
            )
        return False
    if in_world >= POSES and _share(*(v - v.mean(0) for v in (there - here, there))) < POSES:
        raise DatasetError(
            f"{path}: actions are poses in another frame than robot0_eef_pos, but env_args declare deltas: "
            "correct control_delta (input_type) and input_ref_frame there"
        )
    return in_world < POSES


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    """Return the quotient of the sums of squares, infinite if the second is 0."""
    of = float(np.square(whole).sum())
    return float(np.square(part).sum()) / of if of else np.inf


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
        **{("next", flag): (torch.bool, (1,)) for flag in ("done", "terminated", "truncated")},
        EPISODE: (torch.int64, ()),
        FRAME: (torch.int64, ()),
    }
    # Expanded scalars take no memory, and the real memory is allocated once.
    data = TensorDict(batch_size=[steps], device="cpu")
    for key, (dtype, width) in widths.items():
        data.set(key, torch.zeros((), dtype=dtype).expand(steps, *width))
    needed = sum(value.numel() * value.element_size() for value in data.values(True, True))
    if storage == "memory":
        if needed > (free := available_memory()):
            raise DatasetError(
                f"{index.path}: {steps} steps need {needed / 1e9:.1f} GB of memory, but {free / 1e9:.1f} GB "
                "are free: use storage='memmap' or fewer demos"
            )
        return torch.empty_like(data)
    try:
        if scratch_dir is not None:
            Path(scratch_dir).mkdir(parents=True, exist_ok=True)
        # A folder of its own, because another reader may use the same one. It is removed by this process
        # alone, also where the end of a worker process calls no other finalizers.
        folder = tempfile.mkdtemp(dir=scratch_dir)
        data = data.memmap_like(folder)
        left: list[str] = []
        for value in data.values(True, True):
            left.append(value.filename)
            Finalize(value.untyped_storage(), _release, (folder, left), exitpriority=0)
            _reserve(value)
    except OSError as error:
        raise OSError(
            f"{scratch_dir or 'the folder of temporary files'}: cannot store {needed / 1e9:.3g} GB for "
            f"{index.path} ({error}): free some space, or choose another scratch_dir (TMPDIR)"
        ) from error
    return data


def _vector_key(index: DatasetIndex) -> NestedKey:
    return (OBSERVATION, STATE) if index.image_keys else OBSERVATION


def _reserve(mapped: Any) -> None:
    """Reserve the space of a memory map: writing without it would kill the process (SIGBUS)."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(mapped.filename, "r+b") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, mapped.numel() * mapped.element_size()))


def _release(folder: str, left: list[str]) -> None:
    """Remove a folder after the last of its memory maps; processes that these are sent to open the files."""
    left.pop()
    if not left:
        shutil.rmtree(folder, ignore_errors=True)


def _read_poses(reader: DemonstrationReader, demo: str, out: np.ndarray) -> None:
    """Read recorded poses, with 6-d rotations instead of rotation vectors."""
    arms = out.shape[-1] // 10
    for first in range(0, len(out), BLOCK):
        rows = out[first : first + BLOCK]
        recorded = np.empty((len(rows), 7 * arms))
        reader.numbers(demo, "actions", recorded, first)
        place, turn, gripper = torch.from_numpy(recorded).unflatten(-1, (arms, 7)).split((3, 3, 1), -1)
        turn = matrix_to_rotation_6d(rotvec_to_matrix(turn))
        rows[...] = torch.cat((place, turn, gripper), -1).flatten(-2).numpy()


def _read_absolute(
    reader: DemonstrationReader, demo: str, out: np.ndarray, output_max: Tensor, base_rotation: Tensor
) -> None:
    arms, units = len(base_rotation), {"output_max": output_max, "base_rotation": base_rotation}
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
                what, row = reader.name(demo, quaternion), first + int(off.argmax())
                raise DatasetError(f"{what} is not a rotation in row {row}: its length is not 1")
        rows[...] = to_absolute(*map(torch.from_numpy, (deltas, positions, quaternions)), **units).numpy()


def _conventions(index: DatasetIndex, absolute_actions: bool) -> tuple[Tensor, Tensor] | None:
    """Return units and frame of the recorded deltas, if actions are made absolute."""
    if not (index.env_args or absolute_actions):
        return None
    with reading(f"{index.path}: env_args", MISFIT):
        solved(torch.zeros(1), index.env_args)
        conventions = delta_conventions(index.env_args) if absolute_actions else None
    if conventions is not None and index.action_dim != (width := 7 * len(conventions[1])):
        raise DatasetError(f"{index.path}: actions have {index.action_dim} columns, not {width}")
    return conventions


def _actions(
    index: DatasetIndex,
    reader: DemonstrationReader,
    conventions: tuple[Tensor, Tensor] | None,
    as_recorded: bool,
) -> Callable[[str, np.ndarray], None]:
    """Return the function that reads the actions of a demo."""
    declared = None if as_recorded or not index.env_args else declared_poses(index.path, index.env_args)
    if _are_poses(index, reader, declared):
        if conventions is None:
            raise DatasetError(
                f"{index.path}: actions are absolute poses, but env_args declare deltas: use "
                "absolute_actions=True (in a Task: actions='absolute'), or correct control_delta (input_type)"
            )
        return partial(_read_poses, reader)
    if conventions is not None:
        return partial(_read_absolute, reader, output_max=conventions[0], base_rotation=conventions[1])
    return lambda demo, out: reader.numbers(demo, "actions", out)


def solved(reward: Tensor, env_args: Mapping[str, Any]) -> Tensor:
    """Return a mask, bool, of rewards that mean a solved task: those equal to robosuite's ``reward_scale``.

    Shaped rewards are positive earlier. With the scale ``None``, rewards never mean success; in an unknown
    environment, every positive reward does.
    """
    if not env_args:
        return reward > 0
    scale = env_args.get("env_kwargs", {}).get("reward_scale", 1.0)
    return reward >= (np.inf if scale is None else scale * (1 - 1e-6))


def _fill(
    index: DatasetIndex,
    data: TensorDictBase,
    reader: DemonstrationReader,
    read_actions: Callable[[str, np.ndarray], None],
) -> None:
    observation, action = data[_vector_key(index)].numpy(), data[ACTION].numpy()
    reward = data["next", "reward"].numpy()
    columns = np.cumsum([0, *index.observation_dims])
    rows = np.cumsum([0, *index.lengths])
    # A bar only for images, which take long because they are unpacked one by one.
    bar = progress_bar(f"read {index.path.name}" if index.image_keys else None, index.demos, unit="demo")
    for episode, (demo, (start, stop)) in enumerate(zip(bar, pairwise(rows), strict=True)):
        for key, (left, right) in zip(index.observation_keys, pairwise(columns), strict=True):
            reader.numbers(demo, f"obs/{key}", observation[start:stop, left:right])
        read_actions(demo, action[start:stop])
        reader.numbers(demo, "rewards", reward[start:stop])
        for key in index.image_keys:
            reader.images(demo, key, data[OBSERVATION, key][start:stop])
        data[EPISODE][start:stop] = episode
    torch.arange(len(data), out=data[FRAME])
    last = torch.from_numpy(rows[1:] - 1)
    ended = solved(data["next", "reward"][last], index.env_args)
    for i, demo in enumerate(index.demos):
        if (recorded := reader.terminated(demo)) is not None:
            ended[i] = recorded
    for key, value in (("done", True), ("terminated", ended), ("truncated", ~ended)):
        flag = data["next", key]
        flag.zero_()
        flag[last] = value


class DemonstrationReplay(TensorDictReplayBuffer):
    """The base class of buffers of all formats; see :class:`RobomimicDemonstrations` for the options."""

    def __init__(
        self,
        place: str | Path,
        *,
        filter_key: str | None = None,
        demos: int | None = None,
        observation_keys: Sequence[str] | None = None,
        image_keys: Sequence[str] = (),
        absolute_actions: bool = False,
        as_recorded: bool = False,
        storage: Literal["memory", "memmap"] = "memory",
        scratch_dir: str | Path | None = None,
        **kwargs: Any,
    ) -> None:
        check_choice("storage", storage, ("memory", "memmap"))
        chosen: dict[str, Any] = {"filter_key": filter_key, "observation_keys": observation_keys}
        chosen |= {"image_keys": image_keys, "poses": absolute_actions, "demos": demos}
        with ExitStack() as stack:
            index, reader = self._opened(stack, place, **chosen)
            conventions = _conventions(index, absolute_actions)
            action_dim = index.action_dim if conventions is None else 10 * len(conventions[1])
            data = _allocate(index, action_dim, storage, scratch_dir)
            _fill(index, data, reader, _actions(index, reader, conventions, as_recorded))
        self._index = index
        #: The file or folder that was read.
        self.path = index.path
        #: The recorded task of :data:`warmprior.envs.TASKS`, or ``None`` if it is not among them.
        self.task = index.task
        #: The keys whose values are concatenated in the observation's vector.
        self.observation_keys = index.observation_keys
        #: The side of the images in pixels, 0 if there are none.
        self.image_size = index.image_size
        #: The number of demos read.
        self.num_episodes = len(index.demos)
        super().__init__(storage=TensorStorage(data), writer=ImmutableDatasetWriter(), **kwargs)

    def _opened(self, stack: ExitStack, place: Any, **chosen: Any) -> Opened:
        """Open the demonstrations at a place, until the stack ends."""
        raise NotImplementedError

    @property
    def data(self) -> TensorDictBase:
        """All steps, ``[N]``, which share memory with the storage."""
        return self._storage.get(slice(None))

    @property
    def env_args(self) -> dict[str, Any]:
        """A copy of the description of the recorded environment, for robosuite 1.5.

        Raises ValueError if the environment is unknown; see :func:`warmprior.envs.modernize_env_args`. If
        actions are stored as absolute poses, :class:`~warmprior.AbsoluteActions` converts them for it.
        """
        if not self._index.env_args:
            raise ValueError(f"{self.path} does not say which environment it was recorded in")
        return modernize_env_args(self._index.env_args)

    @property
    def pose_columns(self) -> Tensor:
        """The columns of ``"observation"`` with grippers' positions and quaternions, int64 ``[arms, 7]``."""
        first = dict(zip(self.observation_keys, np.cumsum([0, *self._index.observation_dims]), strict=False))
        columns: list[list[int]] = []
        while not columns or f"robot{len(columns)}_eef_pos" in first:
            position, quaternion = (first[f"robot{len(columns)}_eef_{end}"] for end in ("pos", "quat"))
            columns.append([*range(position, position + 3), *range(quaternion, quaternion + 4)])
        return torch.tensor(columns)

    def joint_columns(self, key: str) -> list[int]:
        """Return for each action the column of ``"observation"``, within ``key``, that it sets, or -1."""
        check_choice("joint_key", key, self.observation_keys)
        index, position = self._index, self.observation_keys.index(key)
        first, width = sum(index.observation_dims[:position]), index.observation_dims[position]
        return [first + action if action < width else -1 for action in range(index.action_dim)]
