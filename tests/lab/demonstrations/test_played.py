from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("robosuite")
pytest.importorskip("h5py")

import h5py

from lab.demonstrations import played
from lab.demonstrations.episodes import SEEDS_PER_FILE
from tests.errors import raises
from tests.lab.demonstrations.test_scripted import in_threads
from warmprior import Normalizer, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.data import open_demonstrations
from warmprior.diagnostics import executed_actions
from warmprior.envs import RobosuiteEnv, environment_description
from warmprior.envs.simulator import task_env_args
from warmprior.evaluation import play_episode
from warmprior.saving import save_policy

LENGTH = 20


def saved(folder, keys=None, width=19):
    """A policy that moves at random, for short episodes of lift."""
    torch.manual_seed(0)
    # Units of their own for actions and observations, so that normalised values would be noticed.
    ends = {"observation": torch.full((width,), -3.0), "action": -torch.ones(7)}
    units = Normalizer(ends, {"observation": torch.full((width,), 5.0), "action": torch.full((7,), 2.0)})
    described = environment_description(task_env_args("lift"), "ph", low_dim_keys=keys, horizon=LENGTH)
    network = VelocityMLP(7, width, 8, hidden_dim=8)
    actor = WarmPriorActor(network, PastPrior(8), nfe=1, normalizer=units, environment=described)
    save_policy(actor, folder)
    return folder


@pytest.fixture
def odd_solved(monkeypatch):
    """The episodes that are played, of which those with odd seeds count as solved."""
    episodes = []

    def play(actor, env, seed, **options):
        episodes.append(play_episode(actor, env, seed, **options))
        return replace(episodes[-1], success=seed % 2 == 1)

    played._played.cache_clear()
    monkeypatch.setattr(played, "working", in_threads)
    monkeypatch.setattr(played, "play_episode", play)
    return episodes


def test_what_a_policy_plays_is_written_as_it_was(tmp_path, odd_solved):
    path, first = tmp_path / "own.hdf5", 3 * SEEDS_PER_FILE
    played.play_demonstrations(saved(tmp_path / "policy"), 5, 3, path=path, nfe=2, workers=1)
    with raises(FileExistsError, "own.hdf5", "--overwrite"):
        played.play_demonstrations(tmp_path / "policy", path=path)
    steps = open_demonstrations(path).steps()
    assert steps["episode"].bincount().tolist() == [LENGTH, LENGTH]
    with h5py.File(path) as file:
        demos = [file[f"data/demo_{i}"] for i in range(2)]
        assert [demo.attrs["seed"] for demo in demos] == [first + 1, first + 3]
        states = [demo["states"][()] for demo in demos]
        actions = [demo["actions"][()] for demo in demos]
    # An environment of its own, in which the written actions are executed, passes the same states.
    env = RobosuiteEnv("lift", sim_state=True)
    for i, seed in enumerate((first + 1, first + 3)):
        env.set_seed(seed)
        data = env.reset()
        for t in range(LENGTH):
            assert np.array_equal(data["sim_state"].numpy(), states[i][t])
            assert torch.equal(data["observation"], steps["observation"][i * LENGTH + t])
            data = env.step(data.set("action", torch.from_numpy(actions[i][t]).float()))["next"]
        decided, _, _ = executed_actions(next(e for e in odd_solved if e.seed == seed).decisions)
        raw = decided * 1.5 + 0.5  # from [-1, 1] to [-1, 2]
        np.testing.assert_allclose(actions[i], raw.numpy(), rtol=1e-5, atol=1e-6)


def test_a_policy_that_sees_less_plays_whole_demonstrations(tmp_path, odd_solved):
    """As policies that see images do, whose files are rendered and read with the objects' poses."""
    folder = saved(tmp_path / "policy", ["robot0_eef_pos"], 3)
    played.play_demonstrations(folder, 2, path=tmp_path / "own.hdf5", workers=1)
    demonstrations = open_demonstrations(tmp_path / "own.hdf5")
    assert demonstrations.steps()["observation"].shape == (LENGTH, 19)
    with h5py.File(tmp_path / "own.hdf5") as file:
        assert file["data/demo_0/obs/object"].shape == (LENGTH, 10)


def test_nothing_solved_nothing_written(tmp_path, odd_solved):
    folder = saved(tmp_path / "policy")
    with raises(ValueError, "none of 1 episodes"):
        played.play_demonstrations(folder, 1, path=tmp_path / "own.hdf5", workers=1)
    with raises(IsADirectoryError, "policy"):
        played.play_demonstrations(folder, 1, path=folder, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy"]
