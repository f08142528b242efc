"""Agents in source space from the command line: rows, files, interruptions, errors."""

from __future__ import annotations

import importlib
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path

import pytest
from torchrl.envs import UnaryTransform

from tests.benchmarks.script_parts import (
    command_line,
    described,
    is_png,
    options,
    refused,
    stored,
    written,
)
from warmprior.training import load_policy

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

import prior_space_rl as benchmark
import robomimic
from options import parse, started

SCRIPT = Path(benchmark.__file__)
TINY = {
    "iterations": 20,
    "rl__environment_steps": 500,
    "rl__warmup_steps": 200,
    "rl__updates": 1,
    "rl__evaluate_every": 300,
    "episodes": 4,
    "num_envs": 4,
    "logger": "none",
    "envs": 1,
}


def unit(out, **extra):
    return command_line(**{"preset": "unit", "out": out} | TINY | extra)


def read(words):
    """The options of a command line."""
    return parse(benchmark.AGENT_PRESETS, words.split(), "rl", None, adapt=benchmark.adapt)


def agents(rows):
    """The evaluations of every agent, in the order of the agents."""
    found = groupby(rows, lambda row: (row["seed"], row["algorithm"], row["prior"], row["options"]))
    return {key: list(points) for key, points in found}


def rates(points, kind):
    return [point["success_rate"] for point in points if point["evaluation"] == kind]


def test_the_toy_with_both_algorithms(tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    argv = unit(out, seeds=2, algorithm=["dsrl-na", "dsrl-sac"])
    assert benchmark.main(argv) == 0
    rows = stored(out)
    found = agents(rows)
    algorithms = ("dsrl-na", "dsrl-sac")
    assert list(found) == [(seed, a, "past", "") for seed in (0, 1) for a in algorithms]
    for points in found.values():
        kinds = [point["evaluation"] for point in points]
        assert kinds == ["base", "greedy", "stochastic", "greedy", "stochastic"]
        steps = [point["environment_steps"] for point in points]
        assert steps[0] == 0 and 300 <= steps[1] < 332
        # All control steps, of at most 4 chunks of 8 actions beyond.
        assert 500 <= steps[-1] < 500 + 4 * 8
        for point in points:
            facts = {"task": "navigation", "delta": 0.5, "episodes": 4, "chunk": 8, "nfe": 2}
            assert facts.items() <= point.items()
            assert point["success_rate"] == point["successes"] / 4
    # Both algorithms start from the same frozen policy.
    for seed in (0, 1):
        assert rates(found[seed, "dsrl-na", "past", ""], "base") == rates(
            found[seed, "dsrl-sac", "past", ""], "base"
        )
    kept = described(out, "options")["options"]
    assert kept["training"]["iterations"] == 20 and kept["rl"]["environment_steps"] == 500
    assert described(out, "tasks")[0]["task"] == "navigation"
    # The frozen policy of one prior and seed is trained once, as long as it was asked for.
    frozen = sorted((out.parent / "policies").iterdir())
    assert [path.name[:26] for path in frozen] == [f"navigation-toy-past-seed{i}-" for i in (0, 1)]
    assert all((path / "policy_000020").is_dir() for path in frozen)
    for picture in ("curves", "success"):
        assert is_png(out / f"{picture}.png")
    table = (out / "report.md").read_text()
    assert table.partition("\n\nColumns")[0] in capsys.readouterr().out
    for algorithm, kind in product(algorithms, ("base", "greedy", "stochastic")):
        start = f"| {algorithm} | WP-Past | {kind} | 2 | 0.5 ± 0 |"
        (line,) = (line for line in table.splitlines() if line.startswith(start))
        mean = float(line.split("|")[7].split("%")[0])
        last = [rates(found[seed, algorithm, "past", ""], kind)[-1] for seed in (0, 1)]
        assert mean == pytest.approx(100 * sum(last) / 2, abs=0.051)

    # A folder with results is left alone, unless they are to be continued: here there is nothing to do.
    assert "--resume" in refused(benchmark.main, argv, capsys)
    before = written(out.parent)
    assert benchmark.main(["--resume", "--out", str(out)]) == 0
    assert written(out.parent) == before
    assert stored(out) == rows


def test_options_of_a_prior_are_agents_of_their_own(tmp_path):
    out = tmp_path / "runs" / "out"
    prior = ["past", "past,correlation=0.5"]
    few = {"rl__environment_steps": 300, "rl__warmup_steps": 200, "seeds": 1, "prior": prior}
    assert benchmark.main(unit(out, **few)) == 0
    found = agents(stored(out))
    assert [key[2:] for key in found] == [("past", ""), ("past", "correlation=0.5")]
    assert len({len(points) for points in found.values()}) == 1
    # Each acts in the source of its own policy.
    for name, correlation in (("past", 0.0), ("past,correlation=0.5", 0.5)):
        (policy,) = (out.parent / "policies").glob(f"*-{name}-seed0-*/policy_*")
        assert load_policy(policy).prior.correlation == correlation
        assert (out / f"dsrl-na-{name}-seed0").is_dir()
    table = (out / "report.md").read_text()
    for line in ("| dsrl-na | WP-Past | greedy |", "| dsrl-na | WP-Past, correlation=0.5 | greedy |"):
        assert line in table


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--num-envs 8", "other values of --num-envs: leave these out"),
        ("--seeds 2 --prior gaussian", "other values of --prior, --seeds"),
        ("--rl.updates 2", "other values of --updates"),
        ("--rl.delta 0.7", "other values of --delta"),
    ],
)
def test_a_continued_run_has_the_options_it_began_with(tmp_path, words, message):
    begun = read(" ".join(unit(tmp_path, seeds=1)))
    with started(begun, "rl"):
        pass
    resume = f"--resume --out {tmp_path}"
    # Those of the folder, whatever the preset that is the default.
    again = read(resume)
    assert replace(again, run=begun.run) == begun
    with pytest.raises(ValueError, match=message):
        read(f"{resume} {words}")


def test_resume_goes_on_where_it_stopped(tmp_path, monkeypatch):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert benchmark.main(unit(whole, seeds=1)) == 0
    expected = stored(whole)
    training = importlib.import_module("warmprior.rl.training")
    evaluate, calls = training.evaluate, []

    def interrupted(*args, **options):
        calls.append(None)
        if len(calls) > 3:  # the frozen policy, and both agents after 300 steps
            raise KeyboardInterrupt
        return evaluate(*args, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training, "evaluate", interrupted)
        benchmark.main(unit(cut, seeds=1))
    assert len(calls) == 4 and not (cut / "results.jsonl").exists()
    assert benchmark.main(["--resume", "--out", str(cut)]) == 0
    rows = stored(cut)
    assert len(rows) == len(expected) == 5 and rows[:3] == expected[:3]
    assert rows[-1]["environment_steps"] >= 500


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--preset unit --rl.delta 0", "delta must be a finite number > 0, got 0.0"),
        (
            "--preset unit --rl.warmup-steps 20000",
            "warmup_steps (20000) exceed environment_steps (12000)",
        ),
        ("--preset unit --rl.updates 0", "updates must be"),
        ("--preset unit --rl.gamma 2", "gamma must lie in (0, 1], got 2.0"),
        ("--preset unit --num-envs 0", "--num-envs must be a whole number of at least 1"),
        ("--preset unit --nfe 1 2", "this study has one --nfe, got 1 2"),
        ("--preset unit --chunk 4 8", "this study has one --chunk, got 4 8"),
        ("--preset quick --task navigation", "navigation and --preset unit belong together"),
        ("--preset unit --task can", "navigation and --preset unit belong together"),
        ("--preset unit --prior regression", "--prior regression is no flow"),
        ("--preset unit --prior past,cold_probability=0.3", "cold_probability is unknown to it"),
        ("--horizon 0", "--horizon must be a whole number of at least 1"),
        ("--preset unit --collectors 2", "--collectors belongs to --engine ray"),
        ("--preset quick --run {tmp}", "it has no results.jsonl; name a run of robomimic.py"),
        ("--preset quick --task tool_hang", "there is no scripted expert for tool_hang"),
        ("--preset paper", "has hyper-parameters per task: add the --task"),
    ],
)
def test_bad_options_stop_before_any_work(tmp_path, capsys, no_work, words, message):
    out = tmp_path / "out"
    (tmp_path / "x.hdf5").touch()
    said = refused(benchmark.main, [*words.format(tmp=tmp_path).split(), "--out", out], capsys)
    assert message in said
    assert not list(tmp_path.rglob("*.safetensors")) and not (out / "results.jsonl").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--delta 0.5", "--delta"),  # the agents' own options have their prefix
        ("--rl.evaluation-episodes 3", "--rl.evaluation-episodes"),  # that is --episodes
        ("--rl.seed 3", "--rl.seed"),
    ],
)
def test_unknown_choices(tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        benchmark.main([*words.split(), "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert stop.value.code == 2 and message in said.err and not said.out
    assert not (tmp_path / "out").exists()


def test_papers_recipes():
    """DSRL's table of hyper-parameters; its choice for Transport is SAC."""
    known = {
        "lift": (0.99, 30, 24_000, 2048, 300, 4, 1.5),
        "can": (0.99, 20, 24_000, 2048, 300, 4, 1.5),
        "square": (0.999, 20, 32_000, 2048, 400, 4, 1.5),
        "transport": (0.99, 20, 640_000, 128, 800, 8, 1.0),
    }
    for task, values in known.items():
        recipe = read(f"--preset paper --task {task} --download")
        methods = {method.name: method for method in recipe.sources.methods()}
        assert tuple(methods) == ("gaussian", "past", "preview")
        chunk = methods["past"].chunk_length
        made = {name: recipe.agent(method.has_anchor, "dsrl-na", 0) for name, method in methods.items()}
        base, config = made["gaussian"].delta or 1.5, made["past"]
        found = (config.gamma, config.updates, config.warmup_steps, config.hidden_dim)
        assert (*found, recipe.agents.horizon, chunk, base) == values
        assert made["past"].delta is None  # the paper's 0.5
        other = recipe.agent(True, "dsrl-sac", 3)
        assert other.seed == 3 and other.algorithm == "dsrl-sac" and other.backup_entropy
        assert not config.backup_entropy
        assert (config.alpha_init, config.tau, config.batch_size) == (1.0, 0.005, 256)
        assert (config.nfe, config.evaluation_episodes) == (1, 200)
        expected = ("dsrl-na", "dsrl-sac") if task == "transport" else ("dsrl-na",)
        assert recipe.agents.algorithm == expected
    recipe = read("--preset paper --task transport --download --rl.delta 0.7 --episodes 3 --nfe 9")
    for method in recipe.sources.methods():
        config = recipe.agent(method.has_anchor, "dsrl-na", 0)
        assert (config.delta, config.evaluation_episodes, config.nfe) == (0.7, 3, 9)
    # Options of the command line stand above those of the task.
    assert read("--preset paper --task square --rl.gamma 0.9").rl.gamma == 0.9


def test_quick_pays_for_solving_the_task():
    """The entropy bonus of a decision must not exceed what its control steps cost."""
    recipe = read("--task lift")
    chunk = recipe.sources.chunk[0]
    bonus = recipe.rl.alpha_init * chunk * 7 * math.log(2)  # uniform in units of the box
    assert bonus < recipe.rl.reward_offset * chunk
    assert (recipe.agents.horizon, recipe.data.count("ph")) == (90, 5)
    assert read("") == recipe  # lift is the default


def test_a_training_that_diverges_leaves_the_others_alone(tmp_path, capsys, monkeypatch):
    class Diverging(benchmark.PriorSpaceTraining):
        def run(self):
            if self.config.seed == 0:
                raise FloatingPointError("loss_qvalue=nan")
            return super().run()

    monkeypatch.setattr(benchmark, "PriorSpaceTraining", Diverging)
    out = tmp_path / "out"
    argv = unit(out, seeds=2, rl__environment_steps=200, rl__warmup_steps=100)
    assert benchmark.main(argv) == 2
    assert "dsrl-na past, seed 0: loss_qvalue=nan" in capsys.readouterr().err
    assert {row["seed"] for row in stored(out)} == {1}
    assert is_png(out / "curves.png") and "| greedy | 1 |" in (out / "report.md").read_text()


def test_resume_without_a_run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refused(benchmark.main, ["--resume"], capsys)
    assert "there is no run in runs/rl-lift-ph-quick" in said
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def finished(inline, short_episodes, dataset, tmp_path_factory):
    """A finished run of robomimic.py."""
    pytest.importorskip("robosuite")
    out = tmp_path_factory.mktemp("runs") / "main"
    prior = ["gaussian", "past,sigma=0.3", "past,sigma=0.3,correlation=0.5", "forecast"]
    assert robomimic.main(options(dataset, out, prior=prior, iterations=4)) == 0
    return out


@pytest.mark.parametrize(
    ("priors", "correlations"),
    [
        (["past"], [0.0]),
        (["past,correlation=0.5"], [0.5]),
        (["past,correlation=0.50,sigma=0.3", "past"], [0.5, 0.0]),
        (["forecast", "past"], [0.0, 0.0]),
    ],
)
def test_the_options_of_a_finished_run_are_those_asked_for(finished, tmp_path, priors, correlations):
    words = " ".join(command_line(run=finished, out=tmp_path / "out", prior=priors))
    facts, kept = benchmark.frozen_policies(read(words + " --seeds 1"))
    assert facts["task"] == "lift"
    assert [actors[0].prior.correlation for actors in kept.values()] == correlations
    names = [text.partition(",")[0] for text in priors]
    assert [actors[0].prior.name for actors in kept.values()] == names


SHORT = {
    "rl__environment_steps": 60,
    "rl__warmup_steps": 30,
    "rl__evaluate_every": 60,
    "episodes": 1,
    "num_envs": 1,
}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--task can", "is of lift, not of can"),
        ("--preset unit", "is of lift, not of navigation"),
        ("--prior past,correlation=0.75", "none of past,correlation=0.75"),
        ("--prior past,sigma=0.5", "none of past,sigma=0.5"),
        ("--prior preview", "none of preview"),
    ],
)
def test_what_a_finished_run_does_not_have(finished, tmp_path, capsys, no_work, words, message):
    argv = command_line(run=finished, out=tmp_path / "out", **SHORT)
    assert message in refused(benchmark.main, [*argv, *words.split()], capsys)
    assert not list(tmp_path.rglob("*.safetensors"))


def test_policies_of_a_finished_run(finished, tmp_path, capsys):
    """They bring task, data and normaliser; in the simulator, in worker processes."""
    before = written(finished.parent)
    out = tmp_path / "agents"
    argv = command_line(run=finished, out=out, horizon=20, seeds=2, prior="past", **SHORT)
    assert benchmark.main(argv) == 0
    assert "--run has 1 seeds of past: agents [1] share policies" in capsys.readouterr().out
    assert described(out, "options")["options"]["agents"]["horizon"] == 20
    first, second = agents(stored(out)).values()
    assert {row["seed"] for row in second} == {1}
    row = first[-1]
    assert row["task"] == "lift" and row["prior"] == "past" and 60 <= row["environment_steps"] < 68
    assert is_png(out / "curves.png")
    assert written(finished.parent) == before  # nothing was trained


@pytest.mark.slow
def test_the_toy_is_solved_in_the_benchmarks_budget(tmp_path):
    out = tmp_path / "out"
    assert benchmark.main(["--preset", "unit", "--out", str(out)]) == 0
    found = agents(stored(out))
    assert [seed for seed, *_ in found] == [0, 1, 2]
    for points in found.values():
        assert rates(points, "base")[0] <= 0.6 and rates(points, "greedy")[-1] >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "most"), [(-1.0, 0.05), (0.0, 0.6)])
def test_the_toy_is_solved_for_its_reward(tmp_path, monkeypatch, factor, most):
    """With the reward negated the agent keeps away from the goal, and without one it finds no way there."""
    make = benchmark.environment

    def paying(options, actor):
        make_env = make(options, actor)

        def make_paying(seed):
            paid = UnaryTransform(["reward"], ["reward"], fn=lambda reward: factor * reward)
            return make_env(seed).append_transform(paid)

        return make_paying

    monkeypatch.setattr(benchmark, "environment", paying)
    out = tmp_path / "out"
    assert benchmark.main(["--preset", "unit", "--seeds", "1", "--out", str(out)]) == 0
    (points,) = agents(stored(out)).values()
    assert rates(points, "greedy")[-1] <= most


@pytest.mark.slow
def test_killed_and_resumed(tmp_path):
    """SIGKILL in the middle of an agent's training, from a process of its own."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert benchmark.main(unit(whole, seeds=1, rl__environment_steps=3_000)) == 0
    expected = stored(whole)

    argv = [sys.executable, str(SCRIPT), *unit(cut, seeds=1, rl__environment_steps=3_000)]
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    second = cut / "dsrl-na-past-seed0" / "buffer" / "000001.safetensors"
    deadline = time.monotonic() + 300
    while not second.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert second.exists() and not (cut / "results.jsonl").exists()

    assert benchmark.main(["--resume", "--out", str(cut)]) == 0
    rows = stored(cut)

    def places(rows):
        return [(row["evaluation"], row["environment_steps"] // 300) for row in rows]

    assert places(rows) == places(expected)
    # What was saved before the kill stands as in the run that was never interrupted.
    assert rows[:3] == expected[:3]
    assert 3_000 <= rows[-1]["environment_steps"] < 3_032
