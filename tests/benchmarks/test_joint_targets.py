import h5py
import joint_targets
import numpy as np
import pytest
import torch

from lab.demonstrations.data_options import DataOptions
from lab.demonstrations.scripted.generate import generate_demonstrations
from tests.processes import here
from warmprior.data import convert_robomimic, open_demonstrations
from warmprior.envs.robosuite_tasks import TaskSpec
from warmprior.tasks import Task


def test_follower_gets_the_joints_of_the_next_step(monkeypatch, tmp_path):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path))
    monkeypatch.setattr("lab.demonstrations.scripted.generate.working", here)
    monkeypatch.setattr(TaskSpec, "horizon", lambda spec, style: 400)  # an expert needs more
    task = joint_targets.task(DataOptions(demonstrations=(1,)))
    leader = h5py.File(generate_demonstrations("square", "ph", 1))["data/demo_0"]
    (path,) = tmp_path.rglob("*joint_targets.hdf5")
    follower = h5py.File(path)["data/demo_0"]
    joints, steps = leader["next_obs/robot0_joint_pos"][()], len(follower["actions"])
    expected = np.concatenate([joints, np.repeat(joints[-1:], 10, 0)])[:steps]
    np.testing.assert_array_equal(follower["actions"][:, :7], expected)
    np.testing.assert_allclose(follower["states"][0, 1:], leader["states"][0, 1:], atol=1e-12)
    # It lags behind by less than the arm moves in three steps.
    lag = np.abs(follower["next_obs/robot0_joint_pos"][()] - expected)
    assert 0 < lag.max() < 3 * np.abs(np.diff(expected, axis=0)).max()
    assert follower["rewards"][-1] == 1

    env = task.make_env()
    assert task.data["observation"].shape[-1] == 14 + 7 + 2
    assert task.data["action"].shape[-1] == 8
    assert task.rest.columns.tolist() == [*range(14, 21), -1]
    assert env.action_spec.shape == (8,)
    env.close()
    assert joint_targets.demonstrations("ph", 1) == path  # recorded once

    pytest.importorskip("lerobot.datasets")
    folder = convert_robomimic(path, tmp_path / "joints", observations=joint_targets.OBSERVATION)
    converted = Task(open_demonstrations(f"lerobot:{folder}"), observations=joint_targets.OBSERVATION)
    torch.testing.assert_close(converted.data["action"], task.data["action"])
