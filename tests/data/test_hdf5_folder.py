"""A folder of HDF5 files: one place, in the order of the files' names."""

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from lab.demonstrations.data_options import DataOptions
from lab.demonstrations.loading import load_task
from tests.data.synthetic import write_robomimic_file
from tests.data.test_recorded_actions import write as write_actions
from tests.errors import missing, raises, refuses
from warmprior.__main__ import main
from warmprior.data import DatasetError, open_demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.envs.robosuite_tasks import get_task
from warmprior.tasks import Task

LENGTHS = {"monday": (6, 4), "friday": (9,), "sunday": (5, 3, 7)}
ORDER = ("friday", "monday", "sunday")


@pytest.fixture
def sessions(tmp_path):
    """The folder, and the arrays of all demonstrations in the order of its files."""
    folder, demos = tmp_path / "sessions", {}
    folder.mkdir()
    for seed, (name, lengths) in enumerate(LENGTHS.items()):
        masks = {"train": range(0, len(lengths), 2)}
        demos[name] = write_robomimic_file(folder / f"{name}.hdf5", lengths, seed=seed, masks=masks)
    (folder / "notes.txt").write_text("no recording")
    return folder, [demo for name in ORDER for demo in demos[name]]


def check(data, demos):
    keys = get_task("square").low_dim_keys
    seen = np.concatenate([np.concatenate([demo[key] for key in keys], -1) for demo in demos])
    np.testing.assert_allclose(data["observation"], seen, rtol=1e-6)
    np.testing.assert_allclose(data["action"], np.concatenate([demo["actions"] for demo in demos]), rtol=1e-6)
    lengths = [len(demo["actions"]) for demo in demos]
    assert data["episode"].bincount().tolist() == lengths
    assert data["next", "done"].nonzero()[:, 0].tolist() == (np.cumsum(lengths) - 1).tolist()


def test_the_demonstrations_of_all_files_are_numbered_through(sessions):
    folder, demos = sessions
    check(open_demonstrations(folder).steps(), demos)
    check(open_demonstrations(f"{folder}/", demos=2).steps(), demos[:2])
    # Of each session the first demonstration, and of the last one the third.
    check(open_demonstrations(folder, mask="train").steps(), [demos[i] for i in (0, 1, 3, 5)])
    refuses(lambda: open_demonstrations(folder, demos=7).index(), DatasetError, "6 demonstrations", "demos=7")
    assert main(["train", str(folder / "absent")]) == 2


def test_images_are_read_from_every_file(sessions):
    folder, _ = sessions
    for value, path in enumerate(sorted(folder.glob("*.hdf5"))):
        with h5py.File(path, "a") as file:
            for demo in file["data"].values():
                demo["obs/agentview_image"][...] = value
    data = open_demonstrations(folder).steps(images=["agentview_image"])
    steps = [sum(LENGTHS[name]) for name in ORDER]
    assert (
        data["observation", "agentview_image"].amax((1, 2, 3)).tolist() == np.repeat(range(3), steps).tolist()
    )


def test_a_folder_is_a_place_of_train_and_of_benchmarks(sessions, tmp_path, monkeypatch, capsys):
    folder, _ = sessions
    task = load_task(DataOptions(dataset=folder), None)
    assert (task.name, task.facts["file"], task.facts["demonstrations"]) == ("square", "sessions", 6)
    assert load_task(DataOptions(dataset=folder, demonstrations=(5,)), None).identity != task.identity
    monkeypatch.chdir(folder)
    assert Task(open_demonstrations(".")).identity == task.identity
    words = f"train . --iterations 1 --network mlp,hidden_dim=8 --out {tmp_path}"
    assert main(words.split()) == 0
    assert "sessions: 6 demonstrations, 34 steps" in capsys.readouterr().out
    (folder / "sunday.hdf5").rename(folder / "tuesday.hdf5")
    assert Task(open_demonstrations(folder)).identity == task.identity
    (folder / "tuesday.hdf5").rename(folder / "again.hdf5")
    assert Task(open_demonstrations(folder)).identity != task.identity


def without(name):
    def change(file):
        for demo in file["data"].values():
            del demo[name]

    return change


def wider(name):
    def change(file):
        for demo in file["data"].values():
            values = demo[name][()]
            del demo[name]
            demo[name] = np.zeros((len(values), 10, 10, 3), np.uint8)

    return change


def other_rate(file):
    text = file["data"].attrs["env_args"]
    assert '"control_freq": 20' in text
    file["data"].attrs["env_args"] = text.replace('"control_freq": 20', '"control_freq": 10')


def other_rate_without_environment(file):
    for path in Path(file.filename).parent.glob("*.hdf5"):
        if path.name == "monday.hdf5":
            with h5py.File(path, "a") as other:
                del other["data"].attrs["env_args"]
                other["data"].attrs["control_freq"] = 20
    del file["data"].attrs["env_args"]
    file["data"].attrs["control_freq"] = 10


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (without("rewards"), ["rewards", "False"]),
        (other_rate, ["env_args", "monday.hdf5"]),
        (other_rate_without_environment, ["control_freq", "10 ", " 20", "monday.hdf5"]),
        (wider("obs/agentview_image"), ["image_shapes", "(10, 10)", "(8, 8)"]),
        (without("obs/object"), ["'object'"]),
    ],
)
def test_the_file_that_differs_is_named(sessions, change, facts):
    folder, _ = sessions
    with h5py.File(folder / "sunday.hdf5", "a") as file:
        change(file)
    (folder / "friday.hdf5").unlink()
    with raises(DatasetError, "sunday.hdf5", *facts):
        open_demonstrations(folder).index(images=["agentview_image"])


def test_a_file_that_names_no_rate_has_that_of_the_others(sessions):
    folder, _ = sessions
    for rate, path in zip((None, 25, None, 25), sorted(folder.glob("*.hdf5")), strict=False):
        with h5py.File(path, "a") as file:
            del file["data"].attrs["env_args"]
            if rate is not None:
                file["data"].attrs["control_freq"] = rate
    assert open_demonstrations(folder).index().rate == 25


def test_poses_beside_deltas_are_refused(tmp_path):
    write_actions(tmp_path / "low_dim.hdf5")
    write_actions(tmp_path / "low_dim_abs.hdf5", stored="rotvec")
    with raises(DatasetError, "low_dim_abs.hdf5", "poses", "low_dim.hdf5"):
        open_demonstrations(tmp_path).steps(actions="absolute")
    both = open_demonstrations(tmp_path).steps(actions="stored")["action"]
    each = [
        RobomimicDemonstrations(path).steps(actions="stored")["action"] for path in sorted(tmp_path.iterdir())
    ]
    np.testing.assert_array_equal(both, np.concatenate(each))


def test_a_folder_without_recordings(tmp_path, capsys):
    assert main(["train", str(tmp_path)]) == 2
    assert not missing(capsys.readouterr().err, tmp_path, "*.hdf5", f"lerobot:{tmp_path}")


def test_files_with_other_usual_endings_are_read_too(sessions):
    folder, demos = sessions
    (folder / "monday.hdf5").rename(folder / "monday.h5")
    (folder / "sunday.hdf5").rename(folder / "sunday.HDF5")
    check(open_demonstrations(folder).steps(), demos)


def test_what_is_not_read_of_a_folder_is_left_out_by_name(sessions, tmp_path, capsys):
    folder, _ = sessions
    for name in ("old/monday.hdf5", "old/sunday.H5", "spare/friday.hdf5"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / "friday.hdf5", folder / name)
    (folder / "empty").mkdir()
    shutil.copy(folder / "friday.hdf5", folder / "friday.backup")
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to(folder)
    (folder / "notes").symlink_to("/nowhere")
    place, others = open_demonstrations(folder), ["friday.backup", "old/ with 2 files", "spare/ with 1 file"]
    assert place.recording(place.index()).left_out[""] == others
    assert Task(place).recording.left_out[""] == others
    words = f"train {folder} --iterations 1 --network mlp,hidden_dim=8 --out {tmp_path}"
    assert main(words.split()) == 0
    assert not missing(capsys.readouterr().out, *others)
    for number in range(8):
        shutil.copy(folder / "friday.hdf5", folder / f"friday{number}.backup")
    named = place.recording(place.index()).left_out[""]
    assert len(named) == 6 and named[-1] == "6 more"


def test_what_may_not_be_looked_at_is_not_needed(sessions, monkeypatch):
    folder, _ = sessions
    (folder / "secret").touch()

    def forbidden(path):
        raise PermissionError(path)

    monkeypatch.setattr(h5py, "is_hdf5", forbidden)
    place = open_demonstrations(folder)
    assert "" not in place.recording(place.index()).left_out


def test_a_folder_of_folders_names_them(sessions, capsys):
    folder, _ = sessions
    assert main(["train", str(folder.parent)]) == 2
    assert not missing(capsys.readouterr().err, folder.parent, "sessions/ with 3 files")


def more(name, value):
    def change(file):
        for demo in file["data"].values():
            demo[name] = np.full((len(demo["actions"]), 2), value)

    return change


def test_what_only_some_files_have_is_left_out_by_name(sessions):
    folder, _ = sessions
    with h5py.File(folder / "sunday.hdf5", "a") as file:
        more("obs/force", 1.0)(file)
        without("obs/agentview_image")(file)
    place = open_demonstrations(folder)
    left = {"": ["agentview_image", "force"], "observations": ["robot0_eef_vel_lin"]}
    assert place.index().left_out == left
    for options, fact in (
        ({"observations": ["force"]}, "'force'"),
        ({"images": ["agentview_image"]}, "images"),
    ):
        with raises(DatasetError, fact):
            place.index(**options)
