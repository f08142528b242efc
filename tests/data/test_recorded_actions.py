"""What actions are, whatever a file declares: deltas of any size, or poses as in low_dim_abs.hdf5."""

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data.hdf5_faults import replace, unreadable
from tests.data.synthetic import env_args_14, env_args_15, write_robomimic_file
from tests.errors import raises, refuses
from warmprior.data import DatasetError, convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.envs import delta_conventions, modernize_env_args

HAND_TO_SITE = Rotation.from_euler("z", -90, degrees=True)
BASE = np.array([-0.56, 0.0, 0.912])


def _deltas(kind, steps, rng):
    """Position deltas ``[steps, 3]``, as different devices record them."""
    if kind == "keyboard":  # one key at a time, held for a while
        held = np.repeat(np.eye(3)[rng.integers(3, size=steps // 4 + 1)], 4, axis=0)[:steps]
        return 3.75 * held * rng.choice([-1, 0, 1], size=(steps, 1))
    if kind == "slow":
        return np.clip(0.04 * rng.normal(size=(steps, 3)), -1, 1)
    if kind == "resting":  # hardly a motion
        return np.where(rng.random((steps, 1)) < 0.9, 0.0, rng.normal(size=(steps, 3)))
    goal = rng.normal(size=(steps // 20 + 1, 3)).repeat(20, axis=0)[:steps]
    return np.clip(goal + 0.1 * rng.normal(size=(steps, 3)), -1, 1)


def write(path, kind="scripted", stored="delta", task="lift", lengths=(40, 25), env_args=None):
    """A file in which hands move as deltas ask; returns deltas and poses ``[N, 10 * arms]`` of all steps."""
    env_args = env_args or env_args_14(task)
    write_robomimic_file(path, lengths=lengths, task=task, env_args=env_args)
    rng, every = np.random.default_rng(1), {"delta": [], "absolute": []}
    arms = 2 if task == "transport" else 1
    with h5py.File(path, "a") as file:
        for number, steps in enumerate(lengths):
            demo = file[f"data/demo_{number}"]
            columns = {"delta": [], "absolute": [], "rotvec": [], "base": []}
            for arm in range(arms):
                move, turn = _deltas(kind, steps, rng), rng.normal(size=(steps, 3))
                gripper = rng.choice([-1.0, 1.0], size=(steps, 1))
                # The hand points down and lags behind what it is asked for; the controller clips that.
                start = np.array([0.0, 0.1 - 0.2 * arm, 1.0]) + 0.1 * rng.normal(size=3)
                clipped = 0.05 * np.clip(move, -1, 1)
                place = start + np.concatenate([np.zeros((1, 3)), 0.5 * clipped.cumsum(0)[:-1]])
                tilt = Rotation.from_rotvec(0.1 * rng.normal(size=(steps, 3)))
                hand = Rotation.from_rotvec([np.pi, 0, 0]) * tilt
                demo[f"obs/robot{arm}_eef_pos"][...] = place
                demo[f"obs/robot{arm}_eef_quat"][...] = hand.as_quat()
                site = Rotation.from_rotvec(0.5 * np.clip(turn, -1, 1)) * hand * HAND_TO_SITE
                rows = site.as_matrix()[:, :2].reshape(steps, 6)
                columns["delta"] += [move, turn, gripper]
                columns["absolute"] += [place + clipped, rows, gripper]
                columns["rotvec"] += [place + clipped, site.as_rotvec(), gripper]
                columns["base"] += [place + clipped - BASE, site.as_rotvec(), gripper]
            demo["actions"][...] = np.concatenate(columns[stored], -1)
            for name, values in every.items():
                values.append(np.concatenate(columns[name], -1))
    return {name: torch.from_numpy(np.concatenate(values)).float() for name, values in every.items()}


KINDS = ("scripted", "keyboard", "slow", "resting")


@pytest.mark.parametrize("task", ["lift", "transport"])
@pytest.mark.parametrize("kind", KINDS)
def test_deltas_are_read_as_deltas(tmp_path, kind, task):
    path = tmp_path / "low_dim.hdf5"
    expected = write(path, kind, task=task)
    assert torch.equal(RobomimicDemonstrations(path).steps()["action"], expected["delta"])
    found = RobomimicDemonstrations(path).steps(actions="absolute")["action"]
    torch.testing.assert_close(found, expected["absolute"], atol=1e-5, rtol=0)


@pytest.mark.parametrize("task", ["lift", "transport"])
@pytest.mark.parametrize("kind", KINDS)
def test_poses_declared_as_deltas(tmp_path, kind, task):
    path = tmp_path / "low_dim_abs.hdf5"
    expected = write(path, kind, "rotvec", task)
    with raises(DatasetError, "low_dim_abs.hdf5", "actions='absolute'", "control_delta"):
        RobomimicDemonstrations(path).steps()
    action = RobomimicDemonstrations(path).steps(actions="absolute")["action"]
    torch.testing.assert_close(action, expected["absolute"], atol=1e-5, rtol=0)
    # An environment of deltas, towards these poses.
    delta_conventions(modernize_env_args(RobomimicDemonstrations(path).index().env_args))
    # Whatever observations are chosen.
    other = RobomimicDemonstrations(path).steps(actions="absolute", observations=["object"])
    assert torch.equal(other["action"], action)
    with h5py.File(path) as file:
        recorded = np.concatenate([file[f"data/demo_{n}/actions"] for n in (0, 1)])
    as_recorded = RobomimicDemonstrations(path).steps(actions="stored")["action"]
    np.testing.assert_array_equal(as_recorded.numpy(), recorded.astype(np.float32))


def test_poses_declared_as_poses(tmp_path):
    path, env_args = tmp_path / "file.hdf5", env_args_14("lift")
    env_args["env_kwargs"]["controller_configs"]["control_delta"] = False
    write(path, stored="rotvec", env_args=env_args)
    assert RobomimicDemonstrations(path).steps()["action"].shape == (65, 7)
    with raises(DatasetError, "file.hdf5", "env_args", "absolute"):
        RobomimicDemonstrations(path).steps(actions="absolute")
    write(path, stored="delta", env_args=env_args)
    with raises(DatasetError, "file.hdf5", "robot0_eef_pos", "control_delta"):
        RobomimicDemonstrations(path).steps()


def test_poses_in_the_frame_of_the_base(tmp_path):
    path = tmp_path / "file.hdf5"
    write(path, stored="base", env_args=env_args_15("lift"))
    for absolute in (False, True):
        with raises(DatasetError, "file.hdf5", "robot0_eef_pos", "input_ref_frame"):
            RobomimicDemonstrations(path).steps(actions="absolute" if absolute else "delta")


def test_deltas_of_another_robot(tmp_path):
    path, env_args = tmp_path / "file.hdf5", env_args_14("lift") | {"env_name": "Own"}
    write(path, env_args=env_args)
    with h5py.File(path, "a") as file:
        for name in ("demo_0", "demo_1"):
            replace(file, f"data/{name}/actions", np.pad(file[f"data/{name}/actions"], ((0, 0), (0, 1))))
    unreadable(path, "8 columns", 7, steps={"actions": "absolute"})


def test_a_converted_file_tells_the_same(tmp_path):
    pytest.importorskip("lerobot")
    from warmprior.data.formats.lerobot import LeRobotDemonstrations

    expected = write(tmp_path / "low_dim_abs.hdf5", stored="rotvec")
    folder = convert_robomimic(tmp_path / "low_dim_abs.hdf5", tmp_path / "converted")
    refuses(lambda: LeRobotDemonstrations(folder).steps(), DatasetError, "converted", "actions='absolute'")
    found = LeRobotDemonstrations(folder).steps(actions="absolute")["action"]
    torch.testing.assert_close(found, expected["absolute"], atol=1e-5, rtol=0)
