"""Policies that see images through the benchmarks: trained, played, named in rows, and loaded again."""

from __future__ import annotations

import pytest

from tests.benchmarks.script_parts import described, options, stored
from tests.processes import apart
from warmprior.data import generate_demonstrations

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import budget
import curvature
import robomimic

from warmprior.envs import rendering_backend
from warmprior.envs.tasks import TaskSpec

pytestmark = [
    pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here"),
    pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move"),
]
IMAGES = {"obs": "image", "image_size": 16, "crop_size": 12, "encoder": "small", "iterations": 4}
FAST = ["--fast-rendering"]


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    """Not here: scripted experts need their time."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    return generate_demonstrations("lift", n=2, path=path, workers=1, progress=False)


@pytest.fixture(scope="module")
def finished(inline, recorded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARMPRIOR_CACHE", str(folder / "cache"))
        patch.setattr(TaskSpec, "horizon", lambda spec, style: 9)  # episodes of two decisions
        argv = options(recorded, folder / "run", prior=["gaussian", "past", "history"], **IMAGES)
        assert apart(robomimic.main)([*argv, *FAST]) == 0
    return folder


def test_rows_and_tables_say_that_images_were_seen(finished):
    assert [row["obs"] for row in stored(finished / "run")] == ["image"] * 3
    assert described(finished / "run", "tasks")[0]["images"]["fast_rendering"] is True
    text = (finished / "run" / "report.md").read_text()
    assert "| Lift-PH, image observations, measured (file data) |" in text


def test_studies_measure_on_what_the_encoder_makes_of_images(recorded, finished, tmp_path, monkeypatch):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(finished / "cache"))
    monkeypatch.setattr(TaskSpec, "horizon", lambda spec, style: 9)
    held_out = ["--validation", str(recorded), "--observations", "6"]
    flow = ["--run", str(finished / "run"), *held_out, "--steps", "3", "--out"]
    assert apart(curvature.main)([*flow, str(tmp_path / "curvature")]) == 0
    seen = stored(tmp_path / "curvature", "curvature")
    assert {row["prior"] for row in seen} == {"gaussian", "past", "history"}
    given = IMAGES | {"iterations": None, "budgets": [2, 4]}
    argv = options(recorded, finished / "budget", prior="past", **given)
    assert apart(budget.main)([*argv, *FAST, *held_out]) == 0
    assert all(row["action_error"] > 0 for row in stored(finished / "budget"))
