"""Whole scripts under torchrun: the rows of one process, and a killed process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.benchmarks.script_parts import command_line
from warmprior.training.checkpoint import load_state

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

ROOT = Path(__file__).parents[2]
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


def start(script, argv, launcher=TORCHRUN):
    return subprocess.Popen(
        [*launcher, str(ROOT / "benchmarks" / script), *map(str, argv)],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run(script, argv, launcher=TORCHRUN):
    process = start(script, argv, launcher)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def second_process(parent, deadline=60):
    """Of those that torchrun started."""
    end = time.monotonic() + deadline
    while time.monotonic() < end:
        for path in Path("/proc").glob("[0-9]*"):
            try:
                born = int((path / "stat").read_text().rpartition(")")[2].split()[1])
                if born == parent and b"\0RANK=1\0" in b"\0" + (path / "environ").read_bytes():
                    return int(path.name)
            except OSError:
                pass  # it has ended
        time.sleep(0.1)
    raise AssertionError("torchrun started no second process")


@pytest.mark.slow
def test_a_killed_process_ends_all_and_one_process_resumes(tmp_path):
    out = tmp_path / "out"
    argv = command_line(
        out=out, prior="past", sigma=0.5, iterations=2000, save_every=20, episodes=8, logger="none"
    )
    process = start("navigation1d.py", argv)
    second = second_process(process.pid)
    end = time.monotonic() + 120
    while not (states := list(tmp_path.glob("policies/*/state.safetensors"))):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    os.kill(second, signal.SIGKILL)
    _, err = process.communicate(timeout=60)
    assert process.returncode != 0 and "navigation1d.py" in err
    reached = load_state(states[0])[1]["iteration"]
    assert 0 < reached < 2000
    code, said, err = run("navigation1d.py", ["--resume", "--out", out], (sys.executable,))
    assert code == 0, err
    assert load_state(states[0])[1]["iteration"] == 2000 and "WP-Past" in said


@pytest.mark.slow
def test_scripts_of_one_process_refuse_several(tmp_path):
    code, _, err = run("prior_space_rl.py", ["--preset", "unit", "--out", tmp_path / "out"])
    assert code != 0 and "trains with one process; start it without torchrun" in err
    assert not (tmp_path / "out").exists()
