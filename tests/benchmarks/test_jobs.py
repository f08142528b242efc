"""Jobs on fake work: order, failures, dead workers, killed drivers; on this machine and on Ray."""

import functools
import importlib
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import psutil
import pytest
import robomimic

from lab.options.options import Run
from lab.running import jobs, pictures
from lab.running.jobs import Jobs
from tests.benchmarks.conftest import Inline
from tests.benchmarks.script_parts import options, stored
from tests.errors import raises
from tests.processes import apart
from warmprior.io.script import run_script
from warmprior.io.workers import end_with_parent


class AwkwardError(Exception):
    """One that cannot be pickled: its constructor takes other arguments than it keeps."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def train(folder, number):
    if number == 1:
        raise AwkwardError(1, 2)
    if number == 2:
        sys.exit(3)
    if number == 3:
        os._exit(9)  # dies every time
    if number == 4 and (folder / "dies").exists():
        (folder / "dies").unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / f"policy{number}").write_text(str(number * number))


def play(folder, number, episode):
    return int((folder / f"policy{number}").read_text()) + episode


@pytest.mark.parametrize("engine", ["local", pytest.param("ray", marks=pytest.mark.slow)])
@apart  # no fork survives a connection to Ray
def test_failures_cost_themselves_alone(engine, tmp_path, monkeypatch, capsys, forked_workers):
    if engine == "ray":
        pytest.importorskip("ray")
    monkeypatch.setattr(jobs, "DEATHS", 2)
    (tmp_path / "dies").touch()  # the first worker of job 4 is killed while it trains
    for name in ("out", "policies"):
        (tmp_path / name).mkdir()
    found = {}
    with Jobs(Run(out=tmp_path / "out", workers=1, engine=engine)) as pool:
        for n in range(5):
            group = f"policy {n}"
            trained = pool.submit(f"train {n}", train, tmp_path, n, group=group, training=True)
            for e in range(2):
                keep = functools.partial(found.__setitem__, (n, e))
                pool.submit(f"play {n} {e}", play, tmp_path, n, e, after=trained, group=group, then=keep)
        failures = pool.wait()
    assert found == {(n, e): n * n + e for n in (0, 4) for e in range(2)}
    assert sorted(failures) == ["policy 1", "policy 2", "policy 3"]
    assert "1 and 2" in failures["policy 1"] and "SystemExit(3)" in failures["policy 2"]
    assert "died" in failures["policy 3"] and "train 3" in failures["policy 3"]
    assert capsys.readouterr().out.count("FAILED") == 3


class Slots:
    """An engine of two slots whose jobs end at once; it notes the order of starts."""

    workers, killed = 2, None

    def __init__(self):
        self.jobs = []

    def takes(self, job):
        return sum(not running.done for running in self.jobs) < self.workers

    def submit(self, job):
        self.jobs.append(job)
        future = Future()
        future.set_result((None, None))
        return future

    def close(self, kill):
        self.killed = kill


def test_the_last_trainings_start_before_episodes_and_an_error_kills_the_workers(monkeypatch):
    engine = Slots()
    monkeypatch.setattr(jobs, "Local", lambda *_: engine)
    with Jobs(Run()) as pool:
        for n in range(5):
            trained = pool.submit(f"train {n}", train, training=True)
            pool.submit(f"play {n}", play, after=trained)
        assert pool.wait() == {}
    assert engine.killed is False and len(engine.jobs) == 10
    place = {job.name: i for i, job in enumerate(engine.jobs)}
    assert all(place[f"train {n}"] < place[f"play {n}"] for n in range(5))
    # A policy is played before the next is trained, but the last two trainings wait for no episode.
    assert place["play 0"] < place["train 2"] and place["train 4"] < place["play 2"]
    with raises(OSError, "disk full"), Jobs(Run()) as pool:
        pool.submit("write", train, then=lambda result: (_ for _ in ()).throw(OSError("disk full")))
        pool.wait()
    assert engine.killed is True


def sleeping():
    with Jobs(Run(workers=1)) as pool:
        for i in range(2):
            pool.submit(f"sleep {i}", time.sleep, 60)
        print("ready", flush=True)
        pool.wait()


def drive(out, err):
    """Run a script of which the workers sleep, in a session of its own as after a terminal's shell."""
    os.setsid()
    for ours, theirs in ((out, 1), (err, 2)):
        os.dup2(ours.fileno(), theirs)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    # A shell may have the signal ignored for what it starts in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(run_script(sleeping, "sleep.py"))


def is_a_worker_that_hears_no_ctrl_c(process):
    if "loky.backend.popen_loky_posix" not in process.cmdline():
        return False  # a resource tracker
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.search(r"^SigIgn:\s+(\w+)", status, re.M)[1], 16) >> (signal.SIGINT - 1) & 1


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_driver(how, monkeypatch):
    """The driver is forked, and its worker is a fresh process of one thread."""
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    fork = multiprocessing.get_context("fork")
    (said, out), (errors, err) = (fork.Pipe(duplex=False) for _ in range(2))
    process = fork.Process(target=drive, args=(out, err))
    process.start()
    out.close(), err.close()
    said, errors = (os.fdopen(os.dup(pipe.fileno())) for pipe in (said, errors))
    assert said.readline() == "ready\n"
    driver, deadline = psutil.Process(process.pid), time.monotonic() + 60
    while not any(map(is_a_worker_that_hears_no_ctrl_c, children := driver.children(recursive=True))):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    # What the tracker of killed workers finds gone is not said last.
    (tracker,) = (child for child in children if "loky.backend.resource_tracker" in " ".join(child.cmdline()))
    warned = "import warnings; warnings.warn('resource_tracker: /loky-1: FileNotFoundError(2)')"
    quiet = subprocess.run([sys.executable, "-c", warned], env=tracker.environ(), capture_output=True)
    assert not quiet.stderr
    workers = filter(is_a_worker_that_hears_no_ctrl_c, children)
    assert {worker.environ()["OMP_NUM_THREADS"] for worker in workers} == {"1"}
    # As Ctrl-C on a terminal does: all of them get it.
    os.killpg(process.pid, how) if how == signal.SIGINT else os.kill(process.pid, how)
    process.join(30)
    assert not psutil.wait_procs(children, timeout=15)[1]
    if how == signal.SIGINT:
        assert process.exitcode == 130
        lines = errors.read()
        assert lines.splitlines()[-1] == "sleep.py: interrupted" and "Traceback" not in lines


def test_without_a_terminal_trainings_say_now_and_then_how_far_they_are(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(jobs, "LINES_EVERY", -1)
    status = tmp_path / "status.json"
    running = [jobs.Job("train square", play, (), status=status), jobs.Job("play square", play, ())]
    with Jobs(Run(workers=1)) as started, jobs.tqdm(disable=True) as bar:
        started._show(bar, running)
        for text in ('{"iteration": 1, "iter', "3", '{"iteration": 1}', '{"iteration": 1, "iterations": 0}'):
            status.write_text(text)
            started._show(bar, running)
        status.write_text('{"iteration": 1500, "iterations": 3000}')
        started._show(bar, running)
    assert capsys.readouterr().out == "train square: 1,500 of 3,000 iterations\n"


def test_what_waits_for_a_failed_job_is_left_out_whatever_its_group(monkeypatch, capsys):
    monkeypatch.setattr(jobs, "Local", Inline)
    with Jobs(Run()) as run:
        trained = run.submit("train a policy", fail, group="a policy")
        run.submit("film", print, "filmed", after=trained)
        run.submit("another", print, "played")
        assert run.wait() == {"a policy": "train: no such loss"}
    assert "played" in (said := capsys.readouterr().out) and "filmed" not in said


def fail():
    raise ValueError("no such loss")


def resumed(out, argv):
    """Run a command line on what an earlier call left, with a log."""
    end_with_parent(os.getppid())
    resume = ["--resume"] if (out / "options.json").exists() else []
    with (out.parent / "log.txt").open("a", buffering=1) as log:
        os.dup2(log.fileno(), 1), os.dup2(log.fileno(), 2)
        sys.stdout = sys.stderr = log
        sys.exit(robomimic.main([*argv, *resume]))


def results(out):
    rows = [row | {"training_seconds": None} for row in stored(out)]
    files = sorted(out.parent.glob("policies/*/policy_*/model.safetensors"))
    return rows, {str(path.relative_to(out.parent)): path.read_bytes() for path in files}


KILLS = int(os.environ.get("KILLS", "20"))
"""A run is killed this often; set more in a search for rare moments."""

LIMIT = 900
"""Seconds after which an undisturbed run hangs."""


@pytest.mark.slow
def test_a_run_that_is_killed_at_random_moments_resumes_to_the_same_result(
    dataset, tmp_path, monkeypatch, forked_workers
):
    """SIGKILL for a driver and its worker, while they start, train, save, measure, play and write."""
    monkeypatch.setattr(pictures, "rendering_backend", lambda: None)
    for module in ("lab.running.comparison", "lab.running.policies", "lab.reporting.report", "robosuite"):
        importlib.import_module(module)  # what is imported here costs the forks no time
    few = {"iterations": 600, "save_every": 20, "checkpoints": 2, "episodes": 2, "prior": "past"}
    rng, kills, runs, duration, expected = np.random.default_rng(0), 0, 0, np.inf, None
    assert KILLS > 0
    while kills < KILLS:
        out, code, runs = tmp_path / str(runs) / "out", None, runs + 1
        most = 0 if expected is None else min(KILLS, kills + 10)  # the first run is undisturbed
        out.parent.mkdir()
        while code is None:
            begun, is_fresh = time.monotonic(), not out.exists()
            argv = [*options(dataset, out, **few), "--no-videos"]
            process = multiprocessing.get_context("fork").Process(target=resumed, args=(out, argv))
            process.start()
            os.setpgid(process.pid, process.pid)
            process.join(LIMIT if kills == most else rng.uniform(0, 0.9) * duration)
            if (code := process.exitcode) is None:
                assert kills < most, f"it hangs:\n{(out.parent / 'log.txt').read_text()}"
                os.killpg(process.pid, signal.SIGKILL)
                process.join()
                kills += 1
        log = (out.parent / "log.txt").read_text()
        assert code == 0, f"after {kills} kills:\n{log}"
        if is_fresh:  # other work may have slowed the first run
            duration = min(duration, time.monotonic() - begun)
        expected = expected or results(out)
        assert results(out) == expected, log
        assert [len(part) for part in expected] == [2, 2]
