"""Policies that see images through the benchmarks: trained, played, named in rows, and loaded again."""

from __future__ import annotations

import pytest
import torch

from tests.benchmarks.script_parts import described, options, refused, stored
from tests.processes import apart
from warmprior import ImageEncoder
from warmprior.data import RobomimicExperienceReplay, generate_demonstrations
from warmprior.diagnostics import encoded_windows
from warmprior.training import load_policy

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import budget
import curvature
import robomimic

from warmprior.envs import environment_of, rendering_backend
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

    for folder in folders[:2]:  # one that sees the history, and one that does not
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
        ({"crop_size": 20}, "--crop-size 20 must be at least 8 and at most --image-size 16"),
        ({"prior": "forecast"}, "reads observations that are one vector"),
        ({"prior": "ot"}, "ot reads observations that are one vector"),
    ],
)
def test_what_cannot_be_is_refused(recorded, no_work, tmp_path, capsys, extra, said):
    argv = options(recorded, tmp_path / "run", **IMAGES | {"prior": "past"} | extra)
    assert said in refused(robomimic.main, [*argv, *([] if "cameras" in extra else FAST)], capsys)


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
