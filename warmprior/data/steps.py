"""The values of demonstrations, as a TensorDict of contiguous steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior.checks import check_choice
from warmprior.data.checks import MISFIT, DatasetError, declared_poses, reading
from warmprior.data.image_cache import image_shape, read_images
from warmprior.data.index import BLOCK, DatasetIndex, DemonstrationReader
from warmprior.envs.env_args import absolute_actions as to_absolute
from warmprior.envs.env_args import delta_conventions
from warmprior.io.machine import available_memory
from warmprior.keys import ACTION, EPISODE, FRAME, OBSERVATION
from warmprior.rotation import matrix_to_rotation_6d, rotvec_to_matrix

Storage = Literal["memory", "memmap"]

StoredActions = Literal["delta", "absolute", "stored"]
"""Pose deltas, the absolute poses that they target, or the numbers of the file, whatever they are."""


def read_steps(
    index: DatasetIndex,
    reader: DemonstrationReader,
    cached: Callable[[str], Tensor],
    *,
    actions: StoredActions = "delta",
    storage: Storage = "memory",
) -> TensorDict:
    """Return the values of demonstrations; see :meth:`Demonstrations.steps` for entries and options.

    ``cached`` returns the images of a camera by their name, as a memory map.
    """
    check_choice("storage", storage, get_args(Storage))
    check_choice("actions", actions, get_args(StoredActions))
    conventions = _conventions(index, actions == "absolute")
    action_dim = index.action_dim if conventions is None else 10 * len(conventions[1])
    data = _allocate(index, action_dim, index.image_keys if storage == "memory" else ())
    _fill(index, data, reader, _actions(index, reader, conventions, actions))
    for key in index.image_keys:
        if storage == "memory":
            read_images(index, reader, key, data[OBSERVATION, key])
        else:
            data[OBSERVATION, key] = cached(key)
    return data


UNIT_TOLERANCE = 1e-2  # error of a quaternion's length; recorded ones are off by 1e-6

LOOKED_AT = 20  # number of demos that decide if actions are poses
POSES = 0.25  # between 0.01, for poses a control step ahead of the hand, and 1, for unrelated numbers


def are_poses(index: DatasetIndex, reader: DemonstrationReader) -> bool:
    """Return True if actions are world poses that ``env_args`` declare as deltas (``low_dim_abs.hdf5``).

    The positions decide: poses are near the hand, and deltas are not, whatever their length. Raises
    DatasetError if ``env_args`` are wrong in another way.
    """
    declared = declared_poses(index.path, index.env_args) if index.env_args else None
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


def _allocate(index: DatasetIndex, action_dim: int, images: Sequence[str]) -> TensorDict:
    """Return memory for the values, and for these images; raise DatasetError if there is not enough."""
    steps = sum(index.lengths)
    vector = (torch.float32, (sum(index.observation_dims),))
    image = (torch.uint8, image_shape(index)[1:])
    widths = {
        index.vector_key: vector,
        **{(OBSERVATION, key): image for key in images},
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
    if needed > (free := available_memory()):
        advice = "storage='memmap' or " if images else ""
        raise DatasetError(
            f"{index.path}: {steps} steps need {needed / 1e9:.1f} GB of memory, but {free / 1e9:.1f} GB are "
            f"free: use {advice}fewer demos"
        )
    return torch.empty_like(data)


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
    actions: StoredActions,
) -> Callable[[str, np.ndarray], None]:
    """Return the function that reads the actions of a demo."""
    if actions != "stored" and are_poses(index, reader):
        if conventions is None:
            raise DatasetError(
                f"{index.path}: actions are absolute poses, but env_args declare deltas: use "
                "actions='absolute', or correct control_delta (input_type)"
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
    observation, action = data[index.vector_key].numpy(), data[ACTION].numpy()
    reward = data["next", "reward"].numpy()
    columns = np.cumsum([0, *index.observation_dims])
    rows = np.cumsum([0, *index.lengths])
    for episode, (demo, (start, stop)) in enumerate(zip(index.demos, pairwise(rows), strict=True)):
        for key, (left, right) in zip(index.observation_keys, pairwise(columns), strict=True):
            reader.numbers(demo, f"obs/{key}", observation[start:stop, left:right])
        read_actions(demo, action[start:stop])
        reader.numbers(demo, "rewards", reward[start:stop])
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
