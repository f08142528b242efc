import os
import subprocess
import sys
from pathlib import Path

import curvature
import mimicgen_tasks
import pusht
import pytest
import robomimic
import torch

from lab.options import Options, with_parts
from lab.policies import policies_of
from lab.stored_options import stored_options
from lab.tasks import DataOptions
from tests.benchmarks.script_parts import command_line, described, options, refused, stored, written
from tests.data.synthetic import env_args_14, write_robomimic_file
from tests.envs.mimicgen_stub import write_mimicgen
from tests.errors import raises
from tests.processes import apart
from warmprior import ImageEncoder
from warmprior.data import DatasetError, convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.diagnostics import encoded_windows
from warmprior.envs import environment_of, rendering_backend
from warmprior.envs.tasks import TaskSpec
from warmprior.saving import load_policy
from warmprior.saving.checkpoint import load_state

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


def flow(run, validation, **more):
    few = {"run": run, "validation": validation, "out": f"{run}-flow", "observations": 6}
    assert curvature.main(command_line(**few | more)) == 0
    return Path(f"{run}-flow", "report.md").read_text()


def test_absolute_actions_are_named_and_lie_beside_the_others(dataset, validation, tmp_path):
    for actions in ("absolute", "delta"):
        argv = options(dataset, tmp_path / actions, prior="past", actions=actions)
        assert robomimic.main(argv) == 0
    (absolute,), (delta,) = (stored(tmp_path / name) for name in ("absolute", "delta"))
    assert absolute["actions"] == "absolute" and "actions" not in delta
    assert "Lift-PH, absolute actions" in (tmp_path / "absolute" / "report.md").read_text()
    paths = [tmp_path / "policies" / row["policy"] / "policy_000030" for row in (absolute, delta)]
    assert [load_policy(path).network.action_dim for path in paths] == [10, 7]
    # What reads the run later knows it as well.
    assert "Lift-PH, absolute actions" in flow(tmp_path / "absolute", validation)


def test_the_preset_of_the_public_code_from_training_to_report(dataset, tmp_path, capfd):
    small = {"hidden_dim": 12, "batch_size": 16, "iterations": 6, "checkpoints": 1, "seeds": 1, "top_k": 1}
    few = {"preset": "much-ado", "horizon": 24, "prior": "past", **small}
    out = tmp_path / "run"
    assert robomimic.main(options(dataset, out, **few)) == 0
    (row,) = stored(out)
    # Three chunks, which solve nothing.
    assert (row["temperature"], row["actions"], row["mean_steps"]) == (0.0, "absolute", 24.0)
    report = (out / "report.md").read_text()
    assert "horizon 24 (None)" in report and "count padding True (False)" in report
    folder = tmp_path / "policies" / row["policy"]
    policy = load_policy(folder / "policy_000006")
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
    few = {"obs": "image", "image_size": 16, "crop_size": 12, "encoder": "small", "iterations": 4}
    argv = options(lift_demonstrations, tmp_path / "run", prior=["gaussian", "history"], **few)
    assert apart(robomimic.main)([*argv, "--fast-rendering"]) == 0
    assert [row["obs"] for row in stored(tmp_path / "run")] == ["image"] * 2
    assert described(tmp_path / "run", "tasks")[0]["images"]["fast_rendering"] is True
    measured = apart(flow)(tmp_path / "run", lift_demonstrations)
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


def test_results_of_a_lerobot_dataset_are_those_of_the_file(dataset, tmp_path, monkeypatch):
    pytest.importorskip("lerobot")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    place = f"lerobot:{convert_robomimic(dataset, tmp_path / 'lift')}"
    for name, data in (("file", dataset), ("lerobot", place)):
        few = {"prior": "past", "iterations": 10, "task": None}
        assert robomimic.main(options(data, tmp_path / name, **few)) == 0
    (mine,), (theirs,) = (stored(tmp_path / name) for name in ("lerobot", "file"))
    assert {k for k in mine if mine[k] != theirs[k]} <= {"policy", "training_seconds"}
    facts, others = (described(tmp_path / name, "tasks")[0] for name in ("lerobot", "file"))
    assert {k for k in facts if facts[k] != others[k]} == {"file", "sha256"}
    # Found again from another working directory, and by the other benchmarks.
    before = written(tmp_path / "policies")
    monkeypatch.chdir(tmp_path)
    assert robomimic.main(["--resume", "--out", "lerobot"]) == 0
    assert "TRAINING demonstrations" in flow("lerobot", place)
    assert written(tmp_path / "policies") == before


def test_push_t_takes_as_many_demonstrations_as_are_asked_for(tmp_path):
    pytest.importorskip("lerobot")
    from tests.data.lerobot_parts import write_lerobot

    widths = {"observation.state": 2, "observation.environment_state": 16, "action": 2}
    features = {name: {"dtype": "float32", "shape": (n,), "names": None} for name, n in widths.items()}
    write_lerobot(tmp_path / "pusht", lengths=(6, 4, 9), features=features)
    place = f"lerobot:{tmp_path}/pusht"
    given = [DataOptions(dataset=place, demonstrations=n) for n in ((), (2,), (4,))]
    every, two = map(pusht.task, given[:2])
    with raises(DatasetError, 3, "demos=4"):
        pusht.task(given[2])
    # The agent, then the block's corners; both within [-1, 1].
    assert (every.data["observation"].shape, two.data["observation"].shape) == ((19, 18), (10, 18))
    assert every.data["observation"].abs().max().item() == pytest.approx(1.0)
    assert every.play.success == "is_success" and every.play.measures == {"coverage": "max"}
    # Offsets from where the agent is.
    raw, moved = (t.normalizer.denormalize(t.data.clone()) for t in (every, pusht.relative(given[0])))
    torch.testing.assert_close(moved["action"] + raw["observation"][:, :2], raw["action"])


def test_a_file_in_mimicgens_environment(tmp_path):
    """As a user starts it: the package is not taken for the script, nor is it missed by workers."""
    write_mimicgen(tmp_path / "site")
    file, out = tmp_path / "stack.hdf5", tmp_path / "out"
    write_robomimic_file(file, lengths=(30, 20, 9), task="stack_d0", env_args=env_args_14("stack_d0"))
    argv = options(file, out, task=None, prior="past", demonstrations=2, horizon=9)
    script = Path(mimicgen_tasks.__file__)
    path = os.pathsep.join(map(str, (script.parents[1], tmp_path / "site")))
    command, env = [sys.executable, str(script), *argv], os.environ | {"PYTHONPATH": path}
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (row,), (task,) = stored(out), described(out, "tasks")
    assert (row["task"], row["data"]) == ("stack_d0", "source")
    assert (task["demonstrations"], task["steps"]) == (2, 50)
