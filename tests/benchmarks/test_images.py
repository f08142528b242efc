"""Policies that see images through the benchmarks: trained, played, told in rows, and loaded again."""

from __future__ import annotations

import importlib

import pytest
import torch

from tests.benchmarks.script_parts import options, refused, stored
from tests.processes import apart
from warmprior import ImageEncoder
from warmprior.data import RobomimicExperienceReplay, generate_demonstrations
from warmprior.diagnostics import encoded_windows
from warmprior.training.saved import load_policy

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

from warmprior.envs import environment_of, rendering_backend
from warmprior.envs.tasks import TaskSpec
from warmprior.experiments import success_study

pytestmark = [
    pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here"),
    pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move"),
]
IMAGES = {"obs": "image", "image_size": 16, "crop_size": 12, "encoder": "small", "iterations": 4}


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    """Not here: scripted experts need their time."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    return generate_demonstrations("lift", n=2, path=path, workers=1, progress=False)


@pytest.fixture(scope="module")
def finished(recorded, tmp_path_factory):
    robomimic = importlib.import_module("robomimic")
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARMPRIOR_CACHE", str(folder / "cache"))
        patch.setattr(success_study, "rendering_backend", lambda: None)
        patch.setattr(TaskSpec, "horizon", lambda spec, style: 9)  # episodes of two decisions
        argv = options(recorded, folder / "run", prior=["gaussian", "past", "history"], **IMAGES)
        assert robomimic.main([*argv, "--fast-rendering"]) == 0
    return folder


def test_rows_tables_and_policies_tell_that_they_saw_images(finished):
    result = stored(finished / "run")
    assert [row["obs"] for row in result["rows"]] == ["image"] * 3
    assert result["meta"]["problems"][0]["images"]["fast_rendering"] is True
    text = (finished / "run" / "table.md").read_text()
    assert "| Lift-PH, image observations, measured (file data) |" in text


def test_a_loaded_policy_decides_as_before(finished):
    """Its environment, made from what it remembers, shows it the same images."""
    folders = sorted(finished.glob("policies/**/policy_000004"))
    assert len(folders) == 3

    @apart
    def chunks(folder):
        actor = load_policy(folder)
        env = environment_of(actor, horizon=17)
        env.set_seed(3)
        torch.manual_seed(0)
        with torch.no_grad():
            return env.rollout(2, actor)["vla_action", "chunk"].numpy()

    for folder in folders:
        assert (chunks(folder) == chunks(folder)).all()


def test_diagnostics_see_what_the_encoder_makes_of_images(finished):
    (path,) = finished.glob("cache/rendered/*.hdf5")
    (folder,) = finished.glob("policies/*gaussian*/policy_000004")
    actor = load_policy(folder).eval()
    keys = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    images = ["agentview_image", "robot0_eye_in_hand_image"]
    data = RobomimicExperienceReplay(path, observation_keys=keys, image_keys=images).data[:10]
    data = actor.normalizer.normalize(data.exclude("next"))
    observation = torch.stack([data["observation"]] * 2, 1).auto_batch_size_(1)
    windows = data.select("action").set("observation", observation)
    found = encoded_windows(actor, windows, split=3)["observation"]
    encoder = next(part for part in actor.modules() if isinstance(part, ImageEncoder))
    with torch.no_grad():
        assert torch.allclose(found, encoder(observation), atol=1e-5)
    vectors = windows.copy().set("observation", found)
    assert encoded_windows(actor, vectors) is vectors


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ({"actions": "absolute"}, "--obs image goes with --actions delta"),
        ({"obs": "state", "cameras": "agentview"}, "--cameras and --fast-rendering belong to"),
        ({"crop_size": 20}, "--crop-size 20 does not fit into --image-size 16"),
        ({"prior": "forecast"}, "reads observations that are one vector"),
    ],
)
def test_what_cannot_be_is_refused(recorded, finished, tmp_path, capsys, monkeypatch, extra, said):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(finished / "cache"))
    monkeypatch.setattr("warmprior.data.render.compare_images", lambda *args: None)
    main = importlib.import_module("robomimic").main
    argv = options(recorded, tmp_path / "run", **IMAGES | {"prior": "past"} | extra)
    fast = [] if "cameras" in extra else ["--fast-rendering"]
    assert said in refused(main, [*argv, *fast], capsys)


def test_studies_measure_on_what_the_encoder_makes_of_images(
    recorded, finished, tmp_path, monkeypatch
):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(finished / "cache"))
    monkeypatch.setattr(TaskSpec, "horizon", lambda spec, style: 9)
    held_out = ["--validation", str(recorded), "--observations", "6"]
    curvature, budget = (importlib.import_module(name) for name in ("curvature", "budget"))
    flow = ["--run", str(finished / "run"), *held_out, "--steps", "3", "--out"]
    assert curvature.main([*flow, str(tmp_path / "curvature")]) == 0
    told = stored(tmp_path / "curvature")["rows"]
    assert {row["prior"] for row in told} == {"gaussian", "past", "history"}
    given = IMAGES | {"iterations": None, "budgets": [2, 4]}
    argv = options(recorded, finished / "budget", prior="past", **given)
    assert budget.main([*argv, "--fast-rendering", *held_out]) == 0
    assert all(row["action_error"] > 0 for row in stored(finished / "budget")["rows"])
