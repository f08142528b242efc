import errno
import shutil
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("robosuite")

import h5py

from lab.demonstrations import render as render_module
from lab.demonstrations.render import render_demonstrations
from tests.data.synthetic import shortened
from tests.errors import missing, raises, refuses
from tests.processes import apart, here
from warmprior.__main__ import main
from warmprior.data import DatasetError
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.image_check import check_images
from warmprior.envs import RobosuiteEnv, rendering_backend

pytestmark = pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")

CAMERAS = ("agentview", "robot0_eye_in_hand")
IMAGES = [f"{camera}_image" for camera in CAMERAS]
STEPS = 4
OPTIONS = {"size": 16, "fast": True}


@apart
def render(*args, **options):
    with patch.object(render_module, "working", here):
        return render_demonstrations(*args, **OPTIONS, **options)


@pytest.fixture(scope="module")
def recorded(lift_demonstrations, tmp_path_factory):
    """Two scripted demos of lift, cut to a few steps."""
    path = tmp_path_factory.mktemp("recorded") / "lift.hdf5"
    return shortened(lift_demonstrations, path, STEPS)


@pytest.fixture(scope="module")
def rendered(recorded):
    return render(recorded, CAMERAS, out=recorded.with_name("rendered.hdf5"))


@pytest.fixture
def copy(recorded, tmp_path):
    return Path(shutil.copy(recorded, tmp_path / "lift.hdf5"))


@pytest.fixture
def picture(rendered, tmp_path):
    return Path(shutil.copy(rendered, tmp_path / "images.hdf5"))


def images_of(path):
    with h5py.File(path) as file:
        return {f"{name}/{key}": demo["obs"][key][:] for name, demo in file["data"].items() for key in IMAGES}


@apart
def replayed(path):
    env = RobosuiteEnv("lift", fast_rendering=True)
    env.reset()
    found = {}
    with h5py.File(path) as file:
        for name, demo in file["data"].items():
            for camera in CAMERAS:
                frames = [env.render_frame(camera, 16, state) for state in demo["states"]]
                found[f"{name}/{camera}_image"] = np.stack(frames)
            poses = []
            for state in demo["states"]:
                env._env.sim.set_state_from_flattened(state)
                env._env.sim.forward()
                seen = env._env._get_observations(force_update=True)
                poses.append(np.concatenate([seen["robot0_eef_pos"], seen["cube_pos"]]))
            found[name] = np.stack(poses)
    return found


def test_images_are_those_of_the_recorded_states(recorded, rendered):
    images, expected = images_of(rendered), replayed(recorded)
    for name, value in images.items():
        np.testing.assert_array_equal(value, expected[name])
    with h5py.File(recorded) as file:
        for name, demo in file["data"].items():
            stored = np.column_stack([demo["obs/robot0_eef_pos"], demo["obs/object"][:, :3]])
            np.testing.assert_allclose(expected[name], stored, atol=2e-3)  # 2 ms of motion at most


def test_the_layout_is_robomimics(recorded, rendered):
    with h5py.File(recorded) as before, h5py.File(rendered) as after:
        assert before["mask"].keys() == after["mask"].keys()
        for name, demo in after["data"].items():
            assert demo.attrs["num_samples"] == STEPS and "next_obs" not in demo
            for key in ("actions", "rewards", "states"):
                np.testing.assert_array_equal(demo[key], before["data"][name][key])
            for key in before["data"][name]["obs"]:
                np.testing.assert_array_equal(demo["obs"][key], before["data"][name]["obs"][key])
            for key in IMAGES:
                assert demo["obs"][key].dtype == np.uint8
                assert demo["obs"][key].chunks == (1, 16, 16, 3)
        kwargs = RobomimicDemonstrations(rendered).index().env_args["env_kwargs"]
    assert (kwargs["camera_names"], kwargs["camera_heights"]) == (list(CAMERAS), 16)


@pytest.mark.slow
def test_images_do_not_depend_on_the_number_of_workers(recorded, rendered, tmp_path):
    found = render_demonstrations(recorded, CAMERAS, out=tmp_path / "two.hdf5", workers=2, **OPTIONS)
    expected = images_of(rendered)
    for name, value in images_of(found).items():
        np.testing.assert_array_equal(value, expected[name])


@pytest.mark.slow
def test_what_is_finished_outlives_a_full_disk(copy, rendered, monkeypatch):
    """And is not rendered again; what was there before stays until the new file is complete."""
    before = copy.read_bytes()
    write_atomic = render_module.write_atomic

    def full(path, write):
        if "demo_0" not in path.name:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_atomic(path, write)

    with monkeypatch.context() as patch, raises(OSError, "No space left"):
        patch.setattr(render_module, "write_atomic", full)
        render(copy, CAMERAS, out=copy)
    assert copy.read_bytes() == before
    (part,) = copy.parent.glob("*.parts/demo_0.npz")
    with np.load(part) as images:
        marked = {name: np.full_like(images[name], 7) for name in images}
    np.savez(part, **marked)
    assert render(copy, CAMERAS, out=copy) == copy
    assert not list(copy.parent.glob("*.parts"))
    images, expected = images_of(copy), images_of(rendered)
    for key in IMAGES:
        assert (images[f"demo_0/{key}"] == 7).all(), "a finished demo was rendered again"
        np.testing.assert_array_equal(images[f"demo_1/{key}"], expected[f"demo_1/{key}"])


def test_images_beyond_any_memory_are_refused(copy):
    refuses(lambda: render_demonstrations(copy, CAMERAS, 10**9), ValueError, "1000000000")
    assert not list(copy.parent.glob("*.hdf5.*"))


def of_another_environment(file):
    del file["data/demo_0/states"]
    file["data/demo_0/states"] = np.zeros((STEPS, 45))


def not_a_number(file):
    file["data/demo_0/states"][2, 5] = np.nan


@pytest.mark.parametrize(
    ("change", "facts"),
    [(not_a_number, ("nan", "row 2")), (of_another_environment, ("(4, 45)", "Lift", "(4, 32)"))],
)
def test_states_that_cannot_be_rendered_are_refused(copy, change, facts):
    with h5py.File(copy, "a") as file:
        change(file)
    refuses(lambda: render(copy, CAMERAS[:1], out=copy), DatasetError, "states", *facts)
    assert not list(copy.parent.glob("*.hdf5.*/*"))


def replaced(path, value, key=f"data/demo_1/obs/{IMAGES[0]}"):
    with h5py.File(path, "a") as file:
        stored = file[key][:]
        del file[key]
        if value is not None:
            file[key] = value(stored)


@pytest.mark.parametrize(
    ("value", "facts"),
    [
        (lambda images: images / 255, ("float64", "uint8")),
        (lambda images: images[..., :2], ("(4, 16, 16, 2)", "uint8")),
        (lambda images: images[:3], ("(3, 16, 16, 3)", "(4, height")),
        (lambda images: images[:, :8], ("agentview_image", "(8, 16)", "(16, 16)")),
        (None, ("'agentview_image'", "robot0_eye_in_hand_image")),
    ],
)
def test_images_of_another_kind_are_refused(picture, value, facts):
    replaced(picture, value)
    with raises(DatasetError, "data/demo_1", *facts):
        RobomimicDemonstrations(picture).steps(images=IMAGES)


@pytest.mark.slow
def test_images_upside_down_are_refused(picture):
    key = f"data/demo_0/obs/{IMAGES[0]}"
    demonstrations = RobomimicDemonstrations(picture)
    compare = partial(apart(check_images), demonstrations, demonstrations.index(images=IMAGES))
    compare(fast=True)
    refuses(lambda: compare(fast=False), DatasetError, "fast_rendering=True")
    changes = {
        "upside down": lambda images: images[:, ::-1],
        "red and blue": lambda images: images[..., ::-1],
        "something else": lambda images: 255 - images,
    }
    with h5py.File(picture) as file:
        before = file[key][()]
    for fact, change in changes.items():
        replaced(picture, lambda images, change=change: change(before), key)
        refuses(lambda: compare(fast=True), DatasetError, "agentview", fact)


@pytest.mark.parametrize("lacking", ["EGL", "MyKitchen", "states"])
def test_images_that_cannot_be_compared_are_taken_with_a_warning(picture, monkeypatch, lacking):
    replaced(picture, lambda images: images[:, ::-1], f"data/demo_0/obs/{IMAGES[0]}")
    if lacking == "EGL":  # as on many servers with GPUs
        monkeypatch.setattr("warmprior.envs.rendering.rendering_backend", lambda: None)
    elif lacking == "states":
        replaced(picture, None, "data/demo_0/states")
    else:
        with h5py.File(picture, "a") as file:
            attributes = file["data"].attrs
            attributes["env_args"] = attributes["env_args"].replace('"Lift"', f'"{lacking}"')
    with pytest.warns(UserWarning, match=f"{picture.name}.*{lacking}"):
        demonstrations = RobomimicDemonstrations(picture)
        check_images(demonstrations, demonstrations.index(images=IMAGES), fast=True)


def test_a_policy_trains_from_images_where_nothing_renders(picture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("warmprior.envs.rendering.rendering_backend", lambda: None)
    small = (
        "--encoder small --crop-size 12 --network mlp,hidden_dim=8 --iterations 1 --batch-size 2 --held-out 0"
    )
    argv = f"train {picture} --fast-rendering --out {tmp_path / 'out'} {small} --images".split()
    with pytest.warns(UserWarning, match=picture.name):
        assert main([*argv, *IMAGES]) == 0
    assert not missing(capsys.readouterr().out, "EGL", "only trained")
    assert list(tmp_path.glob("out/*/policy_000001/model.safetensors"))
