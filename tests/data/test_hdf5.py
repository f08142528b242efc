import subprocess
import sys

import h5py
import numpy as np
import pytest
import torch

from tests.data.hdf5_faults import unreadable
from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.errors import raises, refuses
from warmprior.data import open_demonstrations
from warmprior.data.checks import DatasetError
from warmprior.data.formats.hdf5 import RobomimicDemonstrations, RobomimicReader


def test_long_demos_are_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("warmprior.data.formats.hdf5.BLOCK", 7)
    path = tmp_path / "file.hdf5"
    (demo,) = write_robomimic_file(path, lengths=(40,))
    with h5py.File(path) as file:
        out = np.empty((40, 7), np.float32)
        RobomimicReader(file).numbers("demo_0", "actions", out)
    np.testing.assert_array_equal(out, demo["actions"].astype(np.float32))


def test_the_first_demos_are_those_of_the_smallest_numbers(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, lengths=range(1, 13), masks={"late": [11, 3, 10]})
    assert RobomimicDemonstrations(path, demos=11).index().demos == tuple(f"demo_{n}" for n in range(11))
    assert RobomimicDemonstrations(path, demos=2, mask="late").index().demos == ("demo_3", "demo_10")
    unreadable(path, 12, "demos=13", demos=13)
    with h5py.File(path, "a") as file:
        del file["data"].attrs["total"]
        for name in "demo_01", "demo_001", "demo_0001":
            file.copy("data/demo_1", f"data/{name}")
    equal = ("demo_0001", "demo_001", "demo_01", "demo_1")
    assert RobomimicDemonstrations(path, demos=5).index().demos == ("demo_0", *equal)
    refuses(lambda: RobomimicDemonstrations(path, demos=0).index(), ValueError, "demos", 0)


def test_an_unknown_environment_has_what_it_finds(tmp_path):
    """Also a goal by a name of its own: a policy that is blind to it would learn nothing, without a word."""
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, task="transport", env_args=env_args_15("lift") | {"env_name": "Own"})
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            steps = len(demo["actions"])
            del demo["obs/robot1_eef_quat"]
            demo["obs/robot2_eef_pos"] = demo["obs/robot3_right_eef_pos"] = np.full((steps, 3), 0.5)
            demo["obs/robot2_joint_pos"] = np.zeros((steps, 7))
            demo["obs/robot_goal"] = np.full((steps, 2), 0.25)
            demo["obs/door_open"] = np.zeros(steps, bool)
            demo["obs/depth"] = np.zeros((steps, 4, 4, 1))
            demo["obs/language"] = np.array([b"open"] * steps)
            demo.create_group("obs/nested")
    index = RobomimicDemonstrations(path).index()
    assert index.task is None and index.action_dim == 14
    assert index.observation_keys == (
        *("object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"),
        *("robot1_eef_pos", "robot1_gripper_qpos", "robot2_eef_pos"),
        *("door_open", "robot3_right_eef_pos", "robot_goal"),
    )
    assert (RobomimicDemonstrations(path).steps()["observation"][:, -2:] == 0.25).all()
    for wrong in [], (), ["legs"]:
        with raises(DatasetError, "file.hdf5", *wrong or ["observations"], "robot0_eef_pos"):
            RobomimicDemonstrations(path).index(observations=wrong)
    with raises(ValueError, "file.hdf5", "['object', 'object']"):
        RobomimicDemonstrations(path).index(observations=["object", "object"])


def test_a_file_of_another_simulator_is_read_without_its_environment(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, env_args={"env_name": "Isaac-Lift-v0", "type": 2})
    assert RobomimicDemonstrations(path).index().env_args == {}


def test_a_file_without_an_environment_names_its_rate(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path)
    with h5py.File(path, "a") as file:
        file["data"].attrs["control_freq"] = 30  # the environment's own counts
    assert RobomimicDemonstrations(path).index().rate == 20
    with h5py.File(path, "a") as file:
        del file["data"].attrs["env_args"]
    assert RobomimicDemonstrations(path).index().rate == 30
    for value in (0, -30.0, np.nan, "fast"):
        with h5py.File(path, "a") as file:
            file["data"].attrs["control_freq"] = value
        with raises(ValueError, path, "control_freq", "control steps per second"):
            RobomimicDemonstrations(path).index()
    with h5py.File(path, "a") as file:
        del file["data"].attrs["control_freq"]
    assert RobomimicDemonstrations(path).index().rate is None


def test_files_without_rewards(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path)
    with_rewards = RobomimicDemonstrations(path).steps()
    with h5py.File(path, "a") as file:
        del file["data/demo_1/rewards"]
    unreadable(path, "data/demo_1", "data/demo_0", "'rewards'")
    with h5py.File(path, "a") as file:
        for number in (0, 2):
            del file[f"data/demo_{number}/rewards"]
    data = RobomimicDemonstrations(path).steps()
    assert not data["next", "reward"].any() and not data["next", "terminated"].any()
    assert torch.equal(data["next", "truncated"], data["next", "done"])
    for key in ("observation", "action", "episode", ("next", "done")):
        assert torch.equal(data[key], with_rewards[key])


@pytest.mark.parametrize(
    ("kwargs", "solved"),
    [({}, [False, True]), ({"reward_scale": 2.0}, [False, False]), ({"reward_scale": None}, [False, False])],
)
def test_a_shaped_reward_is_no_success_before_its_scale(tmp_path, kwargs, solved):
    path, env_args = tmp_path / "file.hdf5", env_args_15("square")
    env_args["env_kwargs"] |= {"reward_shaping": True, **kwargs}
    write_robomimic_file(path, lengths=(4, 3), env_args=env_args)
    with h5py.File(path, "a") as file:
        file["data/demo_0/rewards"][...] = [0.1, 0.2, 0.5, 0.9]
        file["data/demo_1/rewards"][...] = [0.1, 0.5, 1.0]
    data = RobomimicDemonstrations(path).steps()
    assert data["next", "terminated"][[3, 6], 0].tolist() == solved
    assert not (data["next", "terminated"] & data["next", "truncated"]).any()


def test_a_raw_recording_of_robosuite(tmp_path):
    path = tmp_path / "demo.hdf5"
    write_robomimic_file(path)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            del demo["obs"], demo["rewards"], demo["dones"]
    unreadable(path, "data/demo_0", "'obs'", "states")
    with h5py.File(path, "a") as file:
        del file["data"].attrs["env_args"], file["data"].attrs["total"]
        file["data"].attrs["env"] = "NutAssemblySquare"
    unreadable(path, "'obs'", "states", "observe")


def test_a_file_that_another_process_writes(square_file):
    path, _ = square_file
    code = f"import h5py, sys; f = h5py.File({str(path)!r}, 'a'); print('open', flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as other:
        assert other.stdout.readline() == "open\n"
        unreadable(path, "HDF5_USE_FILE_LOCKING")
        other.stdin.close()
    RobomimicDemonstrations(path).index()


def test_a_flipped_bit_in_a_name(square_file):
    """HDF5 then has two demos of a name, and gives the first for both."""
    path, _ = square_file
    # Of the heap of names; masks come after it.
    path.write_bytes(path.read_bytes().replace(b"demo_1\0", b"demo_0\0", 1))
    with h5py.File(path) as file:
        assert list(file["data"]).count("demo_0") == 2
    unreadable(path, "'demo_0'")


def test_a_demo_that_the_file_counts_and_does_not_hold(square_file):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        del file["data/demo_1"]
    unreadable(path, "data.attrs['total'] counts 47", 42)
    assert (
        len(RobomimicDemonstrations(path, mask="train").index().demos)
        == len(RobomimicDemonstrations(path, demos=2).index().demos)
        == 2
    )
    with h5py.File(path, "a") as file:
        file["data/demo_0"].attrs["num_samples"] = 10  # the others are padding
    unreadable(path, "data/demo_0.attrs['num_samples'] counts 10", 12, demos=1)
    with h5py.File(path, "a") as file:
        del file["data/demo_0"].attrs["num_samples"]
        file["data"].attrs["total"] = "many"
    unreadable(path, "data.attrs['total']")
    with h5py.File(path, "a") as file:
        del file["data"].attrs["total"]
    assert len(RobomimicDemonstrations(path).index().demos) == 2


def test_what_is_no_file_or_not_whole(square_file, tmp_path):
    path, _ = square_file
    for place, error in ((tmp_path / "absent.hdf5", FileNotFoundError), (tmp_path, IsADirectoryError)):
        with raises(error, place):
            RobomimicDemonstrations(place).index()
        refuses(RobomimicDemonstrations(place).check, FileNotFoundError, place)
    whole = path.read_bytes()
    parts = [whole[: int(keep * len(whole))] for keep in (0.0, 0.001, 0.5, 0.99)]
    far = whole[:50] + bytes(6) + whole[56:]  # the undefined address of the driver becomes 65,535
    for content in (*parts, far, b"<html>please log in"):
        path.write_bytes(content)
        unreadable(path, "HDF5")


def test_filter_keys(square_file, tmp_path):
    path, _ = square_file
    with raises(DatasetError, "'better'", "empty, train, valid"):
        RobomimicDemonstrations(path, mask="better").index()
    refuses(lambda: RobomimicDemonstrations(path, mask="empty").index(), DatasetError, "mask/empty")
    with h5py.File(path, "a") as file:
        del file["data/demo_2"]
    refuses(lambda: RobomimicDemonstrations(path, mask="train").index(), DatasetError, "mask/train", "demo_2")
    bare = tmp_path / "bare.hdf5"
    write_robomimic_file(bare)
    refuses(lambda: RobomimicDemonstrations(bare, mask="train").index(), DatasetError, "'train'", "none")


def test_corrupt_values(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        dataset = file.create_dataset(
            "data/demo_0/actions", data=np.zeros((12, 7)), chunks=(12, 7), fletcher32=True
        )
        offset = dataset.id.get_chunk_info(0).byte_offset
    with path.open("r+b") as raw:
        raw.seek(offset)
        raw.write(b"\x01\x02\x03")
    RobomimicDemonstrations(path).index()
    with h5py.File(path) as file, raises(DatasetError, "data/demo_0/actions"):
        RobomimicReader(file).numbers("demo_0", "actions", np.empty((12, 7)))


def test_what_only_some_demonstrations_have_is_left_out_by_name(square_file):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        file["data/demo_2/obs/force"] = np.ones((len(file["data/demo_2/actions"]), 2))
        del file["data/demo_1/obs/robot0_eef_vel_lin"]
    left = {"": ["force", "robot0_eef_vel_lin"], "images": ["agentview_image"]}
    assert open_demonstrations(path).index().left_out == left
    assert open_demonstrations(path, demos=1).index().left_out == {
        "images": ["agentview_image"],
        "observations": ["robot0_eef_vel_lin"],
    }
    for key in left[""]:
        with raises(DatasetError, f"{key!r}"):
            open_demonstrations(path).index([key])
