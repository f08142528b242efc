from __future__ import annotations

import h5py
import numpy as np
import pytest

from tests.data.synthetic import env_args_15, write_robomimic_file
from warmprior.data.hdf5 import RobomimicReader, read_index
from warmprior.data.replay import DatasetError


def test_long_demos_are_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("warmprior.data.hdf5.BLOCK", 7)
    path = tmp_path / "file.hdf5"
    (demo,) = write_robomimic_file(path, lengths=(40,))
    with h5py.File(path) as file:
        out = np.empty((40, 7), np.float32)
        RobomimicReader(file).numbers("demo_0", "actions", out)
        part = np.empty((9, 7), np.float32)
        RobomimicReader(file).numbers("demo_0", "actions", part, first=20)
    np.testing.assert_array_equal(out, demo["actions"].astype(np.float32))
    np.testing.assert_array_equal(part, demo["actions"][20:29].astype(np.float32))


def test_the_first_demos_are_those_of_the_smallest_numbers(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, lengths=range(1, 13), masks={"late": [11, 3, 10]})
    assert read_index(path, demos=11).demos == tuple(f"demo_{n}" for n in range(11))
    assert read_index(path, demos=2, filter_key="late").demos == ("demo_3", "demo_10")
    with pytest.raises(DatasetError, match=r"file\.hdf5: .*12 demonstrations.*demos=13"):
        read_index(path, demos=13)
    with pytest.raises(ValueError, match=r"demos must be .*at least 1, got 0"):
        read_index(path, demos=0)


def test_unknown_environment_uses_what_it_finds(tmp_path):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, task="transport", env_args=env_args_15("lift") | {"env_name": "Own"})
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            del demo["obs/robot1_eef_quat"]
    index = read_index(path)
    assert index.task is None and index.action_dim == 14
    assert index.observation_keys == (
        *("object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"),
        *("robot1_eef_pos", "robot1_gripper_qpos"),
    )

    for nothing in [], ():
        with pytest.raises(
            DatasetError, match=r"file\.hdf5: no observations are chosen.*observation_keys.*robot0_eef_pos"
        ):
            read_index(path, observation_keys=nothing)


# ---------------------------------------------------------------------------- bad files
def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.hdf5: no such file"):
        read_index(tmp_path / "absent.hdf5")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_index(tmp_path)  # a folder


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.99, None])
def test_truncated_file(square_file, keep):
    path, _ = square_file
    content = path.read_bytes()
    path.write_bytes(b"<html>please log in" if keep is None else content[: int(keep * len(content))])
    with pytest.raises(DatasetError, match=r"square\.hdf5: not a readable HDF5.*again"):
        read_index(path)


def test_filter_keys(square_file, tmp_path):
    path, _ = square_file
    with pytest.raises(DatasetError, match=r"filter key 'better'.*empty, train, valid"):
        read_index(path, filter_key="better")
    with pytest.raises(DatasetError, match="mask/empty names no demos"):
        read_index(path, filter_key="empty")
    with h5py.File(path, "a") as file:
        del file["data/demo_2"]
    with pytest.raises(DatasetError, match=r"mask/train names .*demo_2"):
        read_index(path, filter_key="train")
    bare = tmp_path / "bare.hdf5"
    write_robomimic_file(bare)
    with pytest.raises(DatasetError, match=r"'train'.* none"):
        read_index(bare, filter_key="train")


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
    read_index(path)
    with h5py.File(path) as file, pytest.raises(DatasetError, match=r"data/demo_0/actions cannot be read"):
        RobomimicReader(file).numbers("demo_0", "actions", np.empty((12, 7)))
