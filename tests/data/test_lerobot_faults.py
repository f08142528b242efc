"""Damaged, incomplete and unfitting LeRobotDatasets: refused by file and key, with what to do."""

from __future__ import annotations

import json
import shutil

import pyarrow.parquet as pq
import pytest

pytest.importorskip("lerobot")

from tests.data.lerobot_parts import edit_json, edit_table, write_lerobot
from tests.data.synthetic import env_args_15
from warmprior.data import DatasetError, LeRobotExperienceReplay, lerobot_steps
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
    "v2": (
        info(lambda i: i.update(codebase_version="v2.1")),
        ["2.1", "convert_dataset_v21_to_v30"],
    ),
    "no JSON": (cut("meta/info.json"), ["LeRobot cannot read", "again"]),
    "files elsewhere": (
        info(lambda i: i.update(data_path="../{chunk_index:03d}/{file_index:03d}.parquet")),
        ["info.json names '../000/000.parquet'", "not in the folder"],
    ),
    "an episode less": (
        info(lambda i: i.update(total_episodes=i["total_episodes"] + 1)),
        ["meta/info.json counts", "and meta/episodes"],
    ),
    "no tasks": (without("meta/tasks.parquet"), ["no meta/tasks.parquet", "finalize()"]),
    "no episodes": (without(EPISODES), ["no meta/episodes/*/*.parquet", "finalize()"]),
    "cut-off episodes": (cut(EPISODES), ["LeRobot cannot read", "again"]),
    "other fps": (info(lambda i: i.update(fps=30)), ["fps is 30", "Lift", "20 Hz", "resample"]),
    "no action": (
        info(lambda i: i["features"].update({"act": i["features"].pop("action")})),
        ["no feature 'action'", "'act': 7"],
    ),
    "wide action": (feature("action", shape=[8]), ["'action' has 8 columns", "Lift takes 7"]),
    "joints": (
        feature("action", names={"motors": [f"joint_{i}" for i in range(7)]}),
        ["actions of Lift are robot0_x, robot0_y", "named joint_0, joint_1", "to null"],
    ),
    "other state": (
        feature("observation.state", shape=[8]),
        ["'observation.state': 8", "'observation.state': 19", "'observation.state': 9"],
    ),
    "other names of the state": (
        feature("observation.state", names=[f"joint_{i}" for i in range(9)]),
        ["observation.state in Lift are robot0_eef_pos_0", "named joint_0"],
    ),
    "no JSON of ours": (description("{"), ["warmprior.json is not valid JSON"]),
    "description of the future": (description('{"format": 2}'), ["warmprior.json", "version"]),
    "no environment": (
        description('{"format": 1, "observations": {}}'),
        ["warmprior.json: env_args lacks env_name"],
    ),
    "another environment": (
        described(env_args={"env_name": "Stack", "env_kwargs": {}}, observations=STATE),
        ["the dataset was recorded in Stack, not in Lift"],
    ),
    "other columns": (
        described(observations={"object": ["observation.state", 3, 13]}),
        ["warmprior.json: observations['object']", "observation.state", "convert"],
    ),
}


@pytest.mark.parametrize("name", META)
def test_meta_is_checked_before_anything_is_read(root, name, monkeypatch):
    change, said = META[name]
    change(root)
    monkeypatch.setattr("warmprior.data.lerobot.LeRobotReader", lambda i: pytest.fail("was read"))
    with pytest.raises(DatasetError) as caught:
        LeRobotExperienceReplay(root, env_args=LIFT)
    for word in [str(root), *said]:
        assert word in str(caught.value)


PLACE = ["damaged, or not of this dataset", "is not where meta/episodes says", "finalize()"]
VALUES = {
    "cut off": (cut(DATA), ["damaged", "finalize()", "again"]),
    "empty": (cut(DATA, 0), ["damaged"]),
    "missing": (without(DATA), ["damaged"]),
    "NaN": (
        table(DATA, action=entry(8, float("nan"))),
        ["action of episode 2 has NaN or infinity in row 1", "Record"],
    ),
    "infinity": (
        table(DATA, observation__state=entry(6, float("inf"))),
        ["observation.state (robot0_eef_pos) of episode 1 has NaN or infinity in row 0"],
    ),
    "huge": (
        table(DATA, observation__environment_state=entry(1, 1e20)),
        ["observation.environment_state (object) of episode 0 has a value beyond 1e+09 in row 1"],
    ),
    "empty entry": (table(DATA, action=entry(3, None)), ["action of episode 0 has NaN"]),
    "empty row": (table(DATA, action=entry(3, None, None)), ["damaged"]),
    "other episodes": (table(DATA, episode_index=entry(6, 0, None)), PLACE),
    "other order": (table(DATA, index=lambda values: values[::-1]), PLACE),
    "fewer rows": (
        lambda root: pq.write_table(pq.read_table(root / DATA).slice(0, 12), root / DATA),
        PLACE,
    ),
    "other meta": (table(EPISODES, dataset_from_index=entry(1, 5, None)), PLACE),
    "no column": (
        lambda root: pq.write_table(pq.read_table(root / DATA).drop(["action"]), root / DATA),
        ["damaged", "action"],
    ),
    "narrow rows": (
        lambda root: (
            feature("observation.environment_state", shape=[5])(root),
            feature("observation.state", shape=[14])(root),
        ),
        ["damaged"],
    ),
}


@pytest.mark.parametrize("name", VALUES)
def test_bad_values_stop_the_load(root, name):
    change, said = VALUES[name]
    change(root)
    with pytest.raises(DatasetError) as caught:
        LeRobotExperienceReplay(root, env_args=None if name == "narrow rows" else LIFT)
    for word in [str(root / DATA), *said]:
        assert word in str(caught.value)


def test_steps_are_refused_as_well(root):
    with pytest.raises(DatasetError, match=r"has no vector 'observation\.side' of numbers"):
        lerobot_steps(root, ("observation.side",))
    table(DATA, **{"observation.state": entry(3, float("nan"))})(root)
    with pytest.raises(DatasetError, match=r"observation\.state is not finite at step 3"):
        lerobot_steps(root)
    cut(DATA)(root)
    with pytest.raises(DatasetError, match=rf"{DATA}: damaged"):
        lerobot_steps(root)
    with pytest.raises(FileNotFoundError, match="no LeRobotDataset"):
        lerobot_steps(root / "nowhere")


IMAGES = {
    "missing camera": (
        "front_image",
        None,
        ["no images 'front_image'", "agentview_image", "--images"],
    ),
    "not square": ("agentview_image", feature(CAMERA, shape=[32, 16, 3]), ["only square"]),
    "no colours": ("agentview_image", feature(CAMERA, shape=[32, 32, 1]), ["shape (32, 32, 1)"]),
    "depth": (
        "agentview_image",
        feature(CAMERA, info={"is_depth_map": True}),
        ["no images 'agentview_image'"],
    ),
    "other size": (
        "agentview_image",
        feature(CAMERA, shape=[16, 16, 3]),
        [DATA, CAMERA, "(3, 32, 32)", "(3, 16, 16)"],
    ),
    "damaged picture": (
        "agentview_image",
        table(DATA, **{CAMERA.replace(".", "__"): entry(7, b"no picture", "bytes")}),
        [f"{DATA}: damaged"],
    ),
    "picture elsewhere": (
        "agentview_image",
        table(DATA, **{CAMERA.replace(".", "__"): entry(7, None, "bytes")}),
        [f"{DATA}: damaged"],
    ),
    "cut-off video": (
        "side_image",
        cut("videos/observation.images.side/chunk-000/file-000.mp4"),
        ["file-000.mp4: damaged"],
    ),
    "other times": (
        "side_image",
        table(
            EPISODES,
            **{"videosSLASHobservation__images__sideSLASHfrom_timestamp": entry(2, 9.0, None)},
        ),
        ["file-000.mp4: damaged"],
    ),
    "several sizes": (
        ("agentview_image", "side_image"),
        feature(CAMERA, shape=[16, 16, 3]),
        ["several sizes"],
    ),
}


@pytest.mark.parametrize("name", IMAGES)
def test_bad_images_are_named(root, name):
    keys, change, said = IMAGES[name]
    if change is not None:
        change(root)
    keys = [keys] if isinstance(keys, str) else keys
    with pytest.raises(DatasetError) as caught:
        LeRobotExperienceReplay(root, env_args=LIFT, image_keys=keys)
    for word in [str(root), *said]:
        assert word in str(caught.value)


def test_bad_options(root):
    with pytest.raises(ValueError, match="'disk'"):
        LeRobotExperienceReplay("user/never-fetched", storage="disk")
    with pytest.raises(FileNotFoundError, match=r"no meta/info\.json there"):
        LeRobotExperienceReplay(root / "absent")
    with pytest.raises(DatasetError, match="there are 3 demonstrations, fewer than the 4"):
        LeRobotExperienceReplay(root, demos=4)
    with pytest.raises(ValueError, match="demos must be at least 1, got 0"):
        LeRobotExperienceReplay(root, demos=0)
    with pytest.raises(DatasetError, match="there is no observation 'nothing' among"):
        LeRobotExperienceReplay(root, observation_keys=["nothing"])
    with pytest.raises(DatasetError, match="no observations are chosen"):
        LeRobotExperienceReplay(root, observation_keys=[])
    with pytest.raises(DatasetError, match="unknown filter key 'train'; this dataset has none"):
        LeRobotExperienceReplay(root, filter_key="train")
    with pytest.raises(DatasetError, match="no observation 'robot0_eef_pos'"):
        read_lerobot_index(root, poses=True)
    # Poses that are none: random numbers where a quaternion should be.
    with pytest.raises(DatasetError, match=r"robot0_eef_quat\) of episode 0 is no rotation in row"):
        LeRobotExperienceReplay(root, env_args=LIFT, absolute_actions=True)
