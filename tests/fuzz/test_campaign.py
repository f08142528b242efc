"""The instrument itself: it finds what it is for, and its cases repeat."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from tests.fuzz import demonstrations, policies, sandbox, states
from tests.fuzz.sandbox import Outcome, attempt


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
        (lambda: bytearray(3 * 2**26) and Outcome("equal"), "memory"),
    ],
)
def test_outcomes(monkeypatch, load, kind):
    ballast = bytearray(2**28)  # as in the process of a long suite
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 8.0)
    monkeypatch.setattr(sandbox, "LIMIT_BYTES", 2**27)
    outcome = attempt(load, "here/file")
    assert outcome.kind == kind
    assert outcome.failed == (kind not in ("equal", "refused"))
    assert len(ballast) > sandbox.LIMIT_BYTES


@pytest.mark.parametrize("subject", [demonstrations, policies, states], ids=lambda s: s.NAME)
def test_some_cases_of_each(tmp_path, subject):
    subject.make(tmp_path)
    for seed in range(1000, 1006):
        how, load, names = subject.mutate(tmp_path, np.random.default_rng(seed))
        assert subject.mutate(tmp_path, np.random.default_rng(seed))[0] == how
        outcome = attempt(load, names)
        assert not outcome.failed, (seed, how, outcome)
