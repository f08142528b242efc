"""Jobs on a Ray cluster: results and errors arrive, and nobody works on in vain."""

from __future__ import annotations

import importlib
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.processes import apart, ended
from warmprior.io import ray_pool
from warmprior.io.ray_pool import RayPool, check_ray
from warmprior.io.workers import Failure, WorkerError

pytest.importorskip("ray")


OWN_CODE = """
import os, time

class State:
    # Tells, in a file, that it was made.
    def __init__(self, folder):
        self.folder = folder
        (folder / f"made-{os.getpid()}-{time.monotonic_ns()}").touch()
"""


def facts(number, state):
    return number, os.getpid(), torch.get_num_threads(), torch.get_float32_matmul_precision()


def fail(state):
    raise ValueError("it cannot be done")


def die(times, state):
    """Kill this process, as often as this."""
    path = state.folder / f"deaths-of-{times}"
    died = len(path.read_text()) if path.exists() else 0
    if died < times:
        path.write_text("x" * (died + 1))
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def sleep(state):
    (state.folder / "sleeper").write_text(str(os.getpid()))
    time.sleep(600)


def gathered(pool, jobs):
    for job in jobs:
        pool.submit(job)
    results = {}
    while pool.running:
        results.update(pool.wait(60))
    return [results[job] for job in jobs]


@apart
def test_jobs_give_results_or_failures_and_end_with_the_context(ray_address, tmp_path, monkeypatch):
    torch.set_float32_matmul_precision("high")
    # Found by this process alone, until its workers are told where.
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "users_own_module.py").write_text(OWN_CODE)
    make_state = partial(importlib.import_module("users_own_module").State, tmp_path)
    pool = RayPool(make_state, address=ray_address, folders=[tmp_path], retries=1)
    with pytest.raises(KeyboardInterrupt), pool:
        assert pool.num_workers == pool.idle == 2 and pool.wait(0) == []
        jobs = [partial(facts, number) for number in range(6)]
        told = gathered(pool, jobs)
        assert [number for number, *_ in told] == list(range(6))
        assert {fact[2:] for fact in told} == {(1, "high")}
        made = [path.name.split("-")[1] for path in tmp_path.glob("made-*")]
        assert sorted(made) == sorted({str(pid) for _, pid, *_ in told}) and len(made) <= 2
        jobs = [fail, partial(die, 1), partial(die, 2), partial(facts, 7)]
        failed, retried, dead, fine = gathered(pool, jobs)
        assert failed == Failure("it cannot be done")
        assert retried == "alive" and fine[0] == 7
        assert isinstance(dead, Failure) and "killed 2 times" in dead.reason
        pool.submit(sleep)
        assert pool.idle == 1
        while not (tmp_path / "sleeper").exists():
            assert pool.wait(0.1) == []
        raise KeyboardInterrupt
    assert not list(tmp_path.glob(".shared-*"))
    sleeper, end = int((tmp_path / "sleeper").read_text()), time.monotonic() + 10
    while not ended(sleeper):
        assert time.monotonic() < end, "a job goes on after its pool was left"
        time.sleep(0.1)


@apart
def test_machines_that_could_not_do_the_work_are_refused(ray_address, tmp_path, monkeypatch):
    # The same path, and another folder for each process: as if it were not shared.
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(OSError, match=r"node .* does not see what is written to /proc/self/cwd"),
        RayPool(dict, address=ray_address, folders=[Path("/proc/self/cwd")]),
    ):
        pytest.fail("it went on")
    mine = ray_pool.versions()
    monkeypatch.setattr(ray_pool, "versions", lambda: {**mine, "torch": "0.4.1"})
    told = rf"node .* has torch {torch.__version__.partition('+')[0]}.*, and this process 0.4.1"
    with pytest.raises(WorkerError, match=told), RayPool(dict, address=ray_address):
        pytest.fail("it went on")


def test_what_is_no_cluster_is_refused_within_seconds(monkeypatch):
    started = time.monotonic()
    with pytest.raises(
        ConnectionError, match=r"127\.0\.0\.1:1 is no cluster.*refused.*ray start --head"
    ):
        check_ray("127.0.0.1:1")
    for told in ("localhost", "ray://head:10001"):
        with pytest.raises(ValueError, match="HOST:PORT"):
            check_ray(told)
    assert time.monotonic() - started < 5
    monkeypatch.setattr(ray_pool, "PATIENCE", 3.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises(ConnectionError, match="does not answer within 3 seconds"):
            check_ray()
    monkeypatch.delenv("RAY_ADDRESS")
    assert check_ray() is None


def test_another_python_or_ray_is_named(ray_address):
    """Ray compares these itself; its words arrive."""
    assert check_ray(ray_address) == ray_address
    # As a cluster of another version sees it.
    before = "import ray; ray.__version__ = '1.0.0'\n"
    command = [sys.executable, "-c", before + ray_pool.CONNECT, ray_address]
    done = subprocess.run(command, stderr=subprocess.PIPE, timeout=60, check=False)
    assert done.returncode and "1.0.0" in ray_pool.reason_of(done.stderr)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    for attempt in (check_ray, partial(RayPool, dict)):
        with pytest.raises(ImportError, match=r"ray is not installed.*warmprior\[ray\]"):
            attempt()
