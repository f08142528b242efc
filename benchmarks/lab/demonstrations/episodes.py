"""Recorded episodes, and the files of them that robomimic opens."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.demonstrations.scripted.operators import LEVELS
from warmprior.checks import check_between, check_whole_numbers
from warmprior.envs.control_loop import Observations, StepLoop
from warmprior.io.extras import require
from warmprior.io.files import check_writable, write_atomic
from warmprior.options.defaults import EVALUATION_SEED

#: The file of a ``seed`` uses at most this many simulator seeds, from ``seed * SEEDS_PER_FILE`` on.
SEEDS_PER_FILE = 100_000


def seeds_of(seed: int, n: int) -> range:
    """Return the simulator seeds of the first ``n`` episodes of a file; raise ValueError if out of range."""
    check_between(0, EVALUATION_SEED // SEEDS_PER_FILE - 1, seed=seed)
    check_whole_numbers(n=n)
    check_between(1, SEEDS_PER_FILE, n=n)
    return range(seed * SEEDS_PER_FILE, seed * SEEDS_PER_FILE + n)


def check_file(path: Path, overwrite: bool) -> None:
    """Raise an OSError if a file cannot be written, or exists and shall not be replaced."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name a file in it")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another file, or replace it (overwrite, --overwrite)")
    check_writable(path.parent)


@dataclass
class Episode:
    """A recorded demonstration of ``N`` steps.

    ``actions`` are ``[N, d_a]`` in ``[-1, 1]``; ``states`` are the simulator's before each action, ``[N, 1 +
    nq + nv]``; ``rewards`` are 1 if the action led to a solved state, ``[N]``; ``observations`` are ``[N + 1,
    ...]`` by name, the last row after the last action. All are float64.
    """

    seed: int
    operator: int
    level: str
    success: bool
    actions: np.ndarray
    states: np.ndarray
    rewards: np.ndarray
    observations: dict[str, np.ndarray]


class Recorder:
    """A control loop that records the episode that is played in it.

    What else the loop has, it has as well.
    """

    def __init__(self, loop: StepLoop) -> None:
        self.loop = loop

    def __getattr__(self, name: str) -> Any:
        return getattr(self.loop, name)

    def begin(self, observations: Observations) -> Observations:
        """Begin an episode at the loop's state, which has these observations, and return them."""
        self._observations = [_exact(observations)]
        self._states: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        return observations

    def reset(self, seed: int) -> Observations:
        """Begin the episode of a seed."""
        return self.begin(self.loop.reset(seed))

    def step(self, action: np.ndarray) -> tuple[Observations, bool]:
        """Step the loop."""
        self._states.append(self.loop.state())
        observations, success = self.loop.step(action)
        self._actions.append(np.array(action, np.float64))
        self._observations.append(_exact(observations))
        self.rewards.append(float(success))
        return observations, success

    def episode(self, seed: int, *, success: bool, operator: int = 0, level: str = "better") -> Episode:
        """Return the episode so far."""
        rows = self._observations
        return Episode(
            seed=seed,
            operator=operator,
            level=level,
            success=success,
            actions=np.stack(self._actions),
            states=np.stack(self._states),
            rewards=np.array(self.rewards),
            observations={key: np.stack([row[key] for row in rows]) for key in rows[0]},
        )


def _exact(observations: Observations) -> dict[str, np.ndarray]:
    return {key: value.astype(np.float64) for key, value in observations.items()}


_VALID_FRACTION = 0.1
_PERCENTAGES = (20, 50)


def write_robomimic(
    path: Path,
    episodes: Iterable[Episode],
    *,
    env_args: Mapping[str, Any],
    model_file: str,
    seed: int = 0,
    attributes: Mapping[str, Any] | None = None,
) -> int:
    """Write episodes to a file that robomimic's reader opens, and return its number of samples.

    ``seed`` seeds the random split into filter keys; ``model_file`` is the simulator's XML. Its files are
    named from robosuite's folder on, where robosuite looks for them: no file holds a path of its machine.
    """
    h5py = require("h5py", "sim")
    model_file = re.sub(r'file="[^"]*/robosuite/', 'file="robosuite/', model_file)
    steps: list[int] = []
    levels: list[str] = []

    def write(temporary: Path) -> None:
        with h5py.File(temporary, "w") as file:
            data = file.create_group("data")
            for episode in episodes:
                demo = data.create_group(f"demo_{len(levels)}")
                _write_demo(demo, episode)
                demo.attrs["model_file"] = model_file
                levels.append(episode.level)
                steps.append(len(episode.actions))
            data.attrs["total"] = sum(steps)
            data.attrs["env_args"] = json.dumps(env_args, indent=4)
            data.attrs.update(attributes or {})
            for key, demos in _filter_keys(levels, np.random.default_rng(seed)).items():
                names = sorted(f"demo_{i}" for i in demos)
                file.create_dataset(f"mask/{key}", data=np.array(names, dtype="S"))

    write_atomic(path, write)
    return sum(steps)


def _write_demo(demo: Any, episode: Episode) -> None:
    steps = len(episode.actions)
    dones = (episode.rewards > 0).astype(np.int64)
    dones[-1] = 1
    demo.create_dataset("actions", data=episode.actions)
    demo.create_dataset("states", data=episode.states)
    demo.create_dataset("rewards", data=episode.rewards)
    demo.create_dataset("dones", data=dones)
    for key, values in episode.observations.items():
        for group, part in (("obs", values[:-1]), ("next_obs", values[1:])):
            demo.create_dataset(f"{group}/{key}", data=part)
    demo.attrs["num_samples"] = steps
    demo.attrs["ep_meta"] = "{}"
    demo.attrs["seed"] = episode.seed
    demo.attrs["operator"] = episode.operator


def _filter_keys(levels: list[str], rng: np.random.Generator) -> dict[str, set[int]]:
    """Split the demonstrations as robomimic's files do; empty subsets are left out."""
    count = len(levels)
    everything = set(range(count))
    order = rng.permutation(count).tolist()
    valid = set(order[: min(count - 1, max(1, round(count * _VALID_FRACTION)))])
    splits = {"train": everything - valid, "valid": valid}
    subsets = {}
    for percentage in _PERCENTAGES:
        size = max(1, count * percentage // 100)
        subsets[f"{percentage}_percent"] = set(rng.permutation(count)[:size].tolist())
    if len(set(levels)) > 1:
        by_level = {name: {i for i in everything if levels[i] == name} for name in LEVELS}
        subsets |= by_level
        for first, second in (("okay", "better"), ("worse", "okay"), ("worse", "better")):
            subsets[f"{first}_{second}"] = by_level[first] | by_level[second]
    keys = dict(splits)
    for name, demos in subsets.items():
        keys[name] = demos
        keys |= {f"{name}_{split}": demos & members for split, members in splits.items()}
    return {name: demos for name, demos in keys.items() if demos}
