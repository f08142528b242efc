"""robomimic's files as LeRobotDatasets: LeRobot reads them, and so do we, with the same values."""

import json

import h5py
import numpy as np
import pytest
import torch

pytest.importorskip("lerobot")

from tests.data.lerobot_parts import scene
from tests.data.synthetic import env_args_14, env_args_15, write_robomimic_file
from tests.errors import raises, refuses
from warmprior.data import DatasetError, convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.lerobot import LeRobotDemonstrations


def with_images(path):
    with h5py.File(path, "a") as file:
        for number, demo in enumerate(file["data"].values()):
            demo["obs"].pop("agentview_image", None)
            images = [scene(number, step) for step in range(len(demo["actions"]))]
            for camera in ("agentview", "robot0_eye_in_hand"):
                demo[f"obs/{camera}_image"] = np.stack(images)
    return path


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    path = folder / "transport.hdf5"
    masks, env_args = {"train": [2, 0], "valid": [1]}, env_args_14("transport")
    written = {"lengths": (6, 1, 9), "masks": masks, "failures": (1,), "env_args": env_args}
    write_robomimic_file(path, task="transport", **written)
    with_images(path)
    return path, {kind: convert_robomimic(path, folder / kind, images=kind) for kind in ("image", "video")}


def equal(mine, theirs):
    keys = set(mine.keys(True, True))
    assert keys == set(theirs.keys(True, True))
    assert all(mine[key].dtype == theirs[key].dtype for key in keys)
    return [key for key in keys if not torch.equal(mine[key], theirs[key])]


OPTIONS = [
    {},
    {"mask": "train", "demos": 1},
    {"observations": ["robot1_eef_pos", "object"]},
    {"images": ["robot0_eye_in_hand_image", "agentview_image"], "storage": "memmap"},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_both_buffers_hold_the_same(converted, options):
    path, folders = converted
    opening = {name: value for name, value in options.items() if name in ("mask", "demos")}
    read = {name: value for name, value in options.items() if name not in opening}
    both = RobomimicDemonstrations(path, **opening), LeRobotDemonstrations(folders["image"], **opening)
    theirs, mine = (demonstrations.steps(**read) for demonstrations in both)
    assert not equal(mine, theirs)
    seen = {name: value for name, value in read.items() if name in ("observations", "images")}
    theirs, mine = (demonstrations.index(**seen) for demonstrations in both)
    for name in ("env_args", "task", "observation_keys", "image_size"):
        assert getattr(mine, name) == getattr(theirs, name)


def test_lerobot_reads_what_was_converted(converted):
    from lerobot.datasets import LeRobotDataset

    path, folders = converted
    data = RobomimicDemonstrations(path).steps()
    for kind, folder in folders.items():
        dataset = LeRobotDataset("local/test", root=folder)
        assert dataset.fps == 20 and dataset.num_episodes == 3 and len(dataset) == 16
        assert dataset.meta.stats["action"]["count"].item() == 16
        names = dataset.meta.features["action"]["names"]
        assert names[:2] == ["robot0_x", "robot0_y"] and names[13] == "robot1_gripper"
        with h5py.File(path) as file:
            images = np.concatenate([d["obs/agentview_image"] for d in file["data"].values()])
        for i in range(16):
            item = dataset[i]
            assert torch.equal(item["action"], data["action"][i])
            state = (item["observation.environment_state"], item["observation.state"])
            assert torch.equal(torch.cat(state), data["observation"][i])
            assert item["next.reward"] == data["next", "reward"][i]
            assert item["next.success"] == (data["next", "reward"][i] > 0)
            assert item["next.done"] == data["next", "done"][i]
            assert item["episode_index"] == data["episode"][i] and item["task"] == "transport"
            shown = item["observation.images.agentview"].permute(1, 2, 0) * 255
            off = (shown - torch.from_numpy(images[i])).abs()
            assert off.max() < 1e-4 if kind == "image" else off.mean() < 8


def test_an_interrupted_conversion_leaves_nothing(converted, tmp_path, monkeypatch):
    from lerobot.datasets import LeRobotDataset

    path, _ = converted
    save, saved = LeRobotDataset.save_episode, []

    def interrupted(dataset, *args, **options):
        if saved:
            raise KeyboardInterrupt
        saved.append(save(dataset, *args, **options))

    folder = tmp_path / "out" / "data"
    with monkeypatch.context() as patch:
        patch.setattr(LeRobotDataset, "save_episode", interrupted)
        with pytest.raises(KeyboardInterrupt):
            convert_robomimic(path, folder)
    assert saved and not list(folder.parent.iterdir())
    # A killed process cannot tidy up: what it left is not continued, and not in the way.
    left = folder.parent / ".data.converting" / "data" / "meta"
    left.mkdir(parents=True)
    (left / "info.json").write_text("{")
    assert convert_robomimic(path, folder) == folder
    assert len(LeRobotDemonstrations(folder).steps()) == 16
    assert [p.name for p in folder.parent.iterdir()] == ["data"]


@pytest.mark.parametrize("rewards", ["shaped", "zero", "none"])
def test_what_rewards_do_not_say_is_not_written(tmp_path, rewards):
    from lerobot.datasets import LeRobotDataset

    path, env_args = tmp_path / "lift.hdf5", env_args_15("lift")
    env_args["env_kwargs"]["reward_shaping"] = rewards == "shaped"
    write_robomimic_file(path, task="lift", lengths=(4, 3), env_args=env_args)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            steps = len(demo["actions"])
            del demo["rewards"]
            if rewards != "none":
                demo["rewards"] = np.linspace(0.4, 1.0, steps) if rewards == "shaped" else np.zeros(steps)
    dataset = LeRobotDataset("local/test", root=convert_robomimic(path, tmp_path / "out"))
    written = {"next.reward", "next.success"} & set(dataset.features)
    assert written == ({"next.reward", "next.success"} if rewards == "shaped" else set())
    if rewards == "shaped":
        assert [i for i in range(7) if dataset[i]["next.success"]] == [3, 6]
    mine = LeRobotDemonstrations(tmp_path / "out").steps()
    assert not equal(mine, RobomimicDemonstrations(path).steps())


def test_a_mask_that_names_no_episode(converted, tmp_path):
    path, _ = converted
    folder = convert_robomimic(path, tmp_path / "out", demos=1)  # the mask valid is of the second
    refuses(lambda: LeRobotDemonstrations(folder, mask="valid").steps(), DatasetError, "out", "mask", "valid")


def test_a_file_of_joints_has_no_names_of_poses(tmp_path):
    """Seven joints, and no gripper, are as wide as a pose delta and the gripper."""
    path, env_args = tmp_path / "lift.hdf5", env_args_15("lift")
    parts = env_args["env_kwargs"]["controller_configs"]["body_parts"]
    parts["right"] = {"type": "JOINT_POSITION", "input_type": "absolute", "gripper": {"type": "GRIP"}}
    write_robomimic_file(path, task="lift", env_args=env_args)
    seen = ["robot0_gripper_qpos", "object"]
    converted = convert_robomimic(path, tmp_path / "out", observations=seen)
    features = json.loads((converted / "meta" / "info.json").read_text())["features"]
    assert features["action"]["names"] is None
    mine = LeRobotDemonstrations(converted).steps(observations=seen)
    assert not equal(mine, RobomimicDemonstrations(path).steps(observations=seen))


def test_images_of_a_size_that_no_policy_sees_are_copied_as_they_are(tmp_path):
    path, shown = tmp_path / "lift.hdf5", np.random.default_rng(0).integers(0, 256, (3, 7, 7, 3), np.uint8)
    write_robomimic_file(path, task="lift", lengths=(3,))
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs/agentview_image"]
        file["data/demo_0/obs/agentview_image"] = shown
    convert_robomimic(path, tmp_path / "out", images="image")
    place = LeRobotDemonstrations(tmp_path / "out")
    index = place.index(images=["agentview_image"])
    with place.reader(index) as reader:
        (found,) = reader.images(index.demos[0], "agentview_image")
    assert (found.permute(0, 2, 3, 1).numpy() == shown).all()


def test_what_cannot_be_converted(tmp_path):
    path, folder = tmp_path / "lift.hdf5", tmp_path / "out"
    refuses(lambda: convert_robomimic(path, folder), FileNotFoundError, path)
    write_robomimic_file(path, task="lift", lengths=(3,))
    with raises(ValueError, "images", "image, video", "'gif'"):
        convert_robomimic(path, folder, images="gif")
    refuses(lambda: convert_robomimic(path, folder, images="video"), ValueError, 32, 8)
    refuses(lambda: convert_robomimic(path, tmp_path), FileExistsError, tmp_path)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs/agentview_image"]
        file["data/demo_0/obs/robot0_eef_pos"][1] = np.nan
    refuses(lambda: convert_robomimic(path, folder, images="image"), DatasetError, "no images")
    with raises(DatasetError, "demo_0/obs/robot0_eef_pos", "nan", "row 1"):
        convert_robomimic(path, folder)
    env_args = env_args_15("lift")
    env_args["env_kwargs"]["control_freq"] = 12.5
    write_robomimic_file(path, task="lift", lengths=(3,), env_args=env_args)
    refuses(lambda: convert_robomimic(path, folder), DatasetError, "control_freq", 12.5)
    with h5py.File(path, "a") as file:
        del file["data"].attrs["env_args"]
    refuses(lambda: convert_robomimic(path, folder), DatasetError, "lift.hdf5", "env_args")
    assert [p.name for p in tmp_path.iterdir()] == ["lift.hdf5"]
