"""Damaged, incomplete and unfitting LeRobotDatasets: refused by file and key, with what to do."""

from __future__ import annotations

import json
import shutil

import pytest

pytest.importorskip("lerobot")

from tests.data.lerobot_parts import edit_json, edit_table, write_lerobot
from tests.data.synthetic import env_args_15
from warmprior.data import DatasetError, LeRobotDemonstrations
from warmprior.data.lerobot_index import read_lerobot_index

LIFT = env_args_15("lift")
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
CAMERA = "observation.images.agentview"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole") / "lift"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        write_lerobot(root, images=(("agentview", "image"), ("side", "video")))
    return root


@pytest.fixture
def root(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "lift")


def info(change):
    return lambda root: edit_json(root / "meta" / "info.json", change)


def feature(name, **values):
    return info(lambda content: content["features"][name].update(values))


def table(file, **columns):
    return lambda root: edit_table(root / file, **columns)


def cut(file, share=0.5):
    def change(root):
        content = (root / file).read_bytes()
        (root / file).write_bytes(content[: int(share * len(content))])

    return change


def without(file):
    return lambda root: (root / file).unlink()


def entry(row, value, column=2):
    def change(values):
        if column is None:
            values[row] = value
        else:
            values[row][column] = value
        return values

    return change


def description(content):
    return lambda root: (root / "meta" / "warmprior.json").write_text(content)


def described(**content):
    return description(json.dumps(ALIEN | content))


ALIEN = {"format": 1, "env_args": {"env_name": "Lift", "env_kwargs": {}}}
STATE = {"object": ["observation.environment_state", 0, 10]}

META = {
    "v2": (info(lambda i: i.update(codebase_version="v2.1")), ["2.1", "convert_dataset_v21_to_v30"]),
    "no JSON": (cut("meta/info.json"), ["LeRobot cannot read", "again"]),
    "no episodes": (without(EPISODES), ["no meta/episodes/*/*.parquet", "finalize()"]),
    "other fps": (info(lambda i: i.update(fps=30)), ["fps is 30", "Lift", "20 Hz", "resample"]),
    "no action": (
        info(lambda i: i["features"].update({"act": i["features"].pop("action")})),
        ["no vector of numbers 'action'", "task_index, act"],
    ),
    "joints": (
        feature("action", names={"motors": [f"joint_{i}" for i in range(7)]}),
        ["actions of Lift are robot0_x, robot0_y", "joint_0, joint_1", "to null"],
    ),
    "another environment": (
        described(env_args={"env_name": "Stack", "env_kwargs": {}}, observations=STATE),
        ["recorded in Stack, not in Lift", "env_args"],
    ),
    "other columns": (
        described(observations={"object": ["observation.state", 3, 13]}),
        ["warmprior.json: observations['object']", "observation.state", "convert"],
    ),
}


PLACE = ["damaged, or not of this dataset", "is not where meta/episodes says", "finalize()"]
VALUES = {
    "cut off": (cut(DATA), ["damaged", "finalize()", "again"]),
    "NaN": (
        table(DATA, action=entry(8, float("nan"))),
        ["action of episode 2", "nan in row 1", "Record"],
    ),
    "other episodes": (table(DATA, episode_index=entry(6, 0, None)), PLACE),
}


IMAGES = {
    "missing camera": (
        lambda root: None,
        ["no images 'front_image'", "agentview_image"],
        "front_image",
    ),
    "not square": (feature(CAMERA, shape=[32, 16, 3]), ["only square"], "agentview_image"),
    "other size": (
        feature(CAMERA, shape=[16, 16, 3]),
        [DATA, CAMERA, "3, 32, 32]", "3, 16, 16]"],
        "agentview_image",
    ),
    "cut-off video": (
        cut("videos/observation.images.side/chunk-000/file-000.mp4"),
        ["file-000.mp4: damaged"],
        "side_image",
    ),
}


@pytest.mark.parametrize("name", [*META, *VALUES, *IMAGES])
def test_what_is_damaged_or_does_not_fit_is_named(root, name, monkeypatch):
    """What ``meta/`` tells before anything is read, values with their file, and images."""
    change, said, *keys = (META | VALUES | IMAGES)[name]
    change(root)
    if name in META:
        monkeypatch.setattr("warmprior.data.lerobot.LeRobotReader", lambda i: pytest.fail("was read"))
    with pytest.raises(DatasetError) as caught:
        LeRobotDemonstrations(root, env_args=LIFT, image_keys=keys)
    for word in [str(root / DATA if name in VALUES else root), *said]:
        assert word in str(caught.value)


def test_bad_options(root):
    with pytest.raises(ValueError, match="'disk'"):
        LeRobotDemonstrations(root, storage="disk")
    with pytest.raises(FileNotFoundError, match=r"no meta/info\.json there"):
        LeRobotDemonstrations(root / "absent")
    with pytest.raises(DatasetError, match=r"3 demonstrations.*demos=4"):
        LeRobotDemonstrations(root, demos=4)
    with pytest.raises(ValueError, match=r"demos must be .*at least 1, got 0"):
        LeRobotDemonstrations(root, demos=0)
    with pytest.raises(DatasetError, match=r"no observation 'nothing'.*observation.state"):
        LeRobotDemonstrations(root, observation_keys=["nothing"])
    with pytest.raises(DatasetError, match=r"'observation\.images\.side' is an image.*image_keys"):
        LeRobotDemonstrations(root, observation_keys=["observation.images.side"])
    with pytest.raises(DatasetError, match="no observations are chosen"):
        LeRobotDemonstrations(root, observation_keys=[])
    with pytest.raises(DatasetError, match=r"filter key 'train'.* none"):
        LeRobotDemonstrations(root, filter_key="train")
    with pytest.raises(DatasetError, match="no observation 'robot0_eef_pos'"):
        read_lerobot_index(root, poses=True)
    # Poses that are none: random numbers where a quaternion should be.
    with pytest.raises(DatasetError, match=r"robot0_eef_quat\) of episode 0 is no rotation in row"):
        LeRobotDemonstrations(root, env_args=LIFT, absolute_actions=True)
