"""Cameras of any size: the same in every format, in memory, in the policy and on the robot."""

import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("minari")
pytest.importorskip("lerobot")

import h5py
from gymnasium.spaces import Box, Dict
from minari import create_dataset_from_buffers
from minari.data_collector import EpisodeBuffer

from tests.data.lerobot_parts import numbers
from tests.errors import raises
from warmprior import PastPrior, window_replay_buffer
from warmprior.__main__ import main
from warmprior.data import DatasetError, Demonstrations, demonstrations_of, open_demonstrations
from warmprior.data.convert import quietly
from warmprior.data.formats.hdf5 import RobomimicReader
from warmprior.data.formats.lerobot import LeRobotReader
from warmprior.data.formats.minari import MinariReader
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.deploy import AsyncExecutor
from warmprior.deploy.observation import encoder_in
from warmprior.modules.resize import resized
from warmprior.saving import load_policy
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy
from warmprior.transforms import CameraImages

JOINTS = [f"{name}.pos" for name in ("pan", "lift", "elbow", "flex", "roll", "gripper")]
CAMERAS = {"front": (480, 640), "wrist": (480, 848)}
LENGTHS = (3, 1, 4)
SMALL = {"network": "mlp,hidden_dim=8", "encoder": "small"}


def scene(height, width, rng):
    """A picture with structure of all sizes, which compresses well."""
    image = np.zeros((height, width, 3), np.uint8)
    for _ in range(20):
        y, x = rng.integers(0, height - 40), rng.integers(0, width - 40)
        image[y : y + rng.integers(2, 40), x : x + rng.integers(2, 40)] = rng.integers(0, 256, 3)
    return image


@pytest.fixture(scope="module")
def episodes():
    """Return steps like an SO-101's: six joints, absolute targets, two cameras of different sizes."""
    rng, made = np.random.default_rng(0), []
    for length in LENGTHS:
        joints = rng.uniform(-1, 1, (length + 1, 6)).astype(np.float32)
        images = {
            name: np.stack([scene(*size, rng) for _ in range(length)]) for name, size in CAMERAS.items()
        }
        made.append({"joints": joints[:-1], "actions": joints[1:], **images})
    return made


@pytest.fixture(scope="module")
def places(episodes, tmp_path_factory):
    """The same arrays in every format: how they are opened, with the names of joints and images."""
    from lerobot.datasets import LeRobotDataset

    folder = tmp_path_factory.mktemp("so101")
    features = {name: numbers(6, JOINTS) for name in ("observation.state", "action")}
    for name, size in CAMERAS.items():
        shape = {"dtype": "image", "shape": (*size, 3), "names": ["height", "width", "channels"]}
        features[f"observation.images.{name}"] = shape
    dataset = LeRobotDataset.create("local/so101", 30, features, root=folder / "lerobot", use_videos=False)
    buffers = []
    with h5py.File(folder / "so101.hdf5", "w") as file:
        for number, episode in enumerate(episodes):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"], demo["obs/joints"] = episode["actions"], episode["joints"]
            for name in CAMERAS:
                demo[f"obs/{name}"] = episode[name]
            seen = {name: np.concatenate([v, v[-1:]]) for name, v in episode.items() if name != "actions"}
            n = len(episode["actions"])
            ended = {"terminations": [False] * n, "truncations": [False] * (n - 1) + [True]}
            given = {"observations": seen, "actions": episode["actions"], "rewards": [0.0] * n}
            buffers.append(EpisodeBuffer(id=number, **given, **ended))
            for step in range(n):
                frame = {f"observation.images.{name}": episode[name][step] for name in CAMERAS}
                frame |= {"observation.state": episode["joints"][step], "action": episode["actions"][step]}
                dataset.add_frame(frame | {"task": "reach"})
            with quietly():
                dataset.save_episode()
    dataset.finalize()
    space, images = (
        Box(-9, 9, (6,), np.float32),
        {n: Box(0, 255, (*s, 3), np.uint8) for n, s in CAMERAS.items()},
    )
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    create_dataset_from_buffers(
        "so/reach-v0",
        buffers,
        observation_space=Dict({"joints": space} | images),
        action_space=space,
        jpeg_encoding=False,
    )
    yield {
        f"lerobot:{folder / 'lerobot'}": ("observation.state", [f"observation.images.{n}" for n in CAMERAS]),
        str(folder / "so101.hdf5"): ("joints", [*CAMERAS]),
        "minari:so/reach-v0": ("joints", [*CAMERAS]),
    }
    del os.environ["MINARI_DATASETS_PATH"]


def expected(episodes, size=84, resize="squeeze"):
    """The images of all steps, by camera."""
    whole = {name: np.concatenate([episode[name] for episode in episodes]) for name in CAMERAS}
    frames = {name: torch.from_numpy(value).permute(0, 3, 1, 2) for name, value in whole.items()}
    return {name: resized(value, (size, size), resize) for name, value in frames.items()}


@pytest.mark.parametrize("options", [{}, {"image_size": 40, "resize": "pad"}])
def test_every_format_gives_the_same_windows(places, episodes, options):
    images, windows = expected(episodes, *(options.values() or [84])), []
    for place, (joints, names) in places.items():
        demonstrations = open_demonstrations(place, **options)
        index = demonstrations.index([joints], names)
        assert index.image_shapes == tuple(CAMERAS.values())
        data = demonstrations.steps([joints], names)
        for name, key in zip(CAMERAS, index.image_keys, strict=True):
            assert torch.equal(data["observation", key], images[name])
            data["observation"].rename_key_(key, f"{name}_of_all")
        buffer = window_replay_buffer(
            data.select("observation", "action", "episode"),
            PastPrior(2),
            batch_size=8,
            observation_steps=2,
            generator=torch.Generator().manual_seed(0),
        )
        windows.append(buffer.sample())
    assert (windows[0] == windows[1]).all() and (windows[0] == windows[2]).all()


def test_a_second_training_decodes_nothing(places, episodes, monkeypatch, tmp_path):
    """Other options are decoded anew, in every format."""
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path))
    decoded = []
    for reader in (LeRobotReader, RobomimicReader, MinariReader):

        def images(self, demo, key, read=reader.images):
            decoded.append(demo)
            return read(self, demo, key)

        monkeypatch.setattr(reader, "images", images)
    for options, shown in (({}, ()), ({"image_size": 40, "resize": "pad", "demos": 2}, (40, "pad"))):
        wanted = expected(episodes, *shown)
        for place, (joints, names) in places.items():
            for again in (False, True):
                decoded.clear()
                demonstrations = open_demonstrations(place, **options)
                data = demonstrations.steps([joints], names, storage="memmap")
                assert len(decoded) == (0 if again else len(CAMERAS) * options.get("demos", 3))
                keys = demonstrations.index([joints], names).image_keys
                for key, images in zip(keys, wanted.values(), strict=True):
                    assert torch.equal(data["observation", key], images[: len(data)])
    assert len(list(tmp_path.rglob("*.bytes"))) == len(places) * 2 * len(CAMERAS)


def test_steps_in_memory_are_resized_alike(episodes):
    whole = {name: np.concatenate([episode[name] for episode in episodes]) for name in CAMERAS}
    frames = {name: torch.from_numpy(value).permute(0, 3, 1, 2) for name, value in whole.items()}
    observation = TensorDict({"state": torch.rand(8, 6), **frames}, [8])
    episode = torch.arange(3).repeat_interleave(torch.tensor(LENGTHS))
    steps = TensorDict({"observation": observation, "action": torch.rand(8, 6), "episode": episode}, [8])
    task = Task(demonstrations_of(steps, resize="pad"))
    for name, value in expected(episodes, resize="pad").items():
        assert torch.equal(task.data["observation", name], value)
    assert steps["observation", "front"].shape[-2:] == (480, 640)
    square = observation.apply(lambda image: image[..., :32, :32] if image.ndim == 4 else image)
    for size, options in ((32, {}), (20, {"image_size": 20})):
        task = Task(demonstrations_of(steps.clone(False).set("observation", square), **options))
        assert task.images == dict.fromkeys(CAMERAS, size)


def test_from_the_command_line_to_full_size_frames(places, episodes, tmp_path, capsys):
    place, (joints, names) = next(iter(places.items()))
    small = "--encoder small --network mlp,hidden_dim=8 --iterations 2 --batch-size 4 --chunk 2 --held-out 1"
    argv = ["train", place, "--observations", joints, "--images", *names, "--out", str(tmp_path)]
    for number, (options, size, resize) in enumerate(
        ((["--image-size", "42", "--resize", "pad"], 42, "pad"), ([], 84, "squeeze"))
    ):
        assert main([*argv, *small.split(), *options, "--seed", str(number)]) == 0
        policy = load_policy(capsys.readouterr().out.splitlines()[-1])
        encoder = encoder_in(policy)
        assert (encoder.image_size, encoder.resize) == (size, resize)
        assert encoder.crop_size == round(76 / 84 * size)
        chunks = []
        for frames in (
            {f"{name}_image": episodes[0][name][0] for name in CAMERAS},
            {f"{name}_image": value[0] for name, value in expected(episodes, size, resize).items()},
        ):
            torch.manual_seed(0)
            with AsyncExecutor(policy, latency=0) as executor:
                chunks.append(executor.act({"state": episodes[0]["joints"][0], **frames}))
        assert torch.equal(*chunks)


def test_demos_have_cameras_of_one_size(tmp_path):
    with h5py.File(tmp_path / "mixed.hdf5", "w") as file:
        for number, side in enumerate((16, 16, 24)):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"], demo["obs/joints"] = np.zeros((4, 2)), np.zeros((4, 2))
            demo["obs/front"] = np.zeros((4, side, side, 3), np.uint8)
    with raises(DatasetError, "data/demo_2", "(24, 24)", "(16, 16)"):
        open_demonstrations(tmp_path / "mixed.hdf5").steps(images=["front"])


@pytest.mark.parametrize("side", [7, 1025])
def test_squares_that_no_policy_sees_are_refused_before_they_are_read(tmp_path, monkeypatch, side):
    path = tmp_path / "squares.hdf5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"], demo["obs/joints"] = np.zeros((2, 2)), np.zeros((2, 2))
        demo["obs/front"] = np.zeros((2, side, side, 3), np.uint8)
    with monkeypatch.context() as patched:
        patched.delattr(RobomimicReader, "images")
        with raises(DatasetError, "front has", f"{side} pixels", "8 to 1024", "image_size"):
            open_demonstrations(path).steps(images=["front"])
    shown = open_demonstrations(path, image_size=8).steps(images=["front"])
    assert shown["observation", "front"].shape == (2, 3, 8, 8)


def test_a_simulator_renders_at_the_stored_size(monkeypatch):
    rng = np.random.default_rng(0)
    shown = {"front": scene(60, 80, rng), "wrist": scene(50, 50, rng)}

    class Simulator:
        def render_frame(self, camera, size, state):
            assert shown[camera].shape[:2] == tuple(size)
            return shown[camera]

    monkeypatch.setattr(CameraImages, "_simulator", Simulator())
    images = CameraImages(["front", "wrist"], 24, rendered=[[60, 80], [50, 50]], resize="pad")
    step = TensorDict({"observation": torch.zeros(3), "sim_state": torch.zeros(5)})
    seen = images._call(step)["observation"]
    for camera, picture in shown.items():
        frame = torch.from_numpy(picture).permute(2, 0, 1)
        assert torch.equal(seen[f"{camera}_image"], resized(frame, (24, 24), "pad"))


def anonymous():
    """Bytes of this process's memory that no file holds."""
    words = Path("/proc/self/status").read_text().split()
    return 1024 * int(words[words.index("RssAnon:") + 1])


class Cameras(Demonstrations):
    """Two demos with frames of a camera that are made when they are read."""

    prefix = "cameras:"
    shape = (96, 128)
    count = 0
    most = 0

    def index(self, observations=None, images=(), *, poses=False):
        return DatasetIndex(
            path=Path("cameras"),
            demos=("0", "1"),
            lengths=(self.count - 100, 100),
            observation_keys=("joints",),
            observation_dims=(6,),
            **self.image_entries(images, {"front": self.shape}),
            available_keys=("joints", "front"),
            action_dim=6,
        )

    @contextmanager
    def reader(self, index):
        yield Frames(self)

    def contents(self, index):
        return f"{self.count} frames of a seed"


class Frames(DemonstrationReader):
    def __init__(self, cameras):
        self.cameras, self.frames = cameras, torch.randint(256, (50, 3, *cameras.shape)).byte()

    def numbers(self, demo, key, out, first=0):
        out[...] = np.random.default_rng(len(key)).uniform(-1, 1, out.shape)  # joints are no targets

    def images(self, demo, key):
        for _ in range(self.cameras.index().lengths[int(demo)] // 50):
            yield self.frames
            self.cameras.most = max(self.cameras.most, anonymous())

    def name(self, demo, key):
        return key


def test_a_reader_gives_an_image_per_step():
    demonstrations = Cameras("")
    demonstrations.count = 130
    with raises(DatasetError, "cameras", "demo 0", "0 images front", "30 steps"):
        demonstrations.steps(images=["front"])


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
@pytest.mark.parametrize("count", [6_000, pytest.param(60_000, marks=pytest.mark.slow)])
def test_frames_of_a_training_stay_on_the_disk(count, monkeypatch):
    """From reading to batches with a demonstration held out, less memory than 0.6 of the images'."""
    demonstrations = Cameras("")
    demonstrations.count, before = count, anonymous()
    task, left_out = Task(demonstrations, images=["front"]).split(1)
    assert len(left_out) == 100 and task.images == {"front": 84}
    batch = window_replay_buffer(task.data, PastPrior(4), batch_size=32, observation_steps=2).sample()
    assert batch["observation", "front"].shape == (32, 2, 3, 84, 84)
    demonstrations.most = max(demonstrations.most, anonymous())
    network, training = NetworkOptions(**SMALL), TrainingConfig(iterations=2, batch_size=8)
    train_policy(task, PastPrior(4), network=network, training=training, description=None)
    used = max(demonstrations.most, anonymous()) - before
    assert used < min(1e9, 0.6 * count * 3 * 84 * 84)
