"""Recorded images against those of a simulator, whose renderer here shows one picture."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest

pytest.importorskip("robosuite")

from tests.errors import raises
from warmprior.data import DatasetError, image_check
from warmprior.data.formats.hdf5 import RobomimicDemonstrations

SHOWN = np.random.default_rng(0).integers(0, 256, (8, 8, 3)).astype(np.uint8)
KEY = "data/demo_0/obs/agentview_image"


def put(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def image(picture):
    return put(KEY, np.stack([picture] * 12))


CHANGES = {
    "none": (lambda file: None, None),
    "states": (put("data/demo_0/states", np.zeros((12, 44))), ["(1, 44)", "(1, 45)", "NutAssemblySquare"]),
    "upside down": (image(SHOWN[::-1]), ["agentview", "upside down"]),
    "colours": (image(SHOWN[..., ::-1]), ["agentview", "red and blue"]),
    "another scene": (image(255 - SHOWN), ["agentview", "something else"]),
    "quality": (lambda f: f["data"].attrs.update(rendering='{"fast": true}'), ["fast_rendering=True"]),
    "fixtures": (lambda file: None, ["moves fixtures"]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_images_are_those_of_the_simulator_or_refused(square_file, monkeypatch, name):
    path, _ = square_file
    change, facts = CHANGES[name]
    with h5py.File(path, "a") as file:
        image(SHOWN)(file)
        change(file)
    model = SimpleNamespace(nq=30, nv=14)
    renderer = SimpleNamespace(model=model, render=lambda camera, joints: SHOWN)
    simulator = SimpleNamespace(sim=SimpleNamespace(model=SimpleNamespace(_model=model)))
    monkeypatch.setattr(image_check, "make_simulator", lambda env_args: simulator)
    monkeypatch.setattr(image_check, "scene_stays", lambda env: name != "fixtures")
    monkeypatch.setattr(image_check, "CameraRenderer", lambda *args, **options: renderer)
    demonstrations = RobomimicDemonstrations(path)
    index = demonstrations.index(images=["agentview_image"])
    if facts is None:
        image_check.check_images(demonstrations, index, fast=False)
    else:
        with raises(DatasetError, path.name, *facts):
            image_check.check_images(demonstrations, index, fast=False)
