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

from tests.benchmarks.conftest import options

pytest.importorskip("robosuite")

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "robomimic.py"


@pytest.fixture(scope="module")
def benchmark():
    return importlib.import_module("robomimic")


def test_run_writes_results_table_and_pictures(benchmark, dataset, tmp_path, capsys, monkeypatch):
    out = tmp_path / "runs" / "first"
    assert benchmark.main(options(dataset, out, episodes=3)) == 0
    stored = json.loads((out / "results.json").read_text())
    assert {row["prior"] for row in stored["rows"]} == {"gaussian", "past", "preview"}
    row = stored["rows"][0]
    fields = "task data prior sigma chunk nfe seed checkpoint episodes successes success_rate"
    assert set(fields.split()) <= set(row)
    assert row["success_rate"] == row["successes"] / row["episodes"]
    meta = stored["meta"]
    assert meta["data_source"] == "file"
    assert {"versions", "options", "hardware", "wall_time_s"} <= set(meta)
    table = (out / "table.md").read_text()
    assert "WP-Past" in table and table in capsys.readouterr().out
    assert (out / "success.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "learning_curves.png").exists()
    if benchmark.rendering_backend() is not None:
        assert len(list(out.glob("filmstrip_*.png"))) == 3

    # The folder is never overwritten, and a second run of the same options trains nothing again. Two
    # workers play other episodes one after another in their simulators than one, with the same rows.
    assert benchmark.main(options(dataset, out)) == 2
    assert "--resume" in capsys.readouterr().err
    policies = sorted((out.parent / "policies").iterdir())
    written = [path.stat().st_mtime_ns for p in policies for path in p.rglob("*.safetensors")]
    monkeypatch.setattr(benchmark, "rendering_backend", lambda: None)
    second = tmp_path / "runs" / "second"
    assert benchmark.main(options(dataset, second, episodes=3, envs=2, prior="past")) == 0
    assert "libegl1" in capsys.readouterr().out
    again = [path.stat().st_mtime_ns for p in policies for path in p.rglob("*.safetensors")]
    assert again == written
    rows = json.loads((second / "results.json").read_text())["rows"]
    assert rows == [row for row in stored["rows"] if row["prior"] == "past"]


def test_a_prior_of_ones_own_enters_by_its_place(benchmark, dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "rendering_backend", lambda: None)
    out, place = tmp_path / "runs" / "own", "tests.benchmarks.user_priors:HeldAction"
    argv = options(dataset, out, prior=["gaussian", place], sigma=0.2, envs=2)
    assert benchmark.main(argv) == 0
    assert "NFE 1: Base | NFE 1: Held action |" in capsys.readouterr().out
    stored = json.loads((out / "results.json").read_text())
    assert [(row["prior"], row["sigma"]) for row in stored["rows"]] == [
        ("gaussian", 1.0),
        ("held", 0.2),
    ]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"sigma": -1}, "sigma"),
        ({"nfe": 0}, "nfe"),
        ({"episodes": 0}, "episodes"),
        ({"iterations": 0}, "checkpoints|iterations"),
        ({"chunk": 0}, "chunk_length"),
        ({"device": "cuda:99"}, "CUDA device|device"),
        ({"task": "can"}, "holds demonstrations of lift"),
        ({"demonstrations": 5}, "leave out"),
        ({"prior": "gaussian", "sigma": 0.5}, "--sigma"),
        ({"prior": "regression", "nfe": 9}, "regression"),
        ({"prior": "nobodys"}, "unknown prior 'nobodys'"),
        ({"prior": "no.such.module:Prior"}, "no prior at no.such.module:Prior"),
        ({"dataset": "missing.hdf5"}, "missing.hdf5"),
    ],
)
def test_bad_options_stop_before_any_work(benchmark, dataset, tmp_path, capsys, extra, message):
    assert benchmark.main(options(dataset, tmp_path / "out", **extra)) == 2
    error = capsys.readouterr().err
    assert any(word in error for word in message.split("|")), error
    assert not list(tmp_path.glob("policies/*"))


def test_resuming_takes_the_stored_options_and_refuses_others(benchmark, dataset, tmp_path):
    args = benchmark.parse(options(dataset, tmp_path, chunk=4, sigma=0.3))
    benchmark.experiment.store_options(args)
    again = benchmark.parse(["--resume", "--out", str(tmp_path)])
    assert {**vars(again), "resume": False} == {**vars(args), "dataset": dataset.resolve()}
    with pytest.raises(ValueError, match=r"started with --sigma 0\.3"):
        benchmark.parse(["--resume", "--out", str(tmp_path), "--sigma", "0.5"])
    assert benchmark.parse(["--resume", "--out", str(tmp_path), "--envs", "3"]).envs == 3


def test_default_folders_are_numbered_past_the_latest(benchmark, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(benchmark.parse([]).out) == "runs/square-ph-quick"
    (tmp_path / "runs" / "square-ph-quick-2").mkdir(parents=True)
    assert str(benchmark.parse([]).out) == "runs/square-ph-quick-3"
    assert str(benchmark.parse(["--resume"]).out) == "runs/square-ph-quick-2"


def test_task_without_expert_names_the_official_data(benchmark, tmp_path, capsys):
    argv = ["--task", "tool_hang", "--out", str(tmp_path / "out")]
    assert benchmark.main(argv) == 2
    assert "--download" in capsys.readouterr().err


def test_output_folder_that_is_a_file_is_refused_first(benchmark, dataset, tmp_path, capsys):
    (tmp_path / "out").write_text("not a folder")
    assert benchmark.main(options(dataset, tmp_path / "out")) == 2
    assert str(tmp_path / "out") in capsys.readouterr().err


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
    started = time.monotonic()
    assert launch(undisturbed).wait() == 0
    duration = time.monotonic() - started
    for share in (0.4, 0.6, 0.8):
        process = launch(killed, "--resume")
        time.sleep(share * duration)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert launch(killed, "--resume").wait() == 0

    rows = [json.loads((out / "results.json").read_text())["rows"] for out in (undisturbed, killed)]
    assert rows[0] == rows[1]
    weights = [
        load_file(next((out.parent / "policies").rglob("policy_*/model.safetensors")))
        for out in (undisturbed, killed)
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all((weights[0][name] == weights[1][name]).all() for name in weights[0])
