"""Raw recordings of robosuite, against the observations of the demonstrations that they were made of."""

import json
import shutil

import numpy as np
import pytest

from tests.data.synthetic import env_args_14
from tests.errors import raises, refuses

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


def test_what_cannot_be_replayed_says_so(raw, tmp_path, monkeypatch):
    refuses(lambda: RobomimicDemonstrations(raw).steps(), DatasetError, "observe")
    taken = tmp_path / "taken.hdf5"
    taken.touch()
    refuses(lambda: observe_recordings(raw, taken), FileExistsError, "taken.hdf5")
    with raises(FileNotFoundError, "none.hdf5"):
        observe_recordings(tmp_path / "none.hdf5", tmp_path / "out.hdf5")

    def spoilt(change, *facts):
        path = tmp_path / "spoilt.hdf5"
        shutil.copy(raw, path)
        with h5py.File(path, "a") as file:
            change(file["data"])
        refuses(lambda: observe_recordings(path, tmp_path / "out.hdf5"), (DatasetError, ValueError), *facts)
        assert not (tmp_path / "out.hdf5").exists()

    def replace(data, key, value):
        del data["demo_0"][key]
        data["demo_0"].create_dataset(key, data=value)

    steps = len(h5py.File(raw)["data/demo_0/actions"])
    spoilt(lambda data: replace(data, "states", np.zeros((steps, 71))), "demo_0", "71)", "Lift")
    spoilt(lambda data: replace(data, "actions", np.zeros((steps, 8))), "demo_0", "8)", "7]")
    spoilt(lambda data: replace(data, "states", np.full((steps, 32), np.nan)), "demo_0/states", "row 0")
    spoilt(lambda data: data["demo_0"].pop("states"), "demo_0", "states")
    with monkeypatch.context() as patched:
        patched.setattr("warmprior.data.observe.scene_stays", lambda env: False)
        spoilt(lambda data: None, "spoilt.hdf5", "Lift", "fixtures")
    spoilt(lambda data: data.attrs.pop("env_info"), "env_info")
    spoilt(lambda data: data.attrs.__setitem__("env_info", json.dumps({"env_name": "Nowhere"})), "Nowhere")
