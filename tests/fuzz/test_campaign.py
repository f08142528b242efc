"""The instrument itself: it finds what it is for, and its cases repeat."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.fuzz import sandbox
from tests.fuzz.sandbox import Outcome, attempt

ROOT = Path(__file__).parents[2]


def _raise(error):
    raise error


@pytest.mark.parametrize(
    ("load", "kind"),
    [
        (lambda: Outcome("equal"), "equal"),
        (lambda: Outcome("silent"), "silent"),
        (lambda: _raise(ValueError("here/file is damaged")), "refused"),
        (lambda: _raise(ValueError("it is damaged")), "unclear"),
        (lambda: _raise(KeyError("here/file")), "unclear"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "crash"),
        (lambda: time.sleep(60), "hang"),
        (lambda: bytearray(3 * 2**25) and Outcome("equal"), "memory"),
    ],
)
def test_outcomes(monkeypatch, load, kind):
    ballast = bytearray(2**27)  # as in the process of a long suite
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 0.5 if kind == "hang" else 30.0)
    monkeypatch.setattr(sandbox, "LIMIT_BYTES", 2**26)
    outcome = attempt(load, "here/file")
    assert outcome.kind == kind
    assert outcome.failed == (kind not in ("equal", "refused"))
    assert len(ballast) > sandbox.LIMIT_BYTES


@pytest.mark.slow
def test_a_short_campaign():
    # In a process of its own, as always: a fork of this one could wait for locks that threads of other
    # libraries held when it was made.
    command = [sys.executable, "-W", "ignore", "-m", "tests.fuzz", "--cases", "3", "--seed", "1000"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[2:7] for line in done.stdout.splitlines()[2:5]]
    for cases, *counts in rows:
        assert int(cases) == sum(map(int, counts)) == 3
