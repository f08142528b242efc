"""Short names of LeRobot's features."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping
from typing import Any

import numpy as np

ROBOT_STATE = "observation.state"
"""LeRobot's name of a robot's joints, or of its other numbers."""

_EMPTY = "observation.images.empty_camera_"
"""The beginning of LeRobot's names of cameras that do not exist, whose images it makes itself."""


def short_names(features: Iterable[str]) -> dict[str, str]:
    """Return a short name of each of LeRobot's features: the last part of its name.

    Where last parts are equal, it is all that is behind ``observation.images.``.

    Examples:
        >>> from warmprior.lerobot.names import short_names
        >>> list(short_names(["observation.images.left.rgb", "observation.images.right.rgb"]).values())
        ['left.rgb', 'right.rgb']
    """
    features = list(features)
    last = {name: name.rpartition(".")[2] for name in features}
    count = Counter(last.values())
    whole = {name: name.removeprefix("observation.").removeprefix("images.") for name in features}
    return {name: last[name] if count[last[name]] == 1 else whole[name] for name in features}


def entry_names(features: Iterable[str]) -> dict[str, str]:
    """Return LeRobot's name of each entry of the observation, by its short name.

    Cameras that do not exist have no entry.

    Examples:
        >>> from warmprior.lerobot.names import entry_names
        >>> entry_names(["observation.state", "observation.images.left.rgb", "observation.images.right.rgb"])
        {'state': 'observation.state', 'left.rgb': 'observation.images.left.rgb', 'right.rgb': ...}
    """
    named = short_names(name for name in features if not name.startswith(_EMPTY))
    return {short: name for name, short in named.items()}


def number_names(feature: Mapping[str, Any]) -> list[str]:
    """Return a feature's names of its numbers, empty if it does not name each.

    Examples:
        >>> from warmprior.lerobot.names import number_names
        >>> number_names({"shape": [2], "names": ["pan", "lift"]})
        ['pan', 'lift']
        >>> number_names({"shape": [2], "names": {"motors": ["pan", "lift"]}}), number_names({"shape": [2]})
        (['pan', 'lift'], [])
    """
    names = feature.get("names")
    if isinstance(names, Mapping) and len(names) == 1:
        (names,) = names.values()
    if not isinstance(names, list | tuple) or [len(names)] != [*feature["shape"]]:
        return []
    return [*names] if all(isinstance(name, str) for name in names) else []


def unseen_tasks(episodes: Iterable[Any]) -> list[str]:
    """Return what a policy without language does not see, given the task texts of each episode.

    Examples:
        >>> from warmprior.lerobot.names import unseen_tasks
        >>> unseen_tasks([["pick"], ["place"], ["pick"]]), unseen_tasks([["pick"], ["pick"]])
        (['task, one of 2'], [])
    """
    several = (list, tuple, np.ndarray)  # pandas reads lists of parquet files as arrays
    listed = (tasks if isinstance(tasks, several) else [tasks] for tasks in episodes)
    texts = {str(text) for tasks in listed for text in tasks if text is not None}
    return [f"task, one of {len(texts)}"] if len(texts) > 1 else []


def named_joints(features: Mapping[str, Any], observed: Container[str]) -> str:
    """Return the observation with the same names as the actions, which may be its absolute targets.

    It is empty if there is none among those that are observed.

    Examples:
        >>> from warmprior.lerobot.names import named_joints
        >>> arm = {"names": ["pan", "lift"]}
        >>> named_joints({"observation.state": arm, "action": arm}, ["observation.state"])
        'observation.state'
    """
    state, action = (features.get(name, {}).get("names") for name in (ROBOT_STATE, "action"))
    return ROBOT_STATE if state is not None and state == action and ROBOT_STATE in observed else ""
