import os
import re
import signal
import subprocess
import sys
import time

import navigation1d
import psutil
import pytest
import robomimic

from lab.options.command_line import parse, started
from lab.options.presets import PRESETS
from lab.running import pictures
from tests.benchmarks.script_parts import command_line, described, is_png, options, refused, stored, written
from tests.processes import apart
from warmprior.envs import rendering_backend
from warmprior.envs.robosuite_tasks import TaskSpec
from warmprior.saving.training_state import load_state


def test_run_writes_rows_report_and_pictures(dataset, tmp_path, capfd, monkeypatch):
    out = tmp_path / "runs" / "first"
    monkeypatch.setattr(TaskSpec, "horizon", lambda spec, style: 9)  # episodes of two decisions
    with monkeypatch.context() as patch:
        patch.setattr(pictures, "rendering_backend", rendering_backend)
        few = {"prior": ["gaussian", "past"], "episodes": 3}
        assert apart(robomimic.main)(options(dataset, out, **few)) == 0
    rows = stored(out)
    assert [row["prior"] for row in rows] == ["gaussian", "past"]
    facts = {"task": "lift", "data": "ph", "chunk": 8, "iterations": 30, "episodes": 3}
    for row in rows:
        assert facts.items() <= row.items() and row["training_seconds"] > 0
        assert re.fullmatch("[01]{3}", row["outcomes"])
        assert row["outcomes"].count("1") == row["successes"] == row["success_rate"] * 3
    (task,) = described(out, "tasks")
    assert task["source"] == "file" and task["demonstrations"] == 3
    report, printed = (out / "report.md").read_text(), capfd.readouterr().out
    assert "measured (file data)" in report and "network mlp,hidden_dim=16 (chi_transformer)" in report
    assert "Success (%), gain over Gaussian source" in printed and "played lift ph, past" in printed
    assert is_png(out / "success.png") and is_png(out / "learning_curves.png")
    assert len(list(out.glob("filmstrip_*.png"))) == (0 if rendering_backend() is None else 2)

    # The folder is never overwritten.
    before = (out / "results.jsonl").read_bytes()
    assert "--resume" in refused(robomimic.main, options(dataset, out), capfd)
    assert (out / "results.jsonl").read_bytes() == before
    # A second run of the same options trains nothing again, and its rows are the same.
    (state,) = out.parent.glob("policies/*-past-*/state.safetensors")
    state.unlink()  # a finished policy does not need it
    times, second = written(out.parent / "policies"), tmp_path / "runs" / "second"

    def broken(*args, **options):
        raise AttributeError("no renderer")

    with monkeypatch.context() as patch:
        patch.setattr(pictures, "rendering_backend", lambda: "egl")
        patch.setattr(pictures, "record_filmstrip", broken)
        assert robomimic.main(options(dataset, second, episodes=3, prior="past")) == 0
    printed = capfd.readouterr().out
    assert "WP-Past: no renderer" in printed and str(state) in printed  # and the run is whole
    assert is_png(second / "success.png") and not (second / "learning_curves.png").exists()
    assert "found lift ph, past" in printed and written(out.parent / "policies") == times
    assert stored(second) == [row for row in rows if row["prior"] == "past"]


def test_default_folders_are_numbered_past_the_latest(tmp_path, monkeypatch):
    def read(*argv):
        return parse(PRESETS, argv, "robomimic", None)

    monkeypatch.chdir(tmp_path)
    for number in ("", "-2"):
        with started(read(), "robomimic") as out:
            assert str(out) == f"runs/can-ph-quick{number}"
    assert str(read().run.out) == "runs/can-ph-quick-3"
    assert str(read("--resume").run.out) == "runs/can-ph-quick-2"
    assert str(read("--task", "can", "stack", "--preset", "cpu").run.out) == "runs/can-stack-ph-cpu"


@pytest.mark.slow
def test_a_killed_process_of_torchrun_ends_all_and_one_process_resumes(tmp_path):
    env, pipe = os.environ | {"OMP_NUM_THREADS": "1"}, {"stderr": subprocess.PIPE, "text": True}
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    few = {"prior": "past", "iterations": 2000, "save_every": 20, "episodes": 8, "logger": "none"}
    argv = command_line(**few, sigma=0.5, out=tmp_path / "out")
    process = subprocess.Popen([*torchrun, navigation1d.__file__, *argv], env=env, **pipe)
    end = time.monotonic() + 120
    while not (states := list(tmp_path.glob("policies/*/state.safetensors"))):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    trainings = psutil.Process(process.pid).children()
    (second,) = (one for one in trainings if one.environ().get("RANK") == "1")
    os.kill(second.pid, signal.SIGKILL)
    _, err = process.communicate(timeout=60)
    assert process.returncode != 0 and "navigation1d.py" in err
    assert 0 < load_state(states[0])[1]["iteration"] < 2000
    assert navigation1d.main(["--resume", "--out", str(tmp_path / "out")]) == 0
    assert load_state(states[0])[1]["iteration"] == 2000
