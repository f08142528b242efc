import json
import os
import shutil
from functools import partial

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot")

import av

from tests.data.lerobot_parts import edit_json, edit_table, write_lerobot
from tests.data.synthetic import env_args_15
from tests.errors import raises, refuses
from tests.fuzz import sandbox
from warmprior.data import DatasetError
from warmprior.data.formats.lerobot import LeRobotDemonstrations, check_times

LIFT = env_args_15("lift")
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
CAMERA = "observation.images.agentview"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole") / "lift"
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


def sound(root):
    with av.open(root / MOVIE, "w") as file:
        stream = file.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        file.mux([*stream.encode(frame), *stream.encode()])


def unknown_codec(root):
    content = (root / MOVIE).read_bytes()
    assert b"av01" in content
    (root / MOVIE).write_bytes(content.replace(b"av01", b"none"))


def unknown_codec_beside_a_picture(root):
    old, new = root / MOVIE, root / "new.mp4"
    with av.open(old) as source, av.open(new, "w") as file:
        video = file.add_stream_from_template(source.streams.video[0], opaque=True)
        picture = file.add_stream("mjpeg", rate=20)
        picture.width = picture.height = 64
        picture.pix_fmt = "yuvj420p"
        black = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8)).reformat(format="yuvj420p")
        black.pts = 0
        packets = [*picture.encode(black), *picture.encode(), *source.demux(video=0)]
        for packet in (packet for packet in packets if packet.dts is not None):
            packet.stream = picture if packet.stream is picture else video
            file.mux(packet)
    new.replace(old)
    unknown_codec(root)


def description(content):
    return lambda root: (root / "meta" / "warmprior.json").write_text(content)


def described(**content):
    return description(json.dumps(ALIEN | content))


ALIEN = {"format": 1, "env_args": {"env_name": "Lift", "env_kwargs": {}}}
STATE = {"object": ["observation.environment_state", 0, 10]}

HUGE = "data/{chunk_index:2000000000}/{file_index}.parquet"


def v21(root):
    """What a folder of v2.1 has in the place of tables."""
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info(lambda i: i.update(codebase_version="v2.1", data_path=path))(root)
    (root / "meta" / "tasks.parquet").unlink()
    (root / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "lift"}')


def info_of(name, value):
    return info(lambda i: i.update({name: value}))


MALFORMED = {
    "features": info_of("features", ["action"]),
    "features.action": info(lambda i: i["features"].update(action=[7])),
    "features.action.dtype": feature("action", dtype=32),
    "features.action.shape": feature("action", shape="7"),
    "features.action.names": feature("action", names=7),
    "features.observation.state.shape": feature("observation.state", shape=[9.5]),
    "features.observation.state.info": feature("observation.state", info=[True]),
    "fps": info_of("fps", "fast"),
    "total_episodes": info_of("total_episodes", 1e308),
    "total_frames": info_of("total_frames", "many"),
    "data_path": info_of("data_path", HUGE),
    "video_path": info_of("video_path", "{video_key.__class__}/{chunk_index}"),
    "codebase_version": info_of("codebase_version", 3),
}
TEMPLATES = ["{chunk_index!r:>9}", "{chunk_index:{file_index}}", "{0}", "{other}", "{chunk_index", 7]
PLACED = ["warmprior.json", "observations"]

META = {
    "v2.1": (v21, ["v2.1", "convert_dataset_v21_to_v30"]),
    **{name: (change, ["meta/info.json", f"{name}="]) for name, change in MALFORMED.items()},
    **{f"at {text}": (info_of("data_path", text), ["data_path="]) for text in TEMPLATES},
    "no place": (info_of("data_path", None), ["data_path=None"]),
    "no place of a video": (
        info(lambda i: i.update(video_path=None) or i["features"]["observation.state"].update(dtype="video")),
        ["video_path=None"],
    ),
    "data of a camera": (info_of("data_path", "{video_key}/{chunk_index}"), ["data_path="]),
    "a number of a camera": (info_of("video_path", "{video_key:03d}"), ["video_path="]),
    "other counts": (info_of("total_frames", 99), ["meta/info.json", 99, "meta/episodes"]),
    "another version": (described(format=2), ["warmprior.json", "version"]),
    "narrow state": (
        feature("observation.state", shape=[8], names=None),
        ["Lift", "'observation.state': 8", 9],
    ),
    "narrow actions": (feature("action", shape=[6], names=None), ["'action'", 6, "Lift", 7]),
    "no content": (lambda root: (root / "meta/info.json").write_text("[]"), ["content=[]"]),
    "negative file": (table(EPISODES, dataSLASHfile_index=entry(0, -1, None)), ["data/file_index"]),
    "no length": (table(EPISODES, length=entry(0, None, None)), ["length"]),
    "no observations": (described(), PLACED),
    "listed observations": (described(observations=["object"]), PLACED),
    "two ends": (described(observations={"object": ["observation.environment_state", 10]}), PLACED),
    "text": (described(observations={"object": ["observation.environment_state", "0", 10]}), PLACED),
    "text of masks": (described(observations=STATE, masks={"train": "all"}), ["warmprior.json", "masks"]),
    "no JSON": (cut("meta/info.json"), ["LeRobot"]),
    "no steps": (table(EPISODES, length=lambda lengths: [7, 0, 9]), ["demonstration 1", "no steps"]),
    "no episodes": (without(EPISODES), ["meta/episodes/*/*.parquet", "finalize()"]),
    "other fps": (info(lambda i: i.update(fps=30)), ["fps", 30, "Lift", 20]),
    "no action": (
        info(lambda i: i["features"].update({"act": i["features"].pop("action")})),
        ["'action'", "task_index, act"],
    ),
    "joints": (
        feature("action", names={"motors": [f"joint_{i}" for i in range(7)]}),
        ["Lift", "robot0_x, robot0_y", "joint_0, joint_1"],
    ),
    "another environment": (
        described(env_args={"env_name": "Stack", "env_kwargs": {}}, observations=STATE),
        ["Stack", "Lift", "env_args"],
    ),
    "other columns": (
        described(observations={"object": ["observation.state", 3, 13]}),
        ["warmprior.json", "observations['object']", "observation.state"],
    ),
}
VALUES = {
    "cut off": (cut(DATA), ["damaged", "finalize()"]),
    "NaN": (table(DATA, action=entry(8, float("nan"))), ["action", "episode 2", "nan", "row 1"]),
    "NaN among observations": (
        table(DATA, observation__state=entry(8, float("nan"))),
        ["observation.state", "episode 2", "nan", "row 1", "lerobot-edit-dataset"],
    ),
    "a time stamp among observations": (
        table(DATA, observation__state=entry(8, 1.7e9)),
        ["observation.state", "episode 2", "1.7e+09", "row 1", "offset"],
    ),
    "dropped frames": (
        table(DATA, timestamp=entry(slice(12, 16), [1.0] * 4, None)),
        ["episode 2", "row 5", 20],
    ),
    "other episodes": (table(DATA, episode_index=entry(6, 0, None)), ["meta/episodes", "finalize()"]),
}
ELSEWHERE = {
    f"{part} {kind}": (f"{part}SLASH{kind}_index", f"{part.replace('__', '.').replace('SLASH', '/')}/{file}")
    for part, ending in (("data", "parquet"), ("videosSLASHobservation__images__side", "mp4"))
    for kind, file in (
        ("chunk", f"chunk-001/file-000.{ending}"),
        ("file", f"chunk-000/file-001.{ending}"),
    )
}
MOVIE = "videos/observation.images.side/chunk-000/file-000.mp4"
IMAGES = {
    "missing camera": (lambda root: None, ["'front_image'", "agentview_image"], "front_image"),
    "one colour": (feature(CAMERA, shape=[32, 32, 1]), [CAMERA, "(32, 32, 1)"], "agentview_image"),
    "other size": (
        feature(CAMERA, shape=[16, 16, 3]),
        [DATA, CAMERA, "3, 32, 32]", "3, 16, 16]"],
        "agentview_image",
    ),
    "cut-off video": (cut(MOVIE), ["file-000.mp4"], "side_image"),
    "sound": (sound, [MOVIE, "observation.images.side", "codec", "audio"], "side_image"),
    "unknown codec": (unknown_codec, [MOVIE, "observation.images.side", "codec"], "side_image"),
    "unknown codec beside a picture": (unknown_codec_beside_a_picture, [MOVIE, "codec"], "side_image"),
    "outside": (
        info_of("data_path", "../{chunk_index}/{file_index}.parquet"),
        ["'../0/0.parquet'", "folder"],
    ),
    "no last frame": (  # of the last episode, which begins at 0.35 s
        table(EPISODES, videosSLASHobservation__images__sideSLASHfrom_timestamp=entry(2, 0.4, None)),
        [MOVIE, "episode 2", "lerobot-edit-dataset"],
        "side_image",
    ),
    "frames beside the steps": (  # none is missing, but each is 2 ms early
        table(EPISODES, videosSLASHobservation__images__sideSLASHfrom_timestamp=entry(2, 0.352, None)),
        [MOVIE, "episode 2", "0.0001 s"],
        "side_image",
    ),
}


@pytest.mark.parametrize("name", [*META, *VALUES, *IMAGES])
def test_what_is_damaged_or_does_not_fit_is_named(root, name, monkeypatch):
    """What ``meta/`` tells before anything is read, values with their file, and images."""
    change, said, *keys = (META | VALUES | IMAGES)[name]
    change(root)
    if name in META:
        monkeypatch.setattr("warmprior.data.formats.lerobot.LeRobotReader", lambda i: pytest.fail("was read"))
    with raises(DatasetError, root / DATA if name in VALUES else root, *said):
        LeRobotDemonstrations(root, task=LIFT).steps(images=keys)


UNEVEN = {
    "hundredths": lambda times: np.round(times, 2),  # most steps are of 0.03 s
    "after an hour": lambda times: (times + 3600).astype(np.float32),
    "after a day": lambda times: (times + 86_400).astype(np.float32),  # 8 ms are the last bit
    "jitter": lambda times: times + 0.004 * (np.arange(len(times)) % 2),
    "exact": lambda times: times,
}


@pytest.mark.parametrize("name", UNEVEN)
@pytest.mark.parametrize("fps", [15, 20, 25, 29, 30, 31, 40, 60])
def test_another_rate_is_told_from_uneven_time_stamps(name, fps):
    times = UNEVEN[name](np.arange(300) / 30)
    if fps == 30 or (name == "after a day" and fps in (25, 29, 31, 40)):
        check_times(times, fps, "episode 0")
    else:
        with raises(DatasetError, "episode 0", "fps", fps, "meta/info.json"):
            check_times(times, fps, "episode 0")


@pytest.mark.parametrize("times", [[0], [0, 0.052], [0, 0.0508, 0.1016], [0, 0.05, 0.1, 0.16]])
def test_a_short_episode_tells_no_rate(times):
    check_times(np.array(times, np.float32), 20, "episode 0")
    with raises(DatasetError, "episode 0", "leaps", "lerobot-edit-dataset"):
        check_times(np.array([*times, times[-1] + 0.1], np.float32), 20, "episode 0")


@pytest.mark.parametrize("storage", ["memory", "memmap"])
@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_file_of_another_number_is_named(root, name, storage):
    column, file = ELSEWHERE[name]
    table(EPISODES, **{column: entry(1, 1, None)})(root)
    with raises(DatasetError, root / file, "no such file", "finalize()"):
        LeRobotDemonstrations(root, task=LIFT).steps(images=["side_image"], storage=storage)


@pytest.mark.parametrize(("episode", "start"), [(1, 0.0), (2, 0.1), (0, 0.3)])
def test_frames_of_another_episode_are_not_its_own(root, episode, start):
    """LeRobot finds a frame for each of these times: one of an episode before or after."""
    column = "videosSLASHobservation__images__sideSLASHfrom_timestamp"
    table(EPISODES, **{column: entry(episode, start, None)})(root)
    with raises(DatasetError, root, "meta/episodes", "observation.images.side", episode):
        LeRobotDemonstrations(root, task=LIFT).steps(images=["side_image"])
    LeRobotDemonstrations(root, task=LIFT).steps(images=["agentview_image"])
    if episode == 1:  # whose frames are now those of the first, and not of the last
        LeRobotDemonstrations(root, task=LIFT, episodes=[2]).steps(images=["side_image"])


def test_masks_and_episodes_are_some_of_those_that_there_are(root):
    described(observations=STATE, masks={"none": [], "more": [0, 3], "floats": [0.5], "ok": [2, 0]})(root)
    seen = {"observations": ["observation.state"]}
    for options in ({"mask": "none"}, {"episodes": []}, {"mask": "ok", "episodes": [1]}):
        with raises(DatasetError, "mask"):
            LeRobotDemonstrations(root, **options).steps(**seen)
    assert LeRobotDemonstrations(root, mask="ok", episodes=[2]).index(**seen).demos == ("2",)
    for name in ("more", "floats"):
        with raises(DatasetError, f"'{name}'", "0 to 2"):
            LeRobotDemonstrations(root, mask=name).steps(**seen)
    assert LeRobotDemonstrations(root, mask="ok").index(**seen).demos == ("0", "2")
    for numbers in ([3], [-1], [True], ["0"]):
        with raises(DatasetError, "episodes", "0 to 2"):
            LeRobotDemonstrations(root, episodes=numbers).steps(**seen)


def test_files_of_other_episodes_are_not_needed(tmp_path):
    values = write_lerobot(tmp_path / "data", (12, 12, 12), data_files_size_in_mb=0.001)
    (tmp_path / "data/data/chunk-000/file-001.parquet").unlink()
    data = LeRobotDemonstrations(tmp_path / "data", episodes=[2, 0]).steps()
    assert torch.equal(data["action"], torch.from_numpy(np.delete(values["action"], range(12, 24), 0)))


@pytest.mark.parametrize(("dtype", "shape"), [("float32", [2, 3]), ("string", [1])])
def test_observations_that_are_no_vectors_are_named(root, dtype, shape):
    feature("observation.state", dtype=dtype, shape=shape)(root)
    with raises(DatasetError, "'observation.state'", dtype, shape):
        LeRobotDemonstrations(root).steps(observations=["observation.state"])


def test_bad_options(root, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    refuses(lambda: LeRobotDemonstrations("user/arm").index(), OSError, "user/arm", "v3.0", "connection")
    refuses(lambda: LeRobotDemonstrations(root).steps(storage="disk"), ValueError, "'disk'")
    refuses(lambda: LeRobotDemonstrations(root / "absent").steps(), FileNotFoundError, "meta/info.json")
    refuses(lambda: LeRobotDemonstrations(root, demos=4).steps(), DatasetError, 3, "demos=4")
    refuses(lambda: LeRobotDemonstrations(root, demos=0).steps(), ValueError, "demos", 0)
    with raises(DatasetError, "'nothing'", "observation.state"):
        LeRobotDemonstrations(root).steps(observations=["nothing"])
    with raises(DatasetError, "'observation.images.side'", "images"):
        LeRobotDemonstrations(root).steps(observations=["observation.images.side"])
    refuses(lambda: LeRobotDemonstrations(root).steps(observations=[]), DatasetError, "observations")
    refuses(lambda: LeRobotDemonstrations(root, mask="train").steps(), DatasetError, "'train'", "none")
    refuses(lambda: LeRobotDemonstrations(root).index(poses=True), DatasetError, "'robot0_eef_pos'")
    # Poses that are none: random numbers where a quaternion should be.
    with raises(DatasetError, "robot0_eef_quat", "episode 0", "row"):
        LeRobotDemonstrations(root, task=LIFT).steps(actions="absolute")


@pytest.mark.parametrize("storage", ["memory", "memmap"])
@pytest.mark.parametrize(
    "file", ["meta/tasks.parquet", "meta/stats.json", "data/*/*.parquet", "videos/*/*/*.mp4"]
)
def test_a_pipe_is_not_waited_for(root, monkeypatch, file, storage):
    (path,) = root.glob(file)
    path.unlink()
    os.mkfifo(path)
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 10.0)
    read = partial(LeRobotDemonstrations(root).steps, images=["side_image"], storage=storage)
    found = sandbox.attempt(read, str(root))
    assert found.kind == "refused", found
    assert "not a regular file" in found.detail
