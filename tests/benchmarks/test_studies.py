import json
import shutil
from itertools import product

import budget
import chunking
import curvature
import navigation1d
import pytest
import real_time_chunking
import robomimic
import sigma
import torch

from lab.demonstrations.data_options import DataOptions
from lab.options.options import MeasuredOptions, Options, Run, Sources
from lab.running import policies as common
from lab.running.measuring import held_out
from tests.benchmarks import drift
from tests.benchmarks.script_parts import command_line, described, is_png, options, refused, stored, written
from tests.data.synthetic import write_robomimic_file
from warmprior.data import open_demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.diagnostics import SharedObservations, action_error
from warmprior.saving import load_policy
from warmprior.tasks import Play, Task

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module")
def finished(inline, short_episodes, dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "main"
    assert robomimic.main(options(dataset, out, seeds=2, iterations=20)) == 0
    return out


def measured(out, validation):
    return {"out": out, "validation": validation, "measured": 20}


def test_curvature_of_a_finished_run_trains_nothing(finished, dataset, validation, tmp_path, capsys):
    before, out = written(finished.parent), tmp_path / "flow"
    assert curvature.main(command_line(run=finished, **measured(out, validation))) == 0
    rows, report = stored(out, "curvature"), (out / "report.md").read_text()
    assert len(rows) == (1 + 2 + 2) * 3  # training and deployed means; two seeds and their average
    base = [row for row in rows if row["prior"] == "gaussian"]
    assert len(base) == 3 and all(row["ratio"] in (1.0, None) for row in base)
    assert all(row["speed"] > 0 and row["observations"] == 20 for row in rows)
    assert "20 observations of val.hdf5, 2 seeds" in report and "not held out" not in report
    assert is_png(out / "flow_paths.png")
    # The same options find the same policies; the training data are allowed, but called what they are.
    own = finished.parent / "own"
    assert curvature.main(options(dataset, seeds=2, iterations=20, **measured(own, validation))) == 0
    assert stored(own, "curvature") == rows and written(finished.parent) == before
    assert curvature.main(command_line(run=finished, **measured(tmp_path / "train", dataset))) == 0
    assert "not held out" in (tmp_path / "train" / "report.md").read_text()
    # Of a run without the policy of a seed, what is missing is missed.
    path = next((finished.parent / "policies").glob("*-past-seed1-*/policy_000020"))
    path.rename(path.with_name("away"))
    said = refused(curvature.main, command_line(run=finished, **measured(tmp_path / "no", dataset)), capsys)
    path.with_name("away").rename(path)
    assert "has no trained policy" in said


def test_sigma_study(finished, dataset, validation):
    before, out = written(finished.parent), finished.parent / "sigma"
    prior = ["gaussian", "past", "past,correlation=0.5"]
    argv = options(dataset, iterations=20, prior=prior, sigma=[0.5, 0.0], **measured(out, validation))
    assert sigma.main(argv) == 0
    after = written(finished.parent)
    # Of 1 + 4 policies the Gaussian one and that of past with sigma 0.5 existed: 3 are new.
    new = {path.parents[1].name for path in after.keys() - before.keys() if "policy_" in str(path)}
    assert len(new) == 3 and before.items() <= after.items()
    rows, flow, report = stored(out), stored(out, "curvature"), (out / "report.md").read_text()
    cells = {(r["prior"], r["options"], r["sigma"]) for r in rows}
    assert len(cells) == len(rows) == 5 and len(flow) == 1 + 4 * 2
    bounds = {r["sigma"]: r["bound"] for r in flow if r["prior"] == "past" and not r["options"]}
    assert bounds[0.0] < bounds[0.5]  # the bound grows with sigma^2
    assert is_png(out / "sigma.png") and report.count("| WP-Past, correlation=0.5 | 0.5 |") == 3
    # Continuing measures the same again, once.
    assert sigma.main([*argv, "--resume"]) == 0
    assert written(finished.parent) == after
    assert stored(out) == rows and (out / "report.md").read_text() == report


@pytest.mark.parametrize("priors", [["gaussian"], ["gaussian", "past"]])
def test_a_seed_that_fails_costs_no_report_of_the_others(priors, tmp_path, monkeypatch):
    train = common.train_policy

    def failing(task, prior, *args, training, **options):
        if prior.name == "gaussian" and training.seed == 1:
            raise FloatingPointError("the loss became nan")
        return train(task, prior, *args, training=training, **options)

    monkeypatch.setattr(common, "train_policy", failing)
    out = tmp_path / "out"
    few = {"nfe": 1, "checkpoints": 1, "iterations": 10, "episodes": 1}
    assert sigma.main(drift.arguments(out, prior=priors, sigma=[1.5, 0.5], **few)) == 2
    report, rows = (out / "report.md").read_text(), stored(out)
    assert "seed 1: train: the loss became nan" in report and "| Gaussian source | 1 |" in report
    assert {(row["prior"], row["seed"]) for row in rows} == {("gaussian", 0), ("past", 0), ("past", 1)} & {
        (prior, seed) for prior in priors for seed in range(2)
    }
    # Flows are compared over all seeds, so with the first method that has them.
    assert ("relative to past, sigma 1.5, H 4" in report) == ("past" in priors)


def test_chunk_lengths_of_two_tasks(tmp_path):
    """Bars and violins of both are in one picture, and each has its lines."""
    out, tasks = tmp_path / "out", [f"{drift.__name__}:{name}" for name in ("task", "renamed")]
    few = {"seeds": 1, "nfe": 1, "checkpoints": 1, "iterations": 10, "episodes": 2}
    argv = drift.arguments(out, task=tasks, chunk=[1, 8], prior="past", **few)
    assert chunking.main(argv) == 0
    last = stored(out)
    assert {(row["task"], row["chunk"]) for row in last} == set(product(("drift", "Drift 2"), (1, 8)))
    for row in last:
        assert row["boundary_jump"] > 0 and (row["inner_jump"] is None) == (row["chunk"] == 1)
    names = ("chunk_lengths_Drift-Own", "chunk_lengths_Drift-2-Own-*", "bars", "violins")
    assert all(is_png(next(out.glob(f"{name}.png"))) for name in names)


def test_every_budget_is_a_training_of_its_own(dataset, validation, tmp_path):
    out = tmp_path / "runs" / "budget"
    more = {"budgets": [4, 2], "prior": "past", "seeds": 2, "nfe": [1, 3], "checkpoints": 2}
    argv = options(dataset, **measured(out, validation) | more)
    assert budget.main(argv) == 0
    cells = {(r["iterations"], r["seed"], r["nfe"]): r for r in stored(out)}
    assert list(cells) == [(n, s, f) for n in (2, 4) for s in (0, 1) for f in (3, 1)]
    assert is_png(out / "budget.png")
    # The errors are those of the policies on disk, each trained for its own number of iterations.
    for (n, _, nfe), row in cells.items():
        actor = load_policy(out.parent / "policies" / row["policy"] / f"policy_{n:06d}")
        replay = RobomimicDemonstrations(validation).steps().exclude("next")
        shared = SharedObservations(actor.normalizer.normalize(replay), 8, observation_steps=2)
        error = action_error(actor, shared.windows(actor.prior), nfes=(nfe,))[nfe]
        assert row["action_error"] == pytest.approx(error, rel=0.3)  # any draw of 20 is close
    assert len({row["action_error"] for row in cells.values()}) == len(cells)
    mean = (cells[2, 0, 3]["action_error"] + cells[2, 1, 3]["action_error"]) / 2
    assert f"| 2 | 3 | WP-Past | 0.0% ± 0.0% | {mean:.4f} ±" in (out / "report.md").read_text()


def test_a_file_with_masks_is_its_own_validation(tmp_path):
    """Trained on its mask train, and measured on its mask valid: which demonstrations is not said twice."""
    path, lengths = tmp_path / "lift.hdf5", (30, 5, 40, 25)
    masks = {"train": [0, 1, 2], "valid": [3]}
    write_robomimic_file(path, lengths=lengths, task="lift", masks=masks)
    few = {"measured": 10, "prior": ["gaussian", "past"], "nfe": 1}
    out = tmp_path / "runs" / "masked"
    assert curvature.main(options(path, out, mask="train", **few)) == 0
    assert described(out, "tasks")[0]["demonstrations"] == 3
    assert "10 observations of lift.hdf5 (mask valid)" in (out / "report.md").read_text()
    # So of the finished run, whose options are not typed again.
    again = tmp_path / "runs" / "again"
    assert curvature.main(command_line(run=out, measured=10, out=again)) == 0
    assert stored(again, "curvature") == stored(out, "curvature")


@pytest.mark.parametrize("given", [False, True])
def test_demonstrations_that_were_trained_on_are_not_held_out(tmp_path, given, capsys):
    """Masks may overlap, and a copy of a file, in whatever format, has the same demonstrations."""
    path, copy = tmp_path / "lift.hdf5", tmp_path / "copy.hdf5"
    masks = {"train": [0, 1, 2], "valid": [2, 3]}
    write_robomimic_file(path, lengths=(30, 5, 40, 25), task="lift", masks=masks)
    shutil.copy(path, copy)
    argv = options(path, tmp_path / "runs" / "out", mask="train", prior="past", measured=10)
    argv += command_line(validation=copy) if given else []
    line = refused(curvature.main, argv, capsys)
    number = "3 of 4" if given else "1 of 2"
    said = f"{'copy.hdf5' if given else 'lift.hdf5 (mask valid)'} has {number} demonstrations in common"
    assert said in line and "(mask train)" in line
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize("minari", [False, True])
def test_what_cannot_be_recorded_again_is_measured_on_the_training_data(minari, tmp_path, monkeypatch):
    """Datasets with environments of Gymnasium, and files with an environment of one's own."""
    if minari:
        test_minari = pytest.importorskip("tests.data.test_minari")
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
        vector = test_minari.Box(-9, 9, (3,), "float32")
        place = f"minari:{test_minari.written(observation=vector, env='Pendulum-v1', expert_policy=None)}"
        more = {"dataset": place, "task": None, "horizon": 9}
    else:
        place = tmp_path / "lift.hdf5"
        write_robomimic_file(place, lengths=(30, 5, 40), task="lift")
        task = Task(open_demonstrations(place), play=Play(drift.DriftEnv))
        # Under a name of its own, since tasks are kept by their names.
        monkeypatch.setattr(drift, "read_from_a_file", lambda: task, raising=False)
        more = {"task": f"{drift.__name__}:read_from_a_file"}
    out = tmp_path / "out"
    argv = drift.arguments(out, **more, seeds=1, episodes=None, nfe=None, measured=20)
    assert curvature.main(argv) == 0
    assert "observations of the TRAINING demonstrations (not held out)" in (out / "report.md").read_text()


def test_chosen_observations_are_read_from_held_out_demonstrations(tmp_path, monkeypatch):
    path, other, keys = tmp_path / "lift.hdf5", tmp_path / "other.hdf5", ["robot0_eef_pos", "object"]
    write_robomimic_file(path, task="lift")
    write_robomimic_file(other, task="lift", seed=1)
    task = Task(open_demonstrations(path), observations=keys)
    monkeypatch.setattr(drift, "chosen", lambda: task, raising=False)
    data, run = DataOptions(task=(f"{drift.__name__}:chosen",)), Run(out=tmp_path)
    (policy,) = common.policies_of(Options(data, sources=Sources(prior=("past",)), run=run))
    measured, words = held_out(MeasuredOptions(data, validation=other, measured=20, run=run), policy)
    seen = policy.task().normalizer.denormalize(measured.data)["observation"]
    torch.testing.assert_close(seen, RobomimicDemonstrations(other).steps(observations=keys)["observation"])
    assert words == "other.hdf5"


@pytest.mark.parametrize(
    ("preset", "priors"), [("quick", ["gaussian", "regression", "past"]), ("paper", ["past"])]
)
def test_navigation_has_its_own_columns_and_pictures(preset, priors, tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    few = {"prior": priors, "iterations": 5, "episodes": 4, "chunk": 32}
    few |= {"preset": preset, "seeds": 1, "network": "mlp,hidden_dim=8"}
    argv = command_line(**few, workers=1, logger="none", out=out)
    assert navigation1d.main(argv) == 0
    played, curved = stored(out), stored(out, "curvature")
    policies = {(row["prior"], row["sigma"]) for row in played}
    every = [("gaussian", 1.0), ("regression", 0.0), ("past", 0.1), ("past", 0.5)]
    assert policies == {(prior, level) for prior, level in every if prior in priors}
    # All but the regression at 9 and at 1 network evaluation.
    assert len(played) == 2 * len(policies) - ("regression" in priors)
    for row in played:
        assert {"switch_rate", "collision_rate", "route_entropy", "distance"} <= set(row)
        assert (row["task"], row["chunk"], row["iterations"]) == ("navigation", 32, 5)
    assert {(row["prior"], row["sigma"]) for row in curved} == policies - {("regression", 0.0)}
    assert {row["prior"] for row in curved if row["mean"] == "deployed"} == {"past"}
    report = (out / "report.md").read_text()
    assert report.partition("\n\nColumns")[0] in capsys.readouterr().out
    assert ("sines and cosines" in report) == (preset == "quick")
    for policy in out.parent.glob("policies/*/config.json"):
        assert json.loads(policy.read_text())["network"]["observation_dim"] == (1 if preset == "paper" else 9)
    assert is_png(out / "navigation1d.png") and is_png(out / "flow_paths.png")

    # A folder with results is left alone, unless its policies are to be reused.
    assert "--resume" in refused(navigation1d.main, argv, capsys)
    before = written(out.parent)
    assert before and navigation1d.main([*argv, "--resume"]) == 0
    assert stored(out) == played and written(out.parent) == before


TINY = {
    "iterations": 20,
    "episodes": 2,
    "workers": 1,
    "nfe": 2,
    "logger": "none",
    "network": "mlp,hidden_dim=16",
}


def test_real_time_chunking_of_a_task_beside_the_toy(dataset, tmp_path):
    out = tmp_path / "out"
    own = {"prior": "preview", "delay": [0, 3], "rtc__schedule": "linear", "episodes": 1}
    argv = options(dataset, out, **TINY | own)
    assert real_time_chunking.main(argv) == 0
    rows = stored(out)
    cells = [tuple(row[name] for name in ("task", "delay", "guidance")) for row in rows]
    values = ("lift", "navigation"), (0, 3), ("none", "rtc")
    assert cells == list(product(*values))
    assert {row["execute"] for row in rows} == {5}  # of 8, as many as the largest delay leaves
    report = (out / "report.md").read_text()
    assert "| Lift-PH | 2 | 3 | RTC + WP-Preview |" in report and "schedule linear" in report
    assert is_png(out / "real_time_chunking.png")
    # The latency and the guidance change what is done, and not what is trained.
    lift = [row for row in rows if row["task"] == "lift"]
    assert len({row["boundary_jump"] for row in lift}) == len(lift)
    assert len({row["policy"] for row in rows}) == 2
