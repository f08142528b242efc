"""The benchmark from the command line: files, table, errors, and resuming after SIGKILL."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

from tests.benchmarks.script_parts import described, is_png, options, refused, stored, written
from tests.processes import apart

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import pictures
import robomimic
from options import PRESETS, parse, started

from warmprior.envs import rendering_backend

SCRIPT = Path(robomimic.__file__)


def read(*argv):
    """The options of a command line of robomimic.py."""
    return parse(PRESETS, list(map(str, argv)), "robomimic", None)


def begin(*argv):
    """Begin the run of a command line, and leave it at that."""
    found = read(*argv)
    with started(found, "robomimic"):
        pass
    return found


def test_run_writes_rows_report_and_pictures(dataset, tmp_path, capfd, monkeypatch):
    out = tmp_path / "runs" / "first"
    with monkeypatch.context() as patch:
        patch.setattr(pictures, "rendering_backend", rendering_backend)
        assert apart(robomimic.main)(options(dataset, out, episodes=3)) == 0
    rows = stored(out)
    assert [row["prior"] for row in rows] == ["gaussian", "past", "preview"]
    row = rows[0]
    assert (row["task"], row["data"], row["chunk"], row["iterations"]) == ("lift", "ph", 8, 30)
    assert row["episodes"] == 3 and row["success_rate"] == row["successes"] / 3
    assert re.fullmatch("[01]{3}", row["outcomes"]) and row["training_seconds"] > 0
    assert row["outcomes"].count("1") == row["successes"]
    (task,) = described(out, "tasks")
    assert task["source"] == "file" and task["demonstrations"] == 3
    kept = described(out, "options")
    assert kept["options"]["training"]["iterations"] == 30 and "torch" in kept["versions"]
    report, printed = (out / "report.md").read_text(), capfd.readouterr().out
    assert "measured (file data)" in report and "Network and training budget are smaller" in report
    assert "Success (%), gain over Base" in printed and "played lift ph, past" in printed
    header, first = (out / "results.csv").read_text().splitlines()[:2]
    assert dict(zip(header.split(","), first.split(","), strict=False))["prior"] == "gaussian"
    assert is_png(out / "success.png") and is_png(out / "learning_curves.png")
    films = 0 if rendering_backend() is None else 3
    assert len(list(out.glob("filmstrip_*.png"))) == films

    # The folder is never overwritten.
    before = (out / "results.jsonl").read_bytes()
    assert "--resume" in refused(robomimic.main, options(dataset, out), capfd)
    assert (out / "results.jsonl").read_bytes() == before
    # A second run of the same options trains nothing again, and its rows are the same.
    times = written(out.parent / "policies")
    assert len({path.parents[1] for path in times if "policy_" in str(path)}) == 3
    second = tmp_path / "runs" / "second"
    assert robomimic.main(options(dataset, second, episodes=3, prior="past")) == 0
    printed = capfd.readouterr().out
    assert "libegl1" in printed and "found lift ph, past" in printed
    assert written(out.parent / "policies") == times
    assert stored(second) == [row for row in rows if row["prior"] == "past"]


def test_a_prior_of_ones_own_enters_by_its_place(dataset, tmp_path, capsys):
    out, place = tmp_path / "runs" / "own", "tests.benchmarks.user_priors:HeldAction"
    argv = options(dataset, out, prior=["gaussian", place], sigma=0.2)
    assert robomimic.main(argv) == 0
    assert "NFE 1: held" in (out / "report.md").read_text()
    named = [(row["prior"], row["sigma"]) for row in stored(out)]
    assert named == [("gaussian", 1.0), ("held", 0.2)]
    # What a file says is not imported: only what was typed.
    again = ["--resume", "--out", out]
    assert "name it again, with --prior" in refused(robomimic.main, again, capsys)
    assert robomimic.main([*map(str, again), "--prior", "gaussian", place]) == 0


def test_resuming_takes_the_stored_options_and_refuses_others(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(dataset.parent)
    first = begin(*options(dataset.name, tmp_path, chunk=4, sigma=0.3, prior="past"))
    assert first.sources.chunk == (4,) and first.sources.sigma == (0.3,)
    monkeypatch.chdir(tmp_path)  # a relative path is that of the same file
    resume = ["--resume", "--out", tmp_path]
    again = read(*resume)
    for part in ("network", "training", "sources", "evaluation"):
        assert getattr(again, part) == getattr(first, part)
    assert again.data.dataset == dataset.resolve()
    for words, changed in (
        ("--sigma 0.5", "--sigma"),
        ("--compile --seeds 2", "--compile, --seeds"),
    ):
        with pytest.raises(ValueError, match=f"was started with other values of {changed}: leave"):
            read(*resume, *words.split())
    assert read(*resume, "--sigma", "0.3") == again  # to repeat an option does no harm
    assert read(*resume, "--envs", "3").run.envs == 3
    # Never in place of a run, and only what was begun is continued, by the same study.
    with pytest.raises(ValueError, match="holds a run: add --resume"):
        read(*options(dataset, tmp_path))
    with pytest.raises(ValueError, match=r"--resume: there is no run in .*empty"):
        read("--resume", "--out", tmp_path / "empty")
    with pytest.raises(ValueError, match="holds a run of robomimic: continue it with that script"):
        parse(PRESETS, list(map(str, resume)), "sigma", None)


def test_default_folders_are_numbered_past_the_latest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(begin().run.out) == "runs/square-ph-quick"
    assert str(begin().run.out) == "runs/square-ph-quick-2"
    (tmp_path / "runs" / "square-ph-quick-old").mkdir()
    assert str(read().run.out) == "runs/square-ph-quick-3"
    assert str(read("--resume").run.out) == "runs/square-ph-quick-2"
    assert str(read("--data", "mh", "--preset", "cpu").run.out) == "runs/square-mh-cpu"
    assert str(read("--task", "can", "stack").run.out) == "runs/can-stack-ph-quick"


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
    begun = time.monotonic()
    assert launch(undisturbed).wait() == 0
    duration = time.monotonic() - begun
    ends = []
    for share in (0.4, 0.6, 0.8):
        resume = ["--resume"] if (killed / "options.json").exists() else []
        process = launch(killed, *resume)
        time.sleep(share * duration)
        os.killpg(process.pid, signal.SIGKILL)
        ends.append(process.wait())
    assert ends[0] == -signal.SIGKILL  # the others may have been through by then
    assert launch(killed, "--resume").wait() == 0

    rows = [stored(out) for out in (undisturbed, killed)]
    for mine in rows:
        del mine[0]["training_seconds"]
    assert rows[0] == rows[1]
    weights = [
        load_file(next((out.parent / "policies").rglob("policy_*/model.safetensors")))
        for out in (undisturbed, killed)
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all((weights[0][name] == weights[1][name]).all() for name in weights[0])
