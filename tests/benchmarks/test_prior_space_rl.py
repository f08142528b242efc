"""Agents in source space from the command line: rows, files, interruptions, errors."""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.benchmarks.conftest import options
from warmprior import Prior, WarmPriorActor

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "prior_space_rl.py"
TINY = {
    "iterations": 20,
    "steps": 500,
    "warmup": 200,
    "updates": 1,
    "evaluate-every": 300,
    "episodes": 4,
    "envs": 4,
}


@pytest.fixture(scope="module")
def benchmark():
    return importlib.import_module("prior_space_rl")


def unit(out, **extra):
    values = {"preset": "unit", "out": out} | TINY | extra
    words = []
    for key, value in values.items():
        words += [f"--{key}", *map(str, value if isinstance(value, list) else [value])]
    return words


def stored(out):
    return json.loads((out / "results.json").read_text())


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")


def test_the_toy_with_both_algorithms(benchmark, tmp_path, capsys):
    out = tmp_path / "out"
    argv = unit(out, seeds=2, algorithm=["dsrl-na", "dsrl-sac"])
    assert benchmark.main(argv) == 0
    result = stored(out)
    cells = [(row["algorithm"], row["prior"], row["seed"]) for row in result["rows"]]
    assert cells == [(a, "past", seed) for seed in (0, 1) for a in ("dsrl-na", "dsrl-sac")]
    for row in result["rows"]:
        # All control steps, of at most 4 chunks of 8 actions beyond.
        assert 500 <= row["environment_steps"] < 500 + 4 * 8
        assert row["delta"] == 0.5 and row["episodes"] == 4 and row["chunk"] == 8
        points = [
            point
            for point in result["curve"]
            if all(point[key] == row[key] for key in ("algorithm", "prior", "seed"))
        ]
        kinds = [point["evaluation"] for point in points]
        assert kinds == ["base", "greedy", "stochastic", "greedy", "stochastic"]
        steps = [point["environment_steps"] for point in points]
        assert steps[0] == 0 and 300 <= steps[1] < 332 and steps[-1] == row["environment_steps"]
        rates = [point["success_rate"] for point in points]
        told = [row[k] for k in ("base_success", "final_success", "final_success_stochastic")]
        assert told == [rates[0], rates[-2], rates[-1]]
    assert result["meta"]["options"]["iterations"] == 20
    assert result["meta"]["config"]["environment_steps"] == 500
    assert {"versions", "hardware", "task", "wall_time_s"} <= set(result["meta"])
    # The frozen policy of one prior and seed is trained once, as long as it was asked for.
    policies = sorted(path.name for path in (out / "policies").iterdir())
    assert policies == ["past-h8-seed0", "past-h8-seed1"]
    assert (out / "policies" / "past-h8-seed0" / "policy_000020").is_dir()
    for picture in ("curves", "success_dsrl-na", "success_dsrl-sac"):
        assert is_png(out / f"{picture}.png")
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out and table.count("\n") == 2 + 2
    assert "| DSRL-NA, WP-Past (2 seeds) | 0.5 |" in table

    # A folder with results is left alone, unless they are to be continued: here there is nothing to do.
    assert benchmark.main(argv) == 2
    assert "--resume" in capsys.readouterr().err
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    assert benchmark.main(["--resume", "--out", str(out)]) == 0
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    again = stored(out)
    assert (again["rows"], again["curve"]) == (result["rows"], result["curve"])
    assert benchmark.main(["--resume", "--out", str(out), "--delta", "0.7"]) == 2
    assert "was started with no --delta" in capsys.readouterr().err


def test_resume_goes_on_where_it_stopped(benchmark, tmp_path, monkeypatch):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert benchmark.main(unit(whole, seeds=1)) == 0
    expected = stored(whole)["curve"]

    class Interrupted(benchmark.PriorSpaceTraining):
        def _evaluate(self, env, policies):
            if self.steps > 350:
                raise KeyboardInterrupt
            super()._evaluate(env, policies)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(benchmark, "PriorSpaceTraining", Interrupted)
        benchmark.main(unit(cut, seeds=1))
    assert not (cut / "results.json").exists()
    assert benchmark.main(["--resume", "--out", str(cut)]) == 0
    curve = stored(cut)["curve"]
    assert len(curve) == len(expected) == 5 and curve[:3] == expected[:3]
    assert stored(cut)["rows"][0]["environment_steps"] >= 500


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--preset unit --delta 0", "delta must be a finite number > 0, got 0.0"),
        ("--preset unit --delta -1", "delta must be a finite number > 0"),
        ("--preset unit --warmup 20000", r"warmup_steps (20000) exceed environment_steps"),
        ("--preset unit --updates 0", "updates must be at least 1"),
        ("--preset unit --episodes 0", "evaluation_episodes must be at least 1"),
        ("--preset unit --seeds 0", "--seeds must be at least 1"),
        ("--preset unit --envs 0", "--envs must be at least 1"),
        ("--preset unit --iterations 0", "iterations"),
        ("--preset unit --device nowhere", "--device nowhere does not work here"),
        ("--preset quick --task navigation", "navigation and --preset unit belong together"),
        ("--preset unit --task can", "navigation and --preset unit belong together"),
        ("--preset unit --horizon 9", "a time limit of its own: leave out --horizon"),
        ("--preset unit --prior regression", "--prior regression is no flow"),
        ("--preset unit --prior nobodys", "unknown prior 'nobodys'"),
        ("--horizon 0", "--horizon must be at least 1, got 0"),
        (
            "--preset unit --data mh",
            "the toy has demonstrations and a time limit of its own: leave out --data",
        ),
        ("--preset unit --demonstrations 9 --compile", "leave out --demonstrations, --compile"),
        ("--preset quick --run {tmp}", "it has no results.json; name a run of robomimic.py"),
        ("--preset quick --dataset {tmp}/none.hdf5", "no such file"),
    ],
)
def test_bad_options_stop_before_any_work(benchmark, tmp_path, capsys, words, message):
    out = tmp_path / "out"
    argv = [*words.format(tmp=tmp_path).split(), "--out", str(out)]
    assert benchmark.main(argv) == 2
    told = capsys.readouterr().err
    assert message in told and told.startswith("prior_space_rl.py: error: ")
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--algorithm dsrl-xy", "invalid choice: 'dsrl-xy'"),
        ("--task tool_hang", "invalid choice: 'tool_hang'"),
        ("--detla 0.5", "unrecognized arguments: --detla"),
    ],
)
def test_unknown_choices(benchmark, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        benchmark.main(words.split())
    assert stop.value.code == 2 and message in capsys.readouterr().err


def test_papers_recipes(benchmark):
    """DSRL's table of hyper-parameters; its choice for Transport is SAC."""
    known = {
        "lift": (0.99, 30, 24_000, 2048, 300, 4, 1.5),
        "can": (0.99, 20, 24_000, 2048, 300, 4, 1.5),
        "square": (0.999, 20, 32_000, 2048, 400, 4, 1.5),
        "transport": (0.99, 20, 640_000, 128, 800, 8, 1.0),
    }
    for task, values in known.items():
        args = benchmark.make_parser().parse_args(["--preset", "paper", "--task", task])
        budget, config = benchmark.make_config(args)
        priors = {name: Prior.make(name, budget.chunk) for name in budget.priors}
        agents = {n: budget.agent(config, "dsrl-na", prior, 0) for n, prior in priors.items()}
        base = agents["gaussian"].delta or 1.5
        found = (config.gamma, config.updates, config.warmup_steps, config.hidden_dim)
        assert (*found, budget.horizon, budget.chunk, base) == values
        assert agents["past"].delta is None  # the paper's 0.5
        assert budget.agent(config, "dsrl-sac", priors["past"], 3).seed == 3
        assert (config.alpha_init, config.tau, config.batch_size) == (1.0, 0.005, 256)
        assert budget.priors == ("gaussian", "past", "preview")
        expected = ["dsrl-na", "dsrl-sac"] if task == "transport" else ["dsrl-na"]
        assert benchmark.algorithms(args) == expected
    args = benchmark.make_parser().parse_args(
        ["--preset", "paper", "--task", "transport", "--delta", "0.7"]
    )
    budget, config = benchmark.make_config(args)
    for name in ("gaussian", "past"):
        prior = Prior.make(name, 8)
        assert budget.agent(config, "dsrl-na", prior, 0).delta == 0.7
    args = benchmark.make_parser().parse_args(["--preset", "paper", "--dataset", "x.hdf5"])
    with pytest.raises(ValueError, match=r"add the --task of --dataset x.hdf5"):
        benchmark.make_config(args)


def test_quick_pays_for_solving_the_task(benchmark):
    """The entropy bonus of a decision must not exceed what its control steps cost."""
    budget, config = benchmark.make_config(benchmark.make_parser().parse_args(["--task", "lift"]))
    bonus = config.alpha_init * budget.chunk * 7 * math.log(2)  # uniform in units of the box
    assert bonus < config.reward_offset * budget.chunk
    assert (budget.horizon, budget.pretraining.demonstrations["ph"]) == (90, 5)


def test_a_training_that_diverges_leaves_the_others_alone(benchmark, tmp_path, capsys, monkeypatch):
    class Diverging(benchmark.PriorSpaceTraining):
        def run(self):
            if self.config.seed == 0:
                raise FloatingPointError("loss_qvalue=nan")
            return super().run()

    monkeypatch.setattr(benchmark, "PriorSpaceTraining", Diverging)
    out = tmp_path / "out"
    assert benchmark.main(unit(out, seeds=2, steps=200, warmup=100)) == 2
    assert "error: dsrl-na past, seed 0: loss_qvalue=nan" in capsys.readouterr().err
    assert [row["seed"] for row in stored(out)["rows"]] == [1]
    assert is_png(out / "curves.png") and (out / "table.md").exists()


def test_resume_without_a_run(benchmark, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert benchmark.main(["--resume"]) == 2
    assert "there is no run in runs/rl-lift-ph-quick" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory):
    """A finished run of robomimic.py."""
    pytest.importorskip("robosuite")
    robomimic = importlib.import_module("robomimic")
    out = tmp_path_factory.mktemp("runs") / "main"
    with pytest.MonkeyPatch.context() as patch:  # filmstrips take long, and are not tested here
        patch.setattr(robomimic, "rendering_backend", lambda: None)
        assert robomimic.main(options(dataset, out, prior=["gaussian", "past"])) == 0
    return out


def test_policies_of_a_finished_run(benchmark, finished, tmp_path, capsys):
    """They bring task, data and normaliser; in the simulator, in worker processes."""
    before = {path: path.stat().st_mtime_ns for path in finished.parent.rglob("*.safetensors")}
    out = tmp_path / "agents"
    short = {"steps": 60, "warmup": 30, "evaluate-every": 60, "episodes": 1, "envs": 1}
    words = [str(word) for key, value in short.items() for word in (f"--{key}", value)]
    run = ["--run", str(finished), "--out", str(out), "--horizon", "20"]
    assert benchmark.main([*run, *words, "--seeds", "2", "--prior", "past"]) == 0
    assert "--run has 1 seeds of past: agent 1 shares a policy" in capsys.readouterr().out
    result = stored(out)
    assert result["meta"]["task"] == "lift" and result["meta"]["horizon"] == 20
    row, other = result["rows"]
    assert other["seed"] == 1
    assert row["prior"] == "past" and row["chunk"] == 8 and 60 <= row["environment_steps"] < 68
    assert is_png(out / "curves.png")
    after = {path: path.stat().st_mtime_ns for path in finished.parent.rglob("*.safetensors")}
    assert after == before  # nothing was trained

    # An agent goes on with the very policy it began with, whatever has become of the run's.
    for folder in (finished.parent / "policies").glob("*/policy_*"):
        actor = WarmPriorActor.from_pretrained(folder)
        torch.nn.init.normal_(next(actor.parameters()))
        actor.save_pretrained(folder)
    assert benchmark.main(["--resume", "--out", str(out)]) == 0
    assert stored(out)["rows"] == result["rows"]
    # Started anew, the folder's agent is not passed off as one of the present policy.
    (out / "results.json").unlink()
    assert benchmark.main([*run, *words, "--seeds", "2", "--prior", "past"]) == 2
    assert "belongs to another policy" in capsys.readouterr().err

    other = ["--run", str(finished), "--out", str(tmp_path / "other")]
    for extra, message in {
        ("--task", "can"): "is of lift, not of can",
        ("--prior", "preview"): "has policies of gaussian, past, but none of preview",
        ("--chunk", "4"): "--run brings its policies and their data: leave out --chunk",
        ("--data", "mh"): "leave out --data",
    }.items():
        assert benchmark.main([*other, *extra]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
def test_the_toy_is_solved_in_the_benchmarks_budget(benchmark, tmp_path):
    out = tmp_path / "out"
    assert benchmark.main(["--preset", "unit", "--out", str(out)]) == 0
    rows = stored(out)["rows"]
    assert [row["seed"] for row in rows] == [0, 1, 2]
    for row in rows:
        assert row["base_success"] <= 0.6 and row["final_success"] >= 0.9


@pytest.mark.slow
def test_the_toy_is_solved_for_its_reward(benchmark, tmp_path, monkeypatch):
    """With the reward negated the agent keeps away from the goal, and without one it finds no way there."""
    sign = {"-": -1.0, "0": 0.0}
    for name, factor in sign.items():

        class Paid(benchmark.PriorSpaceTraining):
            def _transitions(self, data, factor=factor):
                transitions = super()._transitions(data)
                transitions["next", "reward"] *= factor
                return transitions

        monkeypatch.setattr(benchmark, "PriorSpaceTraining", Paid)
        out = tmp_path / name
        assert benchmark.main(["--preset", "unit", "--seeds", "1", "--out", str(out)]) == 0
        (row,) = stored(out)["rows"]
        assert row["final_success"] <= (0.05 if factor else 0.6)


@pytest.mark.slow
def test_killed_and_resumed(benchmark, tmp_path):
    """SIGKILL in the middle of an agent's training, from a process of its own."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert benchmark.main(unit(whole, seeds=1, steps=3_000)) == 0
    expected = stored(whole)["curve"]

    argv = [sys.executable, str(SCRIPT), *unit(cut, seeds=1, steps=3_000)]
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    second = cut / "dsrl-na-past-seed0" / "buffer" / "000001.safetensors"
    deadline = time.monotonic() + 300
    while not second.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert second.exists() and not (cut / "results.json").exists()

    assert benchmark.main(["--resume", "--out", str(cut)]) == 0
    curve = stored(cut)["curve"]
    kinds = [(row["evaluation"], row["environment_steps"] // 300) for row in curve]
    assert kinds == [(row["evaluation"], row["environment_steps"] // 300) for row in expected]
    # What was saved before the kill stands as in the run that was never interrupted.
    assert curve[:3] == expected[:3]
    assert 3_000 <= stored(cut)["rows"][0]["environment_steps"] < 3_032
