"""Raw recordings of robosuite, against the observations of the demonstrations that they were made of."""

import json
import shutil

import numpy as np
import pytest

from tests.data.synthetic import env_args_14
from tests.errors import raises

h5py = pytest.importorskip("h5py")
pytest.importorskip("robosuite")

from warmprior.__main__ import main  # noqa: E402
from warmprior.data import DatasetError, observe_recordings, open_demonstrations  # noqa: E402
from warmprior.data.formats.hdf5 import RobomimicDemonstrations  # noqa: E402
from warmprior.tasks import Task  # noqa: E402


@pytest.fixture
def raw(lift_demonstrations, tmp_path):
    """The demonstrations as robosuite 1.4 records: states, actions and ``env_info``."""
    path = tmp_path / "demo.hdf5"
    shutil.copy(lift_demonstrations, path)
    with h5py.File(path, "a") as file:
        data = file["data"]
        for name in list(data):
            for key in list(data[name]):
                if key not in ("states", "actions"):
                    del data[name][key]
        for key in list(data.attrs):
            del data.attrs[key]
        del file["mask"]
        data.attrs["env"], data.attrs["repository_version"] = "Lift", "1.4.0"
        arm = env_args_14("lift")["env_kwargs"]["controller_configs"]
        info = {"env_name": "Lift", "robots": "Panda", "controller_configs": arm}
        data.attrs["env_info"] = json.dumps(info)
    return path


def test_observations_are_those_of_the_states(raw, lift_demonstrations, tmp_path, capsys):
    out = tmp_path / "lift.hdf5"
    assert main(["observe", str(raw), str(out), "--demonstrations", "2"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    both = RobomimicDemonstrations(out), RobomimicDemonstrations(lift_demonstrations, demos=2)
    (found, expected), indices = ([d.steps() for d in both], [d.index() for d in both])
    for fact in ("task", "observation_keys"):
        assert getattr(indices[0], fact) == getattr(indices[1], fact)
    # Sensors of objects relative to the gripper read what the control step before has cached.
    np.testing.assert_allclose(found["observation"], expected["observation"], atol=2e-3)
    np.testing.assert_array_equal(found["action"], expected["action"])
    rewards = [data["next", "reward"].flatten() for data in (found, expected)]
    assert (rewards[0] != rewards[1]).float().mean() < 0.02  # within a step of the same moment
    task = Task(open_demonstrations(out))
    assert task.name == "lift" and task.facts["demonstrations"] == 2


def test_what_cannot_be_replayed_says_so(raw, tmp_path):
    with raises(DatasetError, "observe"):
        RobomimicDemonstrations(raw).steps()
    taken = tmp_path / "taken.hdf5"
    taken.touch()
    with raises(FileExistsError, "taken.hdf5"):
        observe_recordings(raw, taken)
    with raises(FileNotFoundError, "none.hdf5"):
        observe_recordings(tmp_path / "none.hdf5", tmp_path / "out.hdf5")

    def spoilt(change, *facts):
        path = tmp_path / "spoilt.hdf5"
        shutil.copy(raw, path)
        with h5py.File(path, "a") as file:
            change(file["data"])
        with raises((DatasetError, ValueError), *facts):
            observe_recordings(path, tmp_path / "out.hdf5")
        assert not (tmp_path / "out.hdf5").exists()

    def replace(data, key, value):
        del data["demo_0"][key]
        data["demo_0"].create_dataset(key, data=value)

    steps = len(h5py.File(raw)["data/demo_0/actions"])
    spoilt(lambda data: replace(data, "states", np.zeros((steps, 71))), "demo_0", "71)", "Lift")
    spoilt(lambda data: replace(data, "actions", np.zeros((steps, 8))), "demo_0", "8)", "7]")
    spoilt(lambda data: replace(data, "states", np.full((steps, 32), np.nan)), "demo_0/states", "row 0")
    spoilt(lambda data: data["demo_0"].pop("states"), "demo_0", "states")
    spoilt(lambda data: data.attrs.pop("env_info"), "env_info")
    spoilt(lambda data: data.attrs.__setitem__("env_info", json.dumps({"env_name": "Nowhere"})), "Nowhere")


def test_a_robot_without_a_simulator(tmp_path, capsys):
    """A file of a real robot: observations under its own names, cameras, and no ``env_args``."""
    rng, path = np.random.default_rng(0), tmp_path / "kitchen.hdf5"
    with h5py.File(path, "w") as file:
        for i, n in enumerate((30, 40, 25)):
            demo = file.create_group(f"data/demo_{i}")
            demo.create_dataset("actions", data=rng.uniform(-1, 1, (n, 4)))
            demo.create_dataset("obs/joints", data=rng.normal(size=(n, 5)))
            demo.create_dataset("obs/gripper", data=rng.normal(size=(n, 1)))
            demo.create_dataset("obs/wrist_image", data=rng.integers(0, 255, (n, 24, 24, 3), dtype=np.uint8))
    task = Task(open_demonstrations(path), observations=["joints", "gripper"], images=["wrist_image"])
    assert task.images == {"wrist_image": 24} and task.vector.shape == (95, 6)
    argv = ["train", str(path), "--out", str(tmp_path / "out"), "--iterations", "2", "--hidden-dim", "8"]
    chosen = ["--observations", "joints", "gripper", "--held-out", "1"]
    assert main([*argv, *chosen]) == 0
    assert "(1)" in capsys.readouterr().out
    seen = ["--images", "wrist_image", "--encoder", "small", "--crop-size", "20"]
    assert main([*argv, *chosen, *seen, "--out", str(tmp_path / "seen")]) == 0
    for wrong in (["--observations", "legs"], ["--images", "front_image"]):
        assert main([*argv, *wrong]) == 2
        assert "legs" in (said := capsys.readouterr().err) or "front_image" in said
