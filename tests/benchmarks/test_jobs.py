"""Jobs on fake work: order, failures, dead workers, killed drivers; on this machine and on Ray."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import psutil
import pytest

pytest.importorskip("loky")
pytest.importorskip("tyro")

import jobs
from jobs import Jobs
from options import Run

from warmprior.io import workers

FOLDER = Path(__file__).parent


class AwkwardError(Exception):
    """One that cannot be pickled: its constructor takes other arguments than it keeps."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def train(folder, number):
    path = Path(folder) / f"policy{number}"
    if not path.exists():
        if number == 1:
            raise ValueError("the loss is NaN")
        if number == 2:
            raise AwkwardError(1, 2)
        if number == 6:
            sys.exit(3)
        if number == 3:
            os._exit(9)  # dies every time
        dies = Path(folder) / f"dies{number}"
        if dies.exists():
            dies.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        path.write_text(str(number * number))
    return str(path)


def play(folder, number, episode):
    return int((Path(folder) / f"policy{number}").read_text()) + episode


def compute(run, folder, numbers=range(6)):
    """Train policies, play two episodes with each; what came out, and what failed."""
    found = {}
    with Jobs(run, [folder]) as pool:
        for n in numbers:
            trained = pool.submit(f"train {n}", train, folder, n, group=f"policy {n}", training=True)
            for e in range(2):
                pool.submit(
                    f"play {n} {e}",
                    play,
                    folder,
                    n,
                    e,
                    after=trained,
                    group=f"policy {n}",
                    then=lambda result, n=n, e=e: found.__setitem__((n, e), result),
                )
        failures = pool.wait()
    return found, failures


@pytest.mark.parametrize("engine", ["local", pytest.param("ray", marks=pytest.mark.slow)])
def test_failures_cost_themselves_alone(engine, tmp_path, monkeypatch, capsys):
    if engine == "ray":
        pytest.importorskip("ray")
    monkeypatch.setattr(workers, "_forks", True)  # whatever Ray makes of it, it is as before afterwards
    monkeypatch.setattr(jobs, "DEATHS", 2)
    (tmp_path / "dies4").touch()  # its first worker is killed while it trains
    found, failures = compute(Run(envs=2, engine=engine), tmp_path, (0, 1, 2, 3, 4, 6))
    assert found == {(n, e): n * n + e for n in (0, 4) for e in range(2)}
    assert sorted(failures) == ["policy 1", "policy 2", "policy 3", "policy 6"]
    assert "the loss is NaN" in failures["policy 1"] and "1 and 2" in failures["policy 2"]
    assert "died" in failures["policy 3"] and "train 3" in failures["policy 3"]
    assert "SystemExit(3)" in failures["policy 6"]
    assert capsys.readouterr().out.count("FAILED") == 4


class Slots:
    """An engine of so many slots whose jobs end at once; it notes the order of starts."""

    def __init__(self, workers):
        self.workers, self.jobs, self.killed = workers, [], None

    def takes(self, job):
        return sum(not running.done for running in self.jobs) < self.workers

    def submit(self, job):
        self.jobs.append(job)
        future = Future()
        future.set_result((None, None))
        return future

    def close(self, kill):
        self.killed = kill


def test_the_last_trainings_start_before_episodes(monkeypatch):
    engine = Slots(2)
    monkeypatch.setattr(jobs, "Local", lambda *_: engine)
    with Jobs(Run()) as pool:
        for n in range(5):
            trained = pool.submit(f"train {n}", train, training=True)
            pool.submit(f"play {n}", play, after=trained)
        assert pool.wait() == {}
    assert engine.killed is False
    started = [job.name for job in engine.jobs]
    assert sorted(started) == sorted(f"{k} {n}" for n in range(5) for k in ("train", "play"))
    place = {name: i for i, name in enumerate(started)}
    assert all(place[f"train {n}"] < place[f"play {n}"] for n in range(5))
    # A policy is played before the next is trained, but the last two trainings wait for no episode.
    assert place["play 0"] < place["train 2"] and place["train 4"] < place["play 2"]


def test_an_error_of_the_driver_kills_the_workers(monkeypatch):
    engine = Slots(1)
    monkeypatch.setattr(jobs, "Local", lambda *_: engine)
    with pytest.raises(OSError, match="full"), Jobs(Run()) as pool:
        pool.submit("write", train, then=lambda result: (_ for _ in ()).throw(OSError("disk full")))
        pool.wait()
    assert engine.killed is True


SLEEP = """
import sys, time
from jobs import Jobs
from options import Run
from warmprior.io.script import run_script
def main():
    with Jobs(Run(envs=2)) as pool:
        for i in range(4):
            pool.submit(f"sleep {i}", time.sleep, 60)
        print("ready", flush=True)
        pool.wait()
sys.exit(run_script(main, "sleep.py"))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_driver(how, tmp_path):
    script = tmp_path / "sleep.py"
    script.write_text(SLEEP)
    root = FOLDER.parents[1]
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(root / "benchmarks")])}
    process = subprocess.Popen(
        [sys.executable, str(script)],
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        # A shell may have the signal ignored for what it starts in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stdout.readline() == b"ready\n"
    driver = psutil.Process(process.pid)
    deadline = time.monotonic() + 60
    while len(driver.children(recursive=True)) < 3 and time.monotonic() < deadline:
        time.sleep(0.1)  # two workers and loky's resource tracker
    time.sleep(3)
    children = driver.children(recursive=True)
    # As Ctrl-C on a terminal does: all of them get it.
    os.killpg(process.pid, how) if how == signal.SIGINT else os.kill(process.pid, how)
    code = process.wait(30)
    _, alive = psutil.wait_procs(children, timeout=15)
    assert not alive
    if how == signal.SIGINT:
        assert code == 130
        assert process.stderr.read().decode().splitlines()[-1] == "sleep.py: interrupted; --resume continues"
