import json
import os
import re
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("robosuite")
pytest.importorskip("h5py")

import h5py
import robosuite

from lab.demonstrations.episodes import Episode, write_robomimic
from lab.demonstrations.scripted import generate as generate_module
from lab.demonstrations.scripted.generate import (
    expert_loop,
    generate_demonstrations,
    operator_of,
    run_episode,
)
from lab.demonstrations.scripted.motion import CLOSED, transfer
from tests.errors import raises, refuses
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.envs.simulator import make_simulator


def contents(path):
    """Everything in a file: datasets as arrays, attributes as they are."""
    found = {}
    with h5py.File(path) as file:

        def visit(name, item):
            if isinstance(item, h5py.Dataset):
                found[name] = item[()]
            found.update({f"{name}@{key}": value for key, value in item.attrs.items()})

        file.visititems(visit)
    return found


@pytest.mark.slow
def test_the_number_of_workers_does_not_matter(lift_demonstrations, tmp_path):
    other = generate_demonstrations("lift", n=3, path=tmp_path / "deep" / "two.hdf5", workers=2)
    first, second = contents(lift_demonstrations), contents(other)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def masks_of(path):
    with h5py.File(path) as file:
        return {key: {name.decode() for name in names[()]} for key, names in file["mask"].items()}


def test_layout_is_robomimics(lift_demonstrations):
    packages = Path(robosuite.__file__).parents[1]
    with h5py.File(lift_demonstrations) as file:
        data = file["data"]
        demos = sorted(data, key=lambda name: int(name[5:]))
        assert demos == ["demo_0", "demo_1", "demo_2"]
        assert data.attrs["total"] == sum(data[name].attrs["num_samples"] for name in demos)
        env_args = json.loads(data.attrs["env_args"])
        assert (env_args["env_name"], env_args["type"]) == ("Lift", 1)
        arm = env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]
        assert (arm["input_type"], arm["input_ref_frame"]) == ("delta", "world")
        for name in demos:
            demo = data[name]
            steps = demo.attrs["num_samples"]
            assets = re.findall(r'file="([^"]*)"', demo.attrs["model_file"])
            assert assets and not any(map(os.path.isabs, assets))
            assert all((packages / name).exists() for name in assets)
            assert json.loads(demo.attrs["ep_meta"]) == {}
            shapes = {"actions": (steps, 7), "states": (steps, 32), "rewards": (steps,)}
            for key, shape in shapes.items():
                assert (demo[key].shape, demo[key].dtype) == (shape, np.float64)
            assert demo["dones"].dtype == np.int64 and np.abs(demo["actions"][()]).max() <= 1
            rewards, dones = demo["rewards"][()], demo["dones"][()]
            assert rewards[-1] == dones[-1] == 1
            np.testing.assert_array_equal(dones[:-1], rewards[:-1] == 1)
            assert set(demo["obs"]) == set(demo["next_obs"]) >= set(TASKS["lift"].low_dim_keys)
            for key in demo["obs"]:
                here, after = demo["obs"][key][()], demo["next_obs"][key][()]
                assert here.dtype == np.float64
                np.testing.assert_array_equal(here[1:], after[:-1], err_msg=key)
    masks = masks_of(lift_demonstrations)
    assert masks["train"] | masks["valid"] == set(demos)
    assert not masks["train"] & masks["valid"]
    assert {"20_percent", "50_percent"} <= masks.keys()
    assert not {"better", "okay", "worse"} & masks.keys()


def test_recorded_states_and_actions_replay(lift_demonstrations):
    """The stored observations are those of the simulator that the file itself describes."""
    with h5py.File(lift_demonstrations) as file:
        env_args = json.loads(file["data"].attrs["env_args"])
        demo = file["data/demo_1"]
        states, actions = demo["states"][()], demo["actions"][()]
        seed, positions = int(demo.attrs["seed"]), demo["next_obs/robot0_eef_pos"][()]
    env = make_simulator(env_args)
    np.random.seed(seed)
    env.reset()
    for action, state in zip(actions, states, strict=True):
        found = env.sim.get_state().flatten()
        # Contacts amplify rounding: compare until the fingers close.
        if action[6] > 0:
            break
        np.testing.assert_allclose(found, state, atol=1e-6)
        observations, *_ = env.step(action)
    assert env.timestep > 10
    # env.step reports poses from the start of its last 2 ms.
    np.testing.assert_allclose(observations["robot0_eef_pos"], positions[env.timestep - 1], atol=3e-3)


def test_a_transfer_passes_over_what_lies_between():
    """By a waypoint in the middle, to the left by the arc and higher by the lift."""
    places = {"robot0_base": (np.array([-0.5, 0.0, 0.9]), np.eye(3))}
    loop = SimpleNamespace(eef=lambda arm: (np.array([0.0, -0.1, 1.0]), np.eye(3)), body=places.get)
    person = SimpleNamespace(axiswise=False, arc=0.03)
    way, last = transfer(loop, person, 0, np.array([0.0, 0.1, 1.0]), np.eye(3), CLOSED, lift=0.2)
    np.testing.assert_allclose(way.pos, [-0.03, 0.0, 1.2], atol=1e-5)
    assert last.pos.tolist() == [0.0, 0.1, 1.0] and last.grip == CLOSED


@contextmanager
def in_threads(count, state):
    """As `working`, where patches are known."""
    with ThreadPoolExecutor(count) as pool:
        yield lambda job: pool.submit(job, state)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"task": "tool_hang"}, ("'tool_hang'", "download_robomimic")),
        ({"style": "mg"}, ("style", "'mg'")),
        ({"seed": 100}, ("seed", 99, 100)),
        ({"n": 100_001}, ("n", 100_000)),
    ],
)
def test_bad_arguments(options, facts, tmp_path, monkeypatch):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path))
    refuses(lambda: generate_demonstrations(**{"task": "lift"} | options), ValueError, *facts)
    assert not list(tmp_path.iterdir())


def fake_episode(seed, style="mh", success=True):
    operator = operator_of(style, seed)
    level = ("better", "better", "okay", "okay", "worse", "worse")[operator]
    ones = np.ones((4, 7))
    return Episode(seed, operator, level, success, ones, ones, np.array([0.0, 0, 1, 1]), {"object": ones[:1]})


def generated(monkeypatch, path, run_episode, **options):
    kept = []

    def write(path, episodes, **facts):
        kept.extend(episodes)

    monkeypatch.setattr(generate_module, "working", in_threads)
    monkeypatch.setattr(generate_module, "expert_loop", MagicMock())
    monkeypatch.setattr(generate_module, "run_episode", run_episode)
    monkeypatch.setattr(generate_module, "write_robomimic", write)
    generate_demonstrations("lift", path=path, **options)
    return kept


def test_a_file_is_replaced_only_when_asked(tmp_path, monkeypatch):
    def run_episode(loop, task, style, seed):
        return fake_episode(seed, success=True)

    path = tmp_path / "mine.hdf5"
    path.write_bytes(b"mine")
    with raises(FileExistsError, "mine.hdf5", "--overwrite"):
        generated(monkeypatch, path, run_episode, style="mh", n=6)
    kept = generated(monkeypatch, path, run_episode, style="mh", n=6, overwrite=True)
    assert len(kept) == 6


@pytest.mark.parametrize("workers", [1, 7])
def test_operators_contribute_equally(workers, tmp_path, monkeypatch):
    def run_episode(loop, task, style, seed):
        time.sleep(0.01 * (seed % 3))  # they end in another order than they began
        # The last operator succeeds every fourth time only.
        return fake_episode(seed, success=seed % 6 != 5 or seed % 24 == 5)

    path = tmp_path / "out.hdf5"
    kept = generated(monkeypatch, path, run_episode, style="mh", n=14, workers=workers)
    assert [sum(e.operator == i for e in kept) for i in range(6)] == [3, 3, 2, 2, 2, 2]
    seeds = [episode.seed for episode in kept]
    assert seeds == sorted(set(seeds)) and len(seeds) == 14
    assert max(seeds) == 29


def test_filter_keys_of_several_operators(tmp_path):
    path = tmp_path / "mh.hdf5"
    episodes = [fake_episode(seed) for seed in range(12)]
    assert write_robomimic(path, episodes, env_args={}, model_file="<mujoco/>") == 48
    masks = masks_of(path)
    everything = {f"demo_{i}" for i in range(12)}
    assert masks["better"] == {"demo_0", "demo_1", "demo_6", "demo_7"}
    assert masks["better"] | masks["okay"] | masks["worse"] == everything
    assert masks["okay_better"] == masks["okay"] | masks["better"]
    for name in ("better", "okay", "worse", "50_percent"):
        for split in ("train", "valid"):
            assert masks.get(f"{name}_{split}", set()) == masks[name] & masks[split]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "style", "count", "least"),
    [
        *((task, "ph", 60, 0.95) for task in ("lift", "can", "square", "stack")),
        *((task, "mh", 60, 0.90) for task in ("lift", "can", "square", "stack")),
        ("transport", "ph", 40, 0.85),
    ],
)
def test_success_rate(task, style, count, least):
    loop = expert_loop(task)
    successes = sum(run_episode(loop, task, style, seed).success for seed in range(count))
    assert successes / count >= least
