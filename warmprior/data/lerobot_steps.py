"""The numbers of any LeRobotDataset, as contiguous steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict

from warmprior.data.hdf5_members import DatasetError
from warmprior.io.extras import require
from warmprior.keys import ACTION, EPISODE, OBSERVATION

__all__ = ["lerobot_steps"]


def lerobot_steps(
    dataset: str | Path,
    observation_keys: Sequence[str] = ("observation.state",),
    action_key: str = "action",
) -> TensorDict:
    """Read the steps of a LeRobotDataset of any robot, in raw units.

    Args:
        dataset: its folder, or ``user/name`` of its repository at the hub.
        observation_keys: features that make the observation, concatenated in this order.
        action_key: the feature that is the action.

    Returns:
        ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]``, float32, and ``"episode"`` ``[N]``, as
        :meth:`Task.of <warmprior.training.Task.of>` takes them.

    Raises:
        DatasetError: if there is no such feature, or it is no vector of numbers.
        ImportError: if LeRobot is not installed.

    See Also:
        :class:`~warmprior.training.Task`: takes them, with an environment.

    Examples:
        >>> steps = lerobot_steps("lerobot/pusht_keypoints")  # doctest: +SKIP
        >>> steps["action"].shape  # doctest: +SKIP
        torch.Size([25650, 2])
    """
    require("lerobot", "lerobot")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = Path(dataset).expanduser()
    here = folder.is_dir()
    found = LeRobotDataset(folder.name if here else str(dataset), root=folder if here else None)
    for key in (*observation_keys, action_key):
        feature = found.features.get(key)
        if feature is None or len(feature["shape"]) != 1 or feature["dtype"] in ("image", "video"):
            known = {n: f["shape"] for n, f in found.features.items() if len(f["shape"]) == 1}
            raise DatasetError(f"{dataset} has no vector {key!r}: it has {known}")
    names = [*observation_keys, action_key, "episode_index"]
    columns = found.hf_dataset.with_format("torch", columns=names)[:]

    def vectors(key: str) -> torch.Tensor:
        return columns[key].reshape(len(columns["episode_index"]), -1).float()

    steps = {
        OBSERVATION: torch.cat([vectors(key) for key in observation_keys], -1),
        ACTION: vectors(action_key),
        EPISODE: columns["episode_index"].flatten().long(),
    }
    return TensorDict(steps, [len(steps[EPISODE])])
