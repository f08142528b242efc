"""A training says first what it uses of a place and what it leaves out, and its policy keeps that."""

import shlex

import numpy as np
import pytest
import torch

from tests.errors import missing, raises, refuses
from warmprior import GaussianPrior, PastPrior
from warmprior.__main__ import main
from warmprior.data import DatasetError, open_demonstrations
from warmprior.deploy import AsyncExecutor
from warmprior.modules.recording import Recording
from warmprior.saving import load_policy
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

h5py = pytest.importorskip("h5py")

LENGTHS = (12, 15, 9)


def robot_file(path, **more):
    """A robot's own file: vectors, a camera, a text, and what the arguments add, by name."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for i, length in enumerate(LENGTHS):
            demo = {
                "actions": rng.normal(size=(length, 3)),
                "obs/robot0_eef_pos": rng.normal(size=(length, 3)),
                "obs/robot0_gripper_qpos": rng.normal(size=(length, 2)),
                "obs/robot0_ft": rng.normal(size=(length, 6)),
                "obs/force": rng.normal(size=length),
                "obs/wrist": np.zeros((length, 6, 8, 3), np.uint8),
                "obs/depth": np.zeros((length, 6, 8), np.float32),
            }
            demo |= {f"obs/{name}": make(demo["actions"]) for name, make in more.items()}
            for name, value in demo.items():
                file[f"data/demo_{i}/{name}"] = value
    return path


def lines_of(text):
    return dict(line.split(maxsplit=1) for line in text.replace("left out", "left_out").splitlines())


def test_what_a_robots_file_holds_and_the_policy_does_not_see_is_said(tmp_path, capsys):
    path = robot_file(tmp_path / "arm.hdf5")
    words = f"train {path} --iterations 1 --network mlp,hidden_dim=8 --out {tmp_path} --held-out 1"
    assert main(words.split()) == 0
    said = lines_of("\n".join(capsys.readouterr().out.splitlines()[:5]))
    assert said["observations"] == "robot0_eef_pos [3], robot0_gripper_qpos [2], force [1]"
    assert said["images"] == "none"
    assert not missing(said["left_out"], "robot0_ft (--observations)", "wrist (--images)", "depth (no option")
    assert not missing(said["actions"], "[3]", "recorded")
    assert not missing(said["data"], "arm.hdf5", "2 of 3 demonstrations", "1 held out", "27 steps")


@pytest.mark.parametrize(
    ("count", "line"), [("1", "no demonstration is held out"), ("2", "demonstrations (1, ")]
)
def test_of_few_demonstrations_one_is_held_out(tmp_path, capsys, count, line):
    path = robot_file(tmp_path / "arm.hdf5")
    words = (
        f"train {path} --iterations 1 --network mlp,hidden_dim=8 --out {tmp_path} --demonstrations {count}"
    )
    assert main(words.split()) == 0
    assert line in capsys.readouterr().out


def test_an_observation_that_counts_as_constant_is_named(tmp_path):
    path = robot_file(tmp_path / "arm.hdf5")
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            rows = len(demo["actions"])
            demo["obs/gps"] = 48 + 1e-4 * np.linspace([-1, -1], [1, 0], rows)
    demonstrations = open_demonstrations(path)
    with pytest.warns(UserWarning, match=r"gps \[0\] by 0.000198.*gps \[1\].*constant"):
        Task(demonstrations, observations=[*demonstrations.index().observation_keys])


def test_unknown_joints_are_named_before_images_are_read(tmp_path, monkeypatch):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5"))
    monkeypatch.setattr("warmprior.data.image_cache.read_images", lambda *_: pytest.fail("was read"))
    with raises(ValueError, "joints", "'arm'"):
        Task(demonstrations, images=["wrist"], joints="arm")


def test_an_image_that_is_not_there_is_named_beside_those_that_are(tmp_path):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5"))
    with raises(DatasetError, "demo_0", "'side'", "wrist") as refused:
        Task(demonstrations, images=["wrist", "side"])
    assert "depth" not in str(refused.value)


def test_what_is_named_is_used_and_no_longer_left_out(tmp_path):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5"), image_size=8, resize="pad")
    task = Task(demonstrations, observations=["robot0_ft", "force"], images=["wrist"])
    recording = task.recording
    assert list(recording.observations.items()) == [("robot0_ft", 6), ("force", 1)]
    assert recording.left_out["observations"] == ["robot0_eef_pos", "robot0_gripper_qpos"]
    assert "images" not in recording.left_out and not missing(recording.images["wrist"], "6 x 8", "8 x 8")
    assert (recording.demonstrations, recording.steps) == (3, sum(LENGTHS))


def test_each_of_several_images_stands_apart():
    sizes = {"front": "480 x 640, seen at 84 x 84 (pad)", "wrist": "84 x 84"}
    said = Recording("arm", 1, 9, "[2]", {"joints": 2}, sizes).lines()["images"]
    assert said.split("; ") == [f"{name}, {size}" for name, size in sizes.items()]


@pytest.mark.parametrize("options", [{"image_size": 8}, {"resize": "pad"}])
def test_a_size_of_images_without_images_is_refused(tmp_path, options):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5"), **options)
    refuses(lambda: Task(demonstrations), ValueError, "image_size and resize", "images")


def test_a_training_of_a_place_says_it_above_its_progress(tmp_path, capsys):
    path = robot_file(tmp_path / "arm.hdf5")
    options = {"network": NetworkOptions("mlp,hidden_dim=8"), "training": TrainingConfig(iterations=1)}
    train_policy(path, PastPrior(4), description=None, **options)
    assert not capsys.readouterr().err
    train_policy(path, PastPrior(4), **options)
    assert not missing(capsys.readouterr().err, "robot0_ft (observations=)", "wrist (images=)")


def test_a_dataset_of_lerobot_names_its_camera_and_not_its_counters(tmp_path):
    pytest.importorskip("lerobot.datasets")
    from tests.data.lerobot_parts import edit_table, numbers, write_lerobot

    features = {"observation.state": numbers(6), "observation.effort": numbers(6), "action": numbers(6)}
    write_lerobot(tmp_path / "arm", (8, 8), features, images=[("front", "image")], fps=30)
    recording = Task(open_demonstrations(f"lerobot:{tmp_path / 'arm'}")).recording
    assert recording.observations == {"observation.state": 6} and recording.rate == 30
    assert recording.left_out == {"observations": ["observation.effort"], "images": ["front_image"]}
    seeing = Task(open_demonstrations(f"lerobot:{tmp_path / 'arm'}"), images=["observation.images.front"])
    assert seeing.recording.names == {"front_image": "observation.images.front"}
    assert "images" not in seeing.recording.left_out
    # Without language a policy cannot know which of several tasks it is asked for.
    episodes = tmp_path / "arm" / "meta/episodes/chunk-000/file-000.parquet"
    edit_table(episodes, tasks=lambda tasks: [["lift"], ["push"]])
    for demos, unseen in ((2, ["task, one of 2"]), (1, [])):
        dataset = open_demonstrations(f"lerobot:{tmp_path / 'arm'}", demos=demos)
        assert Task(dataset).recording.left_out.get("", []) == unseen
    dataset = open_demonstrations(f"lerobot:{tmp_path / 'arm'}")
    knowing = Task(dataset, observations=["observation.state", "task_index"])
    assert "" not in knowing.recording.left_out
    edit_table(episodes, tasks=lambda tasks: [["lift"], None])
    assert "" not in Task(dataset).recording.left_out


def test_the_parts_of_a_converted_dataset_are_named_once(tmp_path):
    pytest.importorskip("lerobot.datasets")
    pytest.importorskip("robosuite")
    from tests.data.synthetic import write_robomimic_file
    from warmprior.data import convert_robomimic

    write_robomimic_file(tmp_path / "lift.hdf5", task="lift")
    folder = convert_robomimic(tmp_path / "lift.hdf5", tmp_path / "lift")
    file, dataset = (Task(open_demonstrations(p)) for p in (tmp_path / "lift.hdf5", f"lerobot:{folder}"))
    assert dataset.recording.observations == file.recording.observations
    assert dataset.recording.left_out == {} and dataset.recording.rate == 20
    assert file.recording.left_out == {"images": ["agentview_image"], "observations": ["robot0_eef_vel_lin"]}


def moved(steps):
    """The actions of some steps later (or before, if negative), where the episode has them."""
    return lambda actions: actions[np.clip(np.arange(len(actions)) + steps, 0, len(actions) - 1)]


SEEN = {
    "actions": moved(0),
    "next_actions": moved(1),
    "targets": lambda actions: np.concatenate([actions, np.ones((len(actions), 2))], 1),
    "command": lambda actions: actions[:, 1],
}


@pytest.mark.parametrize("name", SEEN)
def test_an_observation_that_is_its_own_target_is_refused_unless_it_is_named(tmp_path, name):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5", **{name: SEEN[name]}))
    with raises(DatasetError, "arm.hdf5", f"'{name}'", "observations", "robot0_eef_pos"):
        Task(demonstrations)
    refuses(lambda: Task(demonstrations, joints="robot0_eef_pos"), DatasetError, f"'{name}'")
    others = {other: make for other, make in SEEN.items() if other != name}
    several = open_demonstrations(robot_file(tmp_path / "several.hdf5", **others))
    with raises(DatasetError, *map(repr, others), "(robot0_eef_pos, robot0_gripper_qpos, force)"):
        Task(several)  # what it advises holds none of them
    named = ["robot0_eef_pos", name]
    assert list(Task(demonstrations, observations=named).recording.observations) == named


def test_a_short_demonstration_hides_no_target(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.LENGTHS", (*LENGTHS, 1))
    path = robot_file(tmp_path / "arm.hdf5", targets=moved(2))
    refuses(lambda: Task(open_demonstrations(path)), DatasetError, "'targets'", "t + 2")


def test_who_names_the_joints_wants_to_see_them(tmp_path):
    demonstrations = open_demonstrations(robot_file(tmp_path / "arm.hdf5", joints=moved(0)))
    refuses(lambda: Task(demonstrations), DatasetError, "'joints'")
    assert Task(demonstrations, joints="joints").recording.observations["joints"] == 3


@pytest.mark.parametrize("make", [moved(-1), lambda actions: np.ones((len(actions), 3))])
def test_a_state_that_reaches_the_last_target_is_no_target(tmp_path, make):
    """Nor is a number that never changes, even if an action is the same."""
    path = robot_file(tmp_path / "arm.hdf5", joints=make)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            actions = demo["actions"][()]
            actions[:, 2] = 1
            demo["actions"][...] = actions
    assert Task(open_demonstrations(path)).recording.observations["joints"] == 3


JOINTS = [f"joint_{i}.pos" for i in range(6)]


def arm(root, names=JOINTS, near=0.05):
    """A dataset of an arm whose actions are targets near its joints, under the same names."""
    pytest.importorskip("lerobot.datasets")
    from tests.data.lerobot_parts import edit_table, numbers, write_lerobot

    features = {"observation.state": numbers(6, JOINTS), "action": numbers(6, names)}
    values = write_lerobot(root, (30, 30), features, fps=30)
    joints = 40 * values["observation.state"]
    targets = joints + 40 * near * values["action"]
    edit_table(
        root / "data/chunk-000/file-000.parquet",
        action=lambda _: list(targets.astype(np.float32)),
        observation__state=lambda _: list(joints.astype(np.float32)),
    )
    return f"lerobot:{root}"


def test_absolute_joint_targets_are_recognised_said_and_saved(tmp_path, capsys):
    place = arm(tmp_path / "arm")
    words = ["train", place, "--iterations", "1", "--network", "mlp,hidden_dim=8", "--out", str(tmp_path)]
    assert main(words) == 0
    *said, folder = capsys.readouterr().out.splitlines()
    lines = lines_of("\n".join(said[:7]))
    assert not missing(lines["actions"], "[6]", "observation.state")
    assert not missing(lines["data"], "1 of 2 demonstrations, 1 held out")
    assert not missing(lines["source"], "gaussian", "--prior")
    assert isinstance(load_policy(folder).prior, GaussianPrior)  # what which_source.md advises
    assert load_policy(folder).network.trend.rest.columns.tolist() == list(range(6))
    by_hand = Task(open_demonstrations(place), joints="observation.state")
    assert Task(open_demonstrations(place)).identity == by_hand.identity
    assert Task(open_demonstrations(place), joints="").rest is None


@pytest.mark.parametrize(("names", "near"), [([f"target_{i}" for i in range(6)], 0.05), (JOINTS, 3.0)])
def test_other_actions_are_as_recorded(tmp_path, names, near):
    demonstrations = open_demonstrations(arm(tmp_path / "arm", names, near))
    task = Task(demonstrations)
    assert task.rest is None and not missing(task.recording.text(), "joints=")
    if near > 1:
        refuses(lambda: Task(demonstrations, joints="observation.state"), ValueError, "observation", "units")


def test_a_policy_tells_what_it_needs_and_takes_the_names_of_its_dataset(tmp_path, capsys):
    """In the order of the training, and at its rate, which the executor holds it to."""
    pytest.importorskip("lerobot.datasets")
    from tests.data.lerobot_parts import numbers, write_lerobot

    widths = {"observation.effort": 2, "observation.state": 6, "action": 6}
    features = {name: numbers(width) for name, width in widths.items()}
    features["observation.state"]["names"] = JOINTS
    features["action"]["names"] = {"motors": JOINTS[::-1]}
    values = write_lerobot(tmp_path / "arm", (9, 9), features, images=[("front", "image")], fps=30)
    words = f"train lerobot:{tmp_path / 'arm'} --iterations 1 --out {tmp_path}"
    words += " --network mlp,hidden_dim=8 --encoder small"
    words += " --observations observation.state observation.effort --images observation.images.front"
    words += " --held-out 0"
    assert main(words.split()) == 0
    folder = capsys.readouterr().out.splitlines()[-1]
    assert main(["info", folder]) == 0
    said = lines_of(capsys.readouterr().out.replace("written by", "written_by"))
    assert said["observations"] == "observation.state [6], observation.effort [2]"
    assert not missing(said["takes"], "state (8,)", "front_image", "any size", "32 x 32")
    assert not missing(said["images"], "front_image, 32 x 32") and not missing(said["rate"], 30)
    assert not missing(said["data"], "lerobot:arm", "2 demonstrations") and said["NFE"].startswith("3,")
    ordered = ", ".join(JOINTS), ", ".join(JOINTS[::-1])
    assert said["numbers"] == "observation.state: {}; action: {}".format(*ordered)
    order = "observation.state", "observation.effort", "action"
    ranges = [f"{name}: from {values[name].min():.4g} to {values[name].max():.4g}" for name in order]
    assert said["ranges"].split("; ") == ranges
    assert "units of the demonstrations" in said["normaliser"]

    policy, rng = load_policy(folder), np.random.default_rng(0)
    state, effort = rng.normal(size=6), rng.normal(size=2).astype(np.float32)
    image = rng.integers(0, 256, (48, 64, 3), np.uint8)
    ours = {"state": np.concatenate([state, effort]), "front_image": image}
    theirs = {"observation.effort": effort, "observation.state": state, "observation.images.front": image}
    actions = []
    for observation in (ours, theirs):
        torch.manual_seed(0)
        with AsyncExecutor(policy, latency=0, control_rate=29.97) as executor:
            actions.append(executor.act(observation))
            for entry in ("front", "state"):
                part = {name: value for name, value in observation.items() if entry not in name}
                with raises(KeyError, "front_image", "observation.images.front", "observation.effort"):
                    executor.act(part)
    assert torch.equal(*actions)
    with raises(ValueError, "observation.state", 6), AsyncExecutor(policy, latency=0) as executor:
        executor.act(theirs | {"observation.state": effort})
    refuses(lambda: AsyncExecutor(policy, control_rate=50), ValueError, "control_rate=50", 30)


def test_the_next_command_of_a_training_without_an_environment_runs_as_it_is_printed(tmp_path, capsys):
    path = robot_file(tmp_path / "arm.hdf5")
    out = tmp_path / "my arm's runs"
    assert (
        main(["train", str(path), "--iterations", "1", "--network", "mlp,hidden_dim=8", "--out", str(out)])
        == 0
    )
    *_, line, folder = capsys.readouterr().out.splitlines()
    words = shlex.split(line[line.index("python -m") : line.index(";")])
    assert words == ["python", "-m", "warmprior", "info", folder]
    assert main(words[3:]) == 0
