"""Scripted demonstrations, determined by task, style and seed, and their files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.demonstrations.scripted.experts import EXPERTS
from lab.demonstrations.scripted.motion import ArmRunner
from lab.demonstrations.scripted.operators import LEVELS, OPERATORS, SKILLED, Demonstrator
from warmprior.envs.control_loop import ControlLoop, StepLoop
from warmprior.envs.robosuite_tasks import get_task
from warmprior.envs.simulator import make_simulator, task_env_args
from warmprior.io.extras import require
from warmprior.io.files import write_atomic

_EXTRA_KEYS = ("eef_quat_site", "gripper_qvel", "joint_pos", "joint_vel")
_HOLD = 6  # steps that the task must stay solved for before the episode ends


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


def expert_loop(task: str) -> ControlLoop:
    """Make the simulation that a task's expert acts in."""
    spec = get_task(task)
    extra = (f"robot{i}_{key}" for i in range(spec.arms) for key in _EXTRA_KEYS)
    return ControlLoop(make_simulator(task_env_args(task)), (*spec.low_dim_keys, *extra))


def operator_of(style: str, seed: int) -> int:
    """Return the index of the operator who plays a seed; in ``mh`` data operators take turns."""
    return seed % len(OPERATORS) if style == "mh" else 0


def run_episode(loop: StepLoop, task: str, style: str, seed: int) -> Episode:
    """Play one scripted episode in an :func:`expert_loop`; the same seed gives the same one.

    It ends six steps after the task is solved, when the plan is exhausted, or at the task's time limit.
    """
    spec = get_task(task)

    def observe(low_dim: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {key: value.astype(np.float64) for key, value in low_dim.items()}

    index = operator_of(style, seed)
    operator = OPERATORS[index] if style == "mh" else SKILLED
    # The first number separates this stream from others with the same seed.
    person = Demonstrator(operator, np.random.default_rng([7919, seed]))
    observations = [observe(loop.reset(seed))]
    runners = [ArmRunner(loop, arm, plan, person) for arm, plan in enumerate(EXPERTS[task](loop, person))]
    states, actions, rewards = [], [], []
    solved = 0
    for _ in range(spec.horizon(style)):
        states.append(loop.state())
        action = np.concatenate([runner.act() for runner in runners])
        low_dim, success = loop.step(action)
        actions.append(action)
        rewards.append(float(success))
        observations.append(observe(low_dim))
        solved = solved + 1 if success else 0
        if solved >= _HOLD or (not success and all(runner.given_up for runner in runners)):
            break
    return Episode(
        seed=seed,
        operator=index,
        level=person.level,
        success=solved > 0,
        actions=np.stack(actions),
        states=np.stack(states),
        rewards=np.array(rewards),
        observations={key: np.stack([entry[key] for entry in observations]) for key in observations[0]},
    )


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
