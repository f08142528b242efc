"""Writes demonstrations in robomimic's HDF5 layout, one at a time and all or nothing."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warmprior.data.scripted.episode import Episode
from warmprior.data.scripted.operators import LEVELS
from warmprior.io.extras import require
from warmprior.io.files import write_atomic

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
    """Write episodes, one by one, to a file that robomimic's own reader opens; how many samples it has.

    The seed is that of the random split into filter keys, ``model_file`` the simulator's XML.
    """
    h5py = require("h5py", "sim")
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
        of = {name: {i for i in everything if levels[i] == name} for name in LEVELS}
        subsets |= of
        for first, second in (("okay", "better"), ("worse", "okay"), ("worse", "better")):
            subsets[f"{first}_{second}"] = of[first] | of[second]
    found = dict(splits)
    for name, demos in subsets.items():
        found[name] = demos
        found |= {f"{name}_{split}": demos & members for split, members in splits.items()}
    return {name: demos for name, demos in found.items() if demos}
