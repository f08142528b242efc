import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("lerobot")


from tests.data.lerobot_parts import WIDTHS, numbers, scene, write_lerobot
from tests.data.synthetic import env_args_15
from warmprior import PastPrior, window_replay_buffer
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.lerobot_index import action_names, state_names
from warmprior.envs.robosuite_tasks import TASKS

H, TO = 4, 3


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "lift"
    images = (("agentview", "image"), ("robot0_eye_in_hand", "video"))
    values = write_lerobot(root, images=images, data_files_size_in_mb=0.001)
    assert len(list(root.glob("data/*/*.parquet"))) > 1
    return root, values


def test_windows_are_those_of_delta_timestamps(written):
    from lerobot.datasets import LeRobotDataset

    root, _ = written
    deltas = {
        "action": [i / 20 for i in range(-H, H)],
        "observation.state": [i / 20 for i in range(1 - TO, 1)],
    }
    theirs = LeRobotDataset("local/test", root=root, delta_timestamps=deltas)
    data = LeRobotDemonstrations(root).steps(observations=["observation.state"])
    windows = window_replay_buffer(data, PastPrior(H), batch_size=8, observation_steps=TO)
    prior = PastPrior(H)
    assert len(data) == len(theirs) == 16
    for i in range(len(theirs)):
        item = theirs[i]
        row = windows[i]
        action, pad = item["action"], item["action_is_pad"]
        assert torch.equal(row["vla_action", "chunk"], action[H:])
        assert torch.equal(row["action_is_pad"], pad[H:])
        assert torch.equal(row["observation"], item["observation.state"])
        # The mean of the past is what LeRobot's history is where that is no padding, and cold elsewhere.
        source = prior.distribution(row["history"])
        assert source.warm.all() == (not pad[:H].any())
        if not pad[:H].any():
            assert torch.equal(source.loc, action[:H])
        assert item["episode_index"] == data["episode"][i]


def test_images_are_decoded_as_lerobot_does(written):
    from lerobot.datasets import LeRobotDataset

    root, _ = written
    keys = ["agentview_image", "robot0_eye_in_hand_image"]
    observation = LeRobotDemonstrations(root).steps(images=keys, storage="memmap")["observation"]
    theirs = LeRobotDataset("local/test", root=root)
    assert observation["state"].shape == (16, 19)
    for i in range(16):
        item, row = theirs[i], observation[i]
        for key in keys:
            image = item[f"observation.images.{key.removesuffix('_image')}"]
            assert torch.equal(row[key], (image * 255).round().byte())
    upright = torch.from_numpy(scene(2, 8)).permute(2, 0, 1)
    assert torch.equal(observation["agentview_image"][15], upright)
    off = observation["robot0_eye_in_hand_image"][15].float() - upright
    assert off.abs().mean() < 8  # a video is lossy


def test_a_decoder_is_looked_for_once_per_reader(written, monkeypatch):
    """LeRobot prints a page of tracebacks each time that it finds none of its first choice."""
    root, _ = written
    looked: list[str] = []
    for module in ("utils.import_utils", "datasets.video_utils"):
        name = f"lerobot.{module}.get_safe_default_video_backend"
        monkeypatch.setattr(name, lambda: looked.append("") or "pyav")
    monkeypatch.setattr("warmprior.data.formats.lerobot.DECODED", 3 * 32 * 32)  # a frame at once
    demonstrations = LeRobotDemonstrations(root)
    index = demonstrations.index(images=["robot0_eye_in_hand_image"])
    with demonstrations.reader(index) as reader:
        frames = [len(part) for demo in index.demos for part in reader.images(demo, index.image_keys[0])]
    assert sum(frames) == 16 and len(frames) > len(index.demos)
    assert len(looked) == 1


def test_images_of_another_decoder_are_decoded_anew(written, tmp_path, monkeypatch):
    """A video's decoder follows from what can be loaded, not only from versions; pictures have another."""
    from lerobot.datasets import video_utils

    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path))
    decode = video_utils.decode_video_frames

    def with_pyav(path, times, tolerance, backend, **options):
        return decode(path, times, tolerance, "pyav", **options)  # the other may be missing here

    monkeypatch.setattr(video_utils, "decode_video_frames", with_pyav)
    root, _ = written
    keys = ["agentview_image", "robot0_eye_in_hand_image"]
    for backend, files in (("pyav", 2), ("torchcodec", 3), ("pyav", 3)):
        name = "lerobot.utils.import_utils.get_safe_default_video_backend"
        monkeypatch.setattr(name, lambda backend=backend: backend)
        LeRobotDemonstrations(root).steps(images=keys, storage="memmap")
        assert len(list(tmp_path.rglob("*.bytes"))) == files


def test_cameras_whose_names_end_alike_are_told_apart(tmp_path):
    images = [("rgb.head", "image"), ("mask.head", "image"), ("wrist", "image")]
    write_lerobot(tmp_path / "data", (2,), images=images)
    cameras = [f"observation.images.{name}" for name, _ in images]
    keys = ("rgb.head_image", "mask.head_image", "wrist_image")
    for named in (keys, cameras):
        index = LeRobotDemonstrations(tmp_path / "data").index(images=named)
        assert index.image_keys == keys and list(index.images.values()) == cameras


KINDS = {"next.reward": numbers(1), "next.success": {"dtype": "bool", "shape": (1,), "names": None}}


@pytest.mark.parametrize("names", [["next.reward"], ["next.success"], [*KINDS]])
def test_rewards_are_those_of_the_dataset_and_success_ends_an_episode(tmp_path, names):
    """Recorded success tells the end, and no shaped reward beside it."""
    features = {name: numbers(w) for name, w in WIDTHS.items()} | {name: KINDS[name] for name in names}
    values = write_lerobot(tmp_path / "data", (4, 3, 5, 2), features)
    data = LeRobotDemonstrations(tmp_path / "data").steps()["next"]
    np.testing.assert_array_equal(data["reward"].numpy(), values[names[0]].astype(np.float32))
    last = [3, 6, 11, 13]
    won = torch.from_numpy(values[names[-1]] > 0)[last]
    assert torch.equal(data["terminated"][last], won) and torch.equal(data["truncated"][last], ~won)
    if len(names) == 2:
        assert not torch.equal(won, torch.from_numpy(values["next.reward"] > 0)[last])


LAYOUTS = {
    "two": {"observation.environment_state": 10, "observation.state": 9},
    "one": {"observation.state": 19},
    "each": {f"observation.{key}": width for key, width in TASKS["lift"].low_dim_widths.items()},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_observations_of_a_task_are_found_by_their_widths(tmp_path, layout):
    widths = LAYOUTS[layout] | {"action": 7}
    names = {"action": action_names(1)}
    if layout == "one":
        names["observation.state"] = state_names(TASKS["lift"].low_dim_widths)
    features = {name: numbers(width, names.get(name)) for name, width in widths.items()}
    values = write_lerobot(tmp_path / "data", features=features)
    demonstrations = LeRobotDemonstrations(tmp_path / "data", task=env_args_15("lift"))
    expected = np.concatenate([values[name] for name in LAYOUTS[layout]], -1)
    np.testing.assert_array_equal(demonstrations.steps()["observation"].numpy(), expected)
    assert demonstrations.index().observation_keys == TASKS["lift"].low_dim_keys


def test_features_of_width_1_and_of_truth_values(tmp_path):
    features = {
        "observation.state": numbers(1),
        "observation.gripper": {"dtype": "bool", "shape": (1,), "names": None},
        "observation.contacts": {"dtype": "bool", "shape": (3,), "names": None},
        "action": numbers(1),
    }
    values = write_lerobot(tmp_path / "data", features=features)
    names = list(features)[:-1]
    data = LeRobotDemonstrations(tmp_path / "data").steps(observations=names)
    expected = np.concatenate([values[name].astype(np.float32) for name in names], -1)
    np.testing.assert_array_equal(data["observation"].numpy(), expected)
    np.testing.assert_array_equal(data["action"].numpy(), values["action"])
