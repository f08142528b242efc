"""The benchmark from the command line: files, table, errors, and resuming after SIGKILL."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

from tests.benchmarks.script_parts import is_png, options, refused, stored, written
from tests.processes import apart

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

from warmprior.experiments import PRESETS, parse, started, success_study
from warmprior.io.files import exclusive

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "robomimic.py"


@pytest.fixture(scope="module")
def benchmark():
    return importlib.import_module("robomimic")


def read(*argv):
    """The recipe of a command line of robomimic.py."""
    return parse(PRESETS, list(map(str, argv)), study="robomimic")


def start(*argv):
    """Begin the run of a command line, and leave it at that."""
    recipe = read(*argv)
    with started(recipe, "robomimic"):
        pass
    return recipe


def test_run_writes_results_table_and_pictures(benchmark, dataset, tmp_path, capfd, monkeypatch):
    out = tmp_path / "runs" / "first"
    assert apart(benchmark.main)(options(dataset, out, episodes=3)) == 0
    result = stored(out)
    assert [row["prior"] for row in result["rows"]] == ["gaussian", "past", "preview"]
    row = result["rows"][0]
    fields = (
        "task data prior options sigma chunk nfe seed iterations checkpoint episodes successes "
        "success_rate"
    )
    assert set(fields.split()) <= set(row)
    assert (row["task"], row["data"], row["chunk"], row["iterations"]) == ("lift", "ph", 8, 30)
    assert row["episodes"] == 3 and row["success_rate"] == row["successes"] / 3
    meta = result["meta"]
    (problem,) = meta["problems"]
    assert problem["source"] == "file" and problem["demonstrations"] == 3
    assert {"versions", "identity", "policies", "hardware", "wall_time_s"} <= set(meta)
    assert meta["identity"]["recipe"]["training"]["iterations"] == 30
    assert meta["hardware"]["workers"] == 1
    table = (out / "table.md").read_text()
    assert "measured (file data)" in table and table in capfd.readouterr().out
    assert "NFE 1: WP-Past" in table
    assert "Network and training budget are smaller" in table
    assert is_png(out / "success.png") and is_png(out / "learning_curves.png")
    if success_study.rendering_backend() is not None:
        assert len(list(out.glob("filmstrip_*.png"))) == 3

    # The folder is never overwritten, and a second run of the same options trains nothing again. Two
    # workers play other episodes one after another in their simulators than one, with the same rows.
    before = (out / "results.json").read_bytes()
    assert "--resume" in refused(benchmark.main, options(dataset, out), capfd)
    assert (out / "results.json").read_bytes() == before
    policies = out.parent / "policies"
    times = written(policies)
    assert len({path.parents[1] for path in times if "policy_" in str(path)}) == 3
    monkeypatch.setattr(success_study, "rendering_backend", lambda: None)
    second = tmp_path / "runs" / "second"
    assert benchmark.main(options(dataset, second, episodes=3, envs=2, prior="past")) == 0
    assert "libegl1" in capfd.readouterr().out
    assert written(policies) == times
    assert stored(second)["rows"] == [row for row in result["rows"] if row["prior"] == "past"]


def test_a_prior_of_ones_own_enters_by_its_place(benchmark, dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(success_study, "rendering_backend", lambda: None)
    out, place = tmp_path / "runs" / "own", "tests.benchmarks.user_priors:HeldAction"
    argv = options(dataset, out, prior=["gaussian", place], sigma=0.2, envs=2)
    assert benchmark.main(argv) == 0
    assert "NFE 1: Base | NFE 1: held |" in capsys.readouterr().out
    assert [(row["prior"], row["sigma"]) for row in stored(out)["rows"]] == [
        ("gaussian", 1.0),
        ("held", 0.2),
    ]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"sigma": -1}, "sigma"),
        ({"nfe": 0}, "--nfe must be between 1 and"),
        ({"episodes": 0}, "--episodes must be between 1 and"),
        ({"episodes": 2_000_000}, "--episodes must be between 1 and 1,000,000"),
        ({"seeds": 0}, "--seeds must be between 1 and"),
        ({"seeds": 1_001}, "--seeds must be between 1 and 1,000, got 1001"),
        ({"envs": 0}, "--envs must be between 1 and"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"chunk": 0}, "--chunk must be between 1 and"),
        ({"device": "cuda:99"}, "--device cuda:99 does not work here"),
        ({"task": "can"}, "holds demonstrations of lift"),
        ({"task": ["lift", "can"]}, "name at most one --task"),
        ({"demonstrations": 5}, "there are 3 demonstrations, fewer than the 5 to be taken"),
        ({"prior": "gaussian", "sigma": 0.5}, "--sigma belongs to warm priors"),
        ({"prior": "regression", "nfe": 9}, "regression"),
        ({"prior": "nobodys"}, "unknown prior 'nobodys'"),
        ({"prior": "no.such.module:Prior"}, "no prior at no.such.module:Prior"),
        ({"dataset": "missing.hdf5"}, "--dataset missing.hdf5: no such file"),
        ({"preset": "nobodys"}, "--preset must be one of quick, cpu, paper"),
        ({"chunk": 41}, "predicts more steps than the longest demonstration"),
    ],
    ids=str,
)
def test_bad_options_stop_before_any_work(
    benchmark, dataset, tmp_path, capsys, no_work, extra, message
):
    told = refused(benchmark.main, options(dataset, tmp_path / "out", **extra), capsys)
    assert message in told
    assert not list(tmp_path.glob("policies/*"))


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        (["--nfe", "0"], "--nfe must be between 1 and 1,000,000, got 0"),
        (["--task", "tool_hang", "--download", "--dataset", "x.hdf5"], "leave out --download"),
    ],
)
def test_an_error_is_one_line_with_the_scripts_name(benchmark, tmp_path, capsys, extra, told):
    assert benchmark.main([*extra, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("robomimic.py: error: ") and error.endswith("\n")
    assert told in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--episods 3", "--episods"),
        ("--rl.delta 1", "--rl.delta"),
        ("--logger paper", "invalid choice 'paper'"),
        ("--data xy", "invalid choice 'xy'"),
        ("--episodes many", "--episodes"),
    ],
)
def test_what_is_no_option_is_told_by_the_parser(benchmark, tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        benchmark.main([*words.split(), "--out", str(tmp_path / "out")])
    told = capsys.readouterr()
    assert stop.value.code == 2 and message in told.err and not told.out
    assert not (tmp_path / "out").exists()


def test_resuming_takes_the_stored_options_and_refuses_others(dataset, tmp_path):
    recipe = start(*options(dataset, tmp_path, chunk=4, sigma=0.3))
    assert recipe.sources.chunk == (4,) and recipe.sources.sigma == (0.3,)
    resume = ["--resume", "--out", tmp_path]
    again = read(*resume)
    for part in ("network", "training", "sources", "evaluation"):
        assert getattr(again, part) == getattr(recipe, part)
    assert again.data.dataset == dataset.resolve() and again.run.logger == "none"
    with pytest.raises(ValueError, match=r"was started with --sigma 0\.3: leave these out"):
        read(*resume, "--sigma", "0.5")
    with pytest.raises(ValueError, match=r"was started with no --compile: leave"):
        read(*resume, "--compile", "--logger", "csv")
    assert read(*resume, "--sigma", "0.3") == again  # to repeat an option does no harm
    assert read(*resume, "--envs", "3").run.envs == 3
    (tmp_path / "results.json").write_text("{}")
    # Never in place of a run, and only what was begun is continued.
    with pytest.raises(ValueError, match="holds a run: add --resume"):
        read(*options(dataset, tmp_path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"--resume: there is no run in .*empty"):
        read("--resume", "--out", tmp_path / "empty")


@pytest.mark.parametrize("text", ["", "[]", '{"study": "robomimic", "data": {"tusk": []}}'])
def test_damaged_options_are_named(tmp_path, text):
    (tmp_path / "options.json").write_text(text)
    with pytest.raises(ValueError, match=r"options\.json|another study"):
        read("--resume", "--out", tmp_path)


def test_default_folders_are_numbered_past_the_latest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(start().run.out) == "runs/square-ph-quick"
    assert str(start().run.out) == "runs/square-ph-quick-2"
    (tmp_path / "runs" / "square-ph-quick-old").mkdir()
    assert str(read().run.out) == "runs/square-ph-quick-3"
    assert str(read("--resume").run.out) == "runs/square-ph-quick-2"
    assert str(read("--data", "mh", "--preset", "cpu").run.out) == "runs/square-mh-cpu"
    assert str(read("--task", "can", "stack").run.out) == "runs/can-stack-ph-quick"


def test_another_process_in_the_folder_is_refused(benchmark, dataset, tmp_path, capsys):
    out = tmp_path / "out"
    with exclusive(out):
        assert f"{out} is in use by another process" in refused(
            benchmark.main, options(dataset, out), capsys
        )
    assert not list(out.iterdir())


def test_task_without_expert_names_the_official_data(benchmark, tmp_path, capsys):
    argv = ["--task", "tool_hang", "--out", str(tmp_path / "out")]
    assert "--download" in refused(benchmark.main, argv, capsys)


def test_output_folder_that_is_a_file_is_refused_first(benchmark, dataset, tmp_path, capsys):
    (tmp_path / "out").write_text("not a folder")
    told = refused(benchmark.main, options(dataset, tmp_path / "out"), capsys)
    assert str(tmp_path / "out") in told


@pytest.mark.slow
def test_killed_run_resumes_to_the_same_result(dataset, tmp_path):
    """Kill the process at several moments; rows and weights equal those of an undisturbed run."""

    def launch(out, *extra):
        argv = [*options(dataset, out, iterations=3000, episodes=2, prior="past"), *extra]
        return subprocess.Popen(
            [sys.executable, str(SCRIPT), *argv],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    undisturbed, killed = tmp_path / "a" / "out", tmp_path / "b" / "out"
    begin = time.monotonic()
    assert launch(undisturbed).wait() == 0
    duration = time.monotonic() - begin
    ends = []
    for share in (0.4, 0.6, 0.8):
        resume = ["--resume"] if (killed / "options.json").exists() else []
        process = launch(killed, *resume)
        time.sleep(share * duration)
        os.killpg(process.pid, signal.SIGKILL)
        ends.append(process.wait())
    assert ends[0] == -signal.SIGKILL  # the others may have been through by then
    assert launch(killed, "--resume").wait() == 0

    rows = [json.loads((out / "results.json").read_text())["rows"] for out in (undisturbed, killed)]
    assert rows[0] == rows[1]
    weights = [
        load_file(next((out.parent / "policies").rglob("policy_*/model.safetensors")))
        for out in (undisturbed, killed)
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all((weights[0][name] == weights[1][name]).all() for name in weights[0])
