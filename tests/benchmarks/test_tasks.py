import os
import runpy
import sys
from pathlib import Path

import mimicgen_tasks
import pytest
import robomimic
import torch

from lab.demonstrations.data_options import DataOptions
from lab.demonstrations.loading import load_task
from lab.options.options import Options, with_parts
from lab.options.stored_options import stored_options
from lab.running.policies import policies_of
from tests.benchmarks.script_parts import described, flow, options, refused, stored
from tests.data.synthetic import env_args_14, shortened, write_robomimic_file
from tests.envs.mimicgen_stub import write_mimicgen
from tests.errors import raises
from tests.processes import apart, here
from warmprior import ImageEncoder
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.diagnostics import encoded_windows
from warmprior.envs import environment_of, rendering_backend
from warmprior.envs.robosuite_tasks import TASKS, TaskSpec
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


def test_observations_of_a_file_are_chosen(dataset):
    options = DataOptions(dataset=dataset, observations=("robot0_eef_pos", "object"))
    task, usual = load_task(options, None), load_task(DataOptions(dataset=dataset), None)
    assert task.data["observation"].shape[-1] == 3 + TASKS["lift"].object_dim
    assert task.make_env().reset()["observation"].shape == task.data["observation"].shape[1:]
    assert task.identity != usual.identity


def test_joints_are_the_observation_that_is_named(dataset):
    """Which deltas are not near: the hand's position follows the object's numbers."""
    with raises(ValueError, "lift", f"number {TASKS['lift'].object_dim + 1} of the observation"):
        load_task(DataOptions(dataset=dataset, joints="robot0_eef_pos"), None)


def test_the_preset_of_the_public_code_from_training_to_report(dataset, tmp_path, capfd):
    small = {"batch_size": 16, "iterations": 6, "checkpoints": 1, "seeds": 1, "top_k": 1}
    network = "chi_transformer,observation_layers=2,time_frequency=1e-4,hidden_dim=12"
    few = {"preset": "much-ado", "horizon": 24, "prior": "past", "network": network, **small}
    out = tmp_path / "run"
    assert robomimic.main(options(dataset, out, **few)) == 0
    (row,) = stored(out)
    # Three chunks, which solve nothing.
    assert (row["temperature"], row["actions"], row["mean_steps"]) == (0.0, "absolute", 24.0)
    report = (out / "report.md").read_text()
    assert "horizon 24 (None)" in report and "count padding True (False)" in report
    folder = tmp_path / "policies" / row["policy"]
    policy = load_policy(folder / "policy_000006")
    assert policy.network.action_dim == 10 and "Lift-PH, absolute actions" in report
    assert policy.network.config().items() >= {"observation_layers": 2, "time_frequency": 1e-4}.items()
    assert environment_of(policy).horizon == 24
    recipe = load_state(folder / "state.safetensors")[1]["identity"]["config"]
    assert recipe.items() >= {"max_grad_norm": 100.0, "count_padding": True, "warmup_ratio": 0.0}.items()
    # Its run goes on with what it says, and with nothing else.
    for path in (out / "results.jsonl", folder / "policy_000006" / "model.safetensors"):
        path.unlink()
    argv = ["--resume", "--out", str(out)]
    said = refused(robomimic.main, [*argv, "--max-grad-norm", "10", "--no-count-padding"], capfd)
    assert "--count-padding, --max-grad-norm" in said
    assert robomimic.main(argv) == 0
    (again,) = stored(out)
    assert again | {"training_seconds": None} == row | {"training_seconds": None}
    # Runs of another time limit share the policy, and play it to their own.
    mine = with_parts(stored_options(Options, out, "robomimic"), run={"out": out})
    for limit, steps in ((24, 24), (None, 40)):
        (shared,) = policies_of(with_parts(mine, data={"horizon": limit}))
        assert shared.name == row["policy"] and environment_of(shared.load()).horizon == steps
        assert shared.task().make_env().horizon == steps


@pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")
def test_images_are_seen_through_the_encoder(lift_demonstrations, tmp_path, monkeypatch):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(TaskSpec, "horizon", lambda spec, style: 9)  # episodes of two decisions
    monkeypatch.setattr("lab.demonstrations.render.working", here)
    few = {"obs": "image", "image_size": 16, "crop_size": 12, "encoder": "small", "iterations": 4}
    file = shortened(lift_demonstrations, tmp_path / "lift.hdf5", 12)
    argv = options(file, tmp_path / "run", prior=["gaussian", "history"], **few)

    def both():  # as one process, which reads the task once
        assert robomimic.main([*argv, "--fast-rendering"]) == 0
        return flow(tmp_path / "run", file)

    measured = apart(both)()
    assert [row["obs"] for row in stored(tmp_path / "run")] == ["image"] * 2
    assert described(tmp_path / "run", "tasks")[0]["images"]["fast_rendering"] is True
    assert "Lift-PH, image observations" in measured and "| History |" in measured
    # By hand: the encoder's features of raw images stand in place of them.
    (path,) = tmp_path.glob("cache/rendered/*.hdf5")
    (folder,) = tmp_path.glob("policies/*gaussian*/policy_000004")
    actor = load_policy(folder).eval()
    names = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    cameras = ["agentview_image", "robot0_eye_in_hand_image"]
    data = RobomimicDemonstrations(path).steps(observations=names, images=cameras)[:10]
    data = actor.normalizer.normalize(data.exclude("next"))
    observation = torch.stack([data["observation"]] * 2, 1).auto_batch_size_(1)
    windows = data.select("action").set("observation", observation)
    encoder = next(part for part in actor.modules() if isinstance(part, ImageEncoder))
    with torch.no_grad():
        found = encoded_windows(actor, windows, split=3)["observation"]
        torch.testing.assert_close(found, encoder(observation), atol=1e-5, rtol=0)


def start(script, argv, site):
    """Run a script as from a shell, with a package in this folder; what is not ours was imported before.

    Its workers are fresh processes, and know no patches.
    """
    ours = {"warmprior", "lab", *(path.stem for path in script.parent.glob("*.py"))}
    for name in [name for name in sys.modules if name.split(".")[0] in ours]:
        del sys.modules[name]
    found = [str(script.parent), str(script.parents[1]), str(site)]
    before = filter(None, [os.environ.get("PYTHONPATH")])
    os.environ["PYTHONPATH"] = os.pathsep.join([*found[1:], *before])
    sys.path[:], sys.argv[:] = [*found, *sys.path], [str(script), *argv]
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    return ended.value.code


def test_a_file_in_mimicgens_environment(tmp_path, monkeypatch):
    """The package is not taken for the script, nor is it missed by workers.

    Rows do not depend on the processes that compute them: those of fresh ones are those of this one.
    """
    site, file, out = (tmp_path / name for name in ("site", "stack.hdf5", "out"))
    write_mimicgen(site)
    write_robomimic_file(file, lengths=(30, 20, 9), task="stack_d0", env_args=env_args_14("stack_d0"))
    few = {"task": None, "prior": "past", "demonstrations": 2, "horizon": 9, "iterations": 4}
    argv = [*options(file, out, **few), "--no-videos"]
    assert apart(start)(Path(mimicgen_tasks.__file__), argv, site) == 0
    (row,), (task,) = stored(out), described(out, "tasks")
    assert (row["task"], row["data"]) == ("stack_d0", "source")
    assert (task["demonstrations"], task["steps"]) == (2, 50)
    monkeypatch.syspath_prepend(site)
    assert apart(mimicgen_tasks.main)(options(file, tmp_path / "mine" / "out", **few)) == 0
    (mine,) = stored(tmp_path / "mine" / "out")
    assert mine | {"training_seconds": None} == row | {"training_seconds": None}
