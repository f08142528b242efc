"""Damaged, incomplete and unfitting LeRobotDatasets: refused by file and key, with what to do."""

from __future__ import annotations

import shutil
import subprocess
import sys
import textwrap

import pyarrow.parquet as pq
import pytest

pytest.importorskip("lerobot")

from tests.data.lerobot_parts import edit_json, edit_table, write_lerobot
from tests.data.synthetic import env_args_15
from warmprior.data import DatasetError, LeRobotExperienceReplay
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


META = {
    "v2": (
        info(lambda i: i.update(codebase_version="v2.1")),
        ["v2.1", "convert_dataset_v21_to_v30"],
    ),
    "v4": (info(lambda i: i.update(codebase_version="v4.0")), ["v4.0", "Update"]),
    "no version": (info(lambda i: i.pop("codebase_version")), ["info.json", "codebase_version"]),
    "no JSON": (cut("meta/info.json"), ["info.json is not valid JSON", "again"]),
    "other fps": (info(lambda i: i.update(fps=30)), ["fps is 30", "Lift", "20 Hz", "resample"]),
    "no fps": (info(lambda i: i.pop("fps")), ["info.json: fps is missing"]),
    "no features": (info(lambda i: i.update(features=[])), ["info.json: features"]),
    "no shape": (feature("action", shape=None), ["info.json", "'action' has no dtype or shape"]),
    "no episodes": (info(lambda i: i.update(total_episodes=0)), ["info.json", "no episodes"]),
    "no action": (
        info(lambda i: i["features"].update({"act": i["features"].pop("action")})),
        ["info.json", "no feature 'action'", "act float32[7]", "rename"],
    ),
    "integer action": (feature("action", dtype="int64"), ["no feature 'action' that is a vector"]),
    "wide action": (feature("action", shape=[8]), ["'action' has 8 columns", "Lift takes 7"]),
    "joints": (
        feature("action", names={"motors": [f"joint_{i}" for i in range(7)]}),
        ["'action' is named joint_0, joint_1", "Lift takes robot0_x, robot0_y", "to null"],
    ),
    "named numbers": (
        feature("action", names={f"joint_{i}": i for i in range(7)}),
        ["'action' is named joint_0, joint_1"],
    ),
    "other state": (
        feature("observation.state", shape=[8]),
        ["observation.state of 8", "observation.environment_state of 10, observation.state of 9"],
    ),
    "other names of the state": (
        feature("observation.state", names=[f"joint_{i}" for i in range(9)]),
        ["'observation.state' is named joint_0", "Lift has robot0_eef_pos_0"],
    ),
    "no statistics": (
        without("meta/stats.json"),
        ["stats.json: there is no such file", "recompute_"],
    ),
    "no statistics of a key": (
        lambda root: edit_json(root / "meta/stats.json", lambda stats: stats.pop("action")),
        ["stats.json: it lacks 'action'", "recompute_stats"],
    ),
    "cut-off episodes": (cut(EPISODES), [EPISODES, "not a readable parquet file", "finalize()"]),
    "no files of episodes": (without(EPISODES), ["no meta/episodes/chunk-*", "finalize()"]),
    "missing episode": (
        info(lambda i: i.update(total_episodes=4)),
        ["meta/episodes", "not 0 to 3", "total_episodes"],
    ),
    "missing steps": (
        info(lambda i: i.update(total_frames=17)),
        ["meta/episodes", "episode 2 of length 9 goes from 7 to 16", "17"],
    ),
    "other length": (
        table(EPISODES, length=entry(1, 2, None)),
        ["episode 1 of length 2 goes from 6 to 7"],
    ),
    "overlap": (
        table(EPISODES, dataset_from_index=entry(1, 5, None)),
        ["episode 0 of length 6 goes from 0 to 6", "begins at 5"],
    ),
    "empty entries": (table(EPISODES, length=entry(1, None, None)), [EPISODES, "empty entries"]),
    "no data path": (info(lambda i: i.update(data_path="{episode}")), ["info.json", "{episode}"]),
    "a path of gigabytes": (
        info(lambda i: i.update(data_path="{chunk_index:09999999999d}")),
        ["info.json", "is no path of the format"],
    ),
    "a way in": (
        info(lambda i: i.update(data_path="{chunk_index.__class__}")),
        ["info.json", "is no path of the format"],
    ),
    "a way out": (
        info(lambda i: i.update(data_path="../{chunk_index}/{file_index}")),
        ["info.json", "leads out of the dataset"],
    ),
    "no JSON of ours": (description("{"), ["warmprior.json is not valid JSON"]),
    "description of the future": (description('{"format": 2}'), ["warmprior.json", "version"]),
    "no environment": (description('{"format": 1}'), ["warmprior.json: env_args lacks env_name"]),
    "no numbers in the state": (
        description(
            '{"format": 1, "env_args": {"env_name": "Lift", "env_kwargs": {}}, "first_state": ["a"], '
            '"observations": {"object": ["observation.environment_state", 0, 10]}}'
        ),
        ["warmprior.json: first_state is not what a conversion writes"],
    ),
    "another environment": (
        description(
            '{"format": 1, "env_args": {"env_name": "Stack", "env_kwargs": {}}, '
            '"observations": {"object": ["observation.environment_state", 0, 10]}}'
        ),
        ["warmprior.json: the dataset was recorded in Stack, not in Lift"],
    ),
    "no list of columns": (
        description(
            '{"format": 1, "env_args": {"env_name": "Lift", "env_kwargs": {}}, '
            '"observations": {"object": [["observation.state"], 0, 1]}}'
        ),
        ["warmprior.json: observations['object']", "convert"],
    ),
    "other columns": (
        description(
            '{"format": 1, "env_args": {"env_name": "Lift", "env_kwargs": {}}, '
            '"observations": {"object": ["observation.state", 3, 10]}}'
        ),
        ["warmprior.json: observations['object']", "observation.state", "convert"],
    ),
}


@pytest.mark.parametrize("name", META)
def test_meta_is_checked_before_anything_is_read(root, name, monkeypatch):
    change, said = META[name]
    change(root)
    monkeypatch.setattr(
        "warmprior.data.lerobot.open_lerobot", lambda index: pytest.fail("was read")
    )
    with pytest.raises(DatasetError) as caught:
        LeRobotExperienceReplay(root, env_args=LIFT)
    for word in [str(root), *said]:
        assert word in str(caught.value)


VALUES = {
    "cut off": (cut(DATA), [DATA, "not a readable parquet file", "finalize()", "again"]),
    "empty": (cut(DATA, 0), [DATA, "(0 bytes"]),
    "missing": (without(DATA), [DATA, "there is no such file"]),
    "NaN": (
        table(DATA, action=entry(8, float("nan"))),
        [f"{DATA}: action of episode 2 has NaN or infinity in row 1", "Record"],
    ),
    "infinity": (
        table(DATA, observation__state=entry(6, float("inf"))),
        ["observation.state (robot0_eef_pos) of episode 1 has NaN or infinity in row 0"],
    ),
    "damage": (
        table(DATA, observation__environment_state=entry(1, 1e20)),
        ["observation.environment_state (object) of episode 0 has a value beyond 1e+09 in row 1"],
    ),
    "empty entries": (table(DATA, action=entry(3, None)), [DATA, "action", "empty entries"]),
    "other episodes": (
        table(DATA, episode_index=entry(6, 0, None)),
        [DATA, "episode_index is 0 in step 0 of episode 1, but 1 by meta/episodes", "again"],
    ),
    "other order": (
        table(DATA, index=lambda values: values[::-1]),
        [DATA, "index is 15 in step 0 of episode 0, but 0"],
    ),
    "fewer rows": (
        lambda root: pq.write_table(pq.read_table(root / DATA).slice(0, 12), root / DATA),
        [DATA, "has 12 rows, but episode 2 ends at row 16"],
    ),
    "no column": (
        lambda root: pq.write_table(pq.read_table(root / DATA).drop(["action"]), root / DATA),
        [DATA, "no column 'action'"],
    ),
    "narrow rows": (
        lambda root: (
            feature("observation.environment_state", shape=[5])(root),
            feature("observation.state", shape=[14])(root),
        ),
        ["observation.environment_state of episode 0 does not have 5 numbers in every row"],
    ),
}


@pytest.mark.parametrize("name", VALUES)
def test_bad_values_stop_the_load(root, name):
    change, said = VALUES[name]
    change(root)
    env_args = None if name == "narrow rows" else LIFT
    with pytest.raises(DatasetError) as caught:
        LeRobotExperienceReplay(root, env_args=env_args)
    for word in [str(root), *said]:
        assert word in str(caught.value)


IMAGES = {
    "missing camera": (
        "front_image",
        None,
        ["no images 'front_image'", "agentview_image", "--images"],
    ),
    "not square": ("agentview_image", feature(CAMERA, shape=[32, 16, 3]), ["only square"]),
    "no colours": ("agentview_image", feature(CAMERA, shape=[32, 32, 1]), ["shape [32, 32, 1]"]),
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
        [f"{DATA}: {CAMERA} of episode 2 is damaged in row 0"],
    ),
    "picture elsewhere": (
        "agentview_image",
        table(DATA, **{CAMERA.replace(".", "__"): entry(7, None, "bytes")}),
        [f"{DATA}: {CAMERA} of episode 2 holds no picture itself in row 0"],
    ),
    "cut-off video": (
        "side_image",
        cut("videos/observation.images.side/chunk-000/file-000.mp4"),
        ["file-000.mp4: the frames of episode 0 cannot be decoded"],
    ),
    "other times": (
        "side_image",
        table(
            EPISODES,
            **{"videosSLASHobservation__images__sideSLASHfrom_timestamp": entry(2, 9.0, None)},
        ),
        ["file-000.mp4: the frames of episode 2 cannot be decoded"],
    ),
    "several sizes": (
        ("agentview_image", "side_image"),
        feature(CAMERA, shape=[16, 16, 3]),
        ["several sizes: agentview_image 16, side_image 32"],
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


def test_a_recording_that_was_not_finalized(tmp_path):
    """As a killed process leaves it: nothing closes the files."""
    root = tmp_path / "lift"
    code = """
        import os, sys
        import numpy as np
        from lerobot.datasets import LeRobotDataset
        kind = {"dtype": "float32", "shape": (2,), "names": None}
        features = {"observation.state": kind, "action": kind}
        data = LeRobotDataset.create("a/b", 20, features, root=sys.argv[1], use_videos=False)
        for _ in range(2):
            for _ in range(3):
                data.add_frame(dict.fromkeys(features, np.zeros(2, np.float32)) | {"task": "none"})
            data.save_episode()
        os._exit(0)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code), str(root)], check=True)
    assert (root / DATA).is_file()
    with pytest.raises(DatasetError, match=r"finalize\(\)"):
        LeRobotExperienceReplay(root)


def test_bad_options(root):
    with pytest.raises(ValueError, match="'disk'"):
        LeRobotExperienceReplay("user/never-fetched", storage="disk")
    with pytest.raises(FileNotFoundError, match=r"no meta/info\.json there"):
        LeRobotExperienceReplay(root / "absent")
    with pytest.raises(DatasetError, match="there are 3 demonstrations, fewer than the 4"):
        LeRobotExperienceReplay(root, demos=4)
    with pytest.raises(ValueError, match="demos must be at least 1, got 0"):
        LeRobotExperienceReplay(root, demos=0)
    with pytest.raises(DatasetError, match=r"info\.json: there is no observation 'nothing' among"):
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
