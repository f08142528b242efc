"""Worker processes: errors arrive, nothing hangs, and nobody outlives the parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from operator import add
from pathlib import Path

import pytest
import torch

from tests.processes import ended
from warmprior.io import workers
from warmprior.io.workers import WorkerError, WorkerPool


def gather(pool, jobs):
    """The results by job."""
    results = {}
    jobs = list(jobs)
    while jobs or pool.running:
        while jobs and pool.idle:
            pool.submit(jobs.pop(0))
        results.update(pool.wait(60))
    return results


def process_facts(state):
    return os.getpid(), torch.get_num_threads(), state, torch.get_float32_matmul_precision()


def sleep_and_tell(seconds, state):
    time.sleep(seconds)
    return os.getpid()


def fail(error, state):
    raise error


def kill_oneself(state):
    os.kill(os.getpid(), signal.SIGKILL)


def tensors(state):
    return [torch.full((3,), float(i)) for i in range(2_000)]


def test_every_job_once_and_in_a_worker_with_one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with WorkerPool(2, "state") as pool:
            facts = gather(pool, [partial(process_facts) for _ in range(6)])
    finally:
        torch.set_num_threads(threads)
    assert len(facts) == 6
    pids = {pid for pid, *_ in facts.values()}
    assert os.getpid() not in pids and len(pids) <= 2
    assert {fact[1:3] for fact in facts.values()} == {(1, "state")}
    assert all(ended(pid) for pid in pids)


def test_spawned_workers_compute_as_the_parent_does(monkeypatch):
    """Beside CUDA workers cannot be forked: what they inherit then has to be handed over."""
    monkeypatch.setattr(workers, "start_method", lambda: "spawn")
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with WorkerPool(1, {"one": torch.ones(2)}) as pool:
            ((_, *facts),) = gather(pool, [process_facts]).values()
    finally:
        torch.set_float32_matmul_precision(precision)
    assert facts[0] == 1 and facts[2] == "high" and facts[1]["one"].tolist() == [1.0, 1.0]


def test_no_job_waits_while_a_worker_is_idle():
    with WorkerPool(2, None) as pool:
        gather(pool, [partial(sleep_and_tell, 0.0)])
        started = time.monotonic()
        long, *short = (partial(sleep_and_tell, t) for t in (1.5, 0.1, 0.1, 0.1, 0.1))
        pids = gather(pool, [long, *short])
    assert {pids[job] for job in short}.isdisjoint({pids[long]})
    assert time.monotonic() - started < 15


def test_many_tensors_need_no_open_files():
    limit = len(os.listdir("/proc/self/fd"))
    with WorkerPool(1, None) as pool:
        (result,) = gather(pool, [tensors]).values()
        assert len(os.listdir("/proc/self/fd")) < limit + 100
    assert result[7].tolist() == [7.0] * 3


def test_an_error_of_a_job_arrives_as_itself_and_ends_the_others():
    started = time.monotonic()
    nan = partial(fail, FloatingPointError("the loss became nan"))
    with (
        pytest.raises(FloatingPointError, match="the loss became nan"),
        WorkerPool(2, None) as pool,
    ):
        pool.submit(partial(sleep_and_tell, 300))
        processes = [process.pid for process in multiprocessing.active_children()]
        gather(pool, [nan])
    assert len(processes) == 2 and all(ended(pid) for pid in processes)
    assert time.monotonic() - started < 60


def test_an_error_does_not_lose_what_others_have_finished():
    with pytest.raises(FloatingPointError), WorkerPool(2, None) as pool:
        pool.submit(partial(fail, FloatingPointError("the loss became nan")))
        pool.submit(partial(sleep_and_tell, 0.0))
        time.sleep(2.0)  # both have ended when the parent looks
        ((_, pid),) = pool.wait(60)
        assert pid in [process.pid for process in multiprocessing.active_children()]
        pool.wait(60)


def test_an_error_of_the_parent_ends_its_workers():
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), WorkerPool(2, None) as pool:
        for _ in range(2):
            pool.submit(partial(sleep_and_tell, 300))
        processes = sorted(p.pid for p in multiprocessing.active_children())
        assert pool.wait(0.2) == []
        raise KeyboardInterrupt
    assert all(ended(pid) for pid in processes)
    assert time.monotonic() - started < 60


@pytest.mark.parametrize("job", [kill_oneself, partial(sleep_and_tell, 300)])
def test_a_killed_worker_is_an_error_and_not_a_hang(job):
    started = time.monotonic()
    told = r"of 2 \(exit code -9\) died.*memory.*--envs"
    with pytest.raises(WorkerError, match=told) as raised, WorkerPool(2, None) as pool:
        pool.submit(job)
        processes = sorted(p.pid for p in multiprocessing.active_children())
        if job is not kill_oneself:
            time.sleep(0.5)
            os.kill(processes[1], signal.SIGKILL)  # busy or idle
        pool.submit(partial(sleep_and_tell, 300))
        while pool.running:
            pool.wait()
    assert "worker 1 of 2" in str(raised.value) or job is kill_oneself
    assert all(ended(pid) for pid in processes)
    assert time.monotonic() - started < 60


def hold_workers(pipe):
    with WorkerPool(2, None) as pool:
        pool.submit(partial(sleep_and_tell, 300))
        pipe.send(sorted(p.pid for p in multiprocessing.active_children()))
        pool.wait()


def test_workers_end_with_a_killed_parent():
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    parent = context.Process(target=hold_workers, args=(theirs,))
    parent.start()
    assert ours.poll(60)
    pids = ours.recv()
    time.sleep(1.0)
    assert len(pids) == 2 and not any(ended(pid) for pid in pids)
    os.kill(parent.pid, signal.SIGKILL)
    parent.join()
    deadline = time.monotonic() + 20
    while not all(ended(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    survivors = [pid for pid in pids if not ended(pid)]
    for pid in survivors:
        os.kill(pid, signal.SIGKILL)
    assert not survivors


INTERRUPTED = """
import multiprocessing
from functools import partial
from tests.io.test_workers import sleep_and_tell
from warmprior.io.workers import WorkerPool
with WorkerPool(2, None) as pool:
    for _ in range(2):
        pool.submit(partial(sleep_and_tell, 300))
    print(*(process.pid for process in multiprocessing.active_children()), flush=True)
    pool.wait()
"""


def test_ctrl_c_ends_all_at_once_without_a_word_from_the_workers():
    """A terminal sends SIGINT to the parent and to its workers."""
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED],
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    pids = [int(word) for word in process.stdout.readline().split()]
    time.sleep(1.0)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert len(pids) == 2 and all(ended(pid) for pid in pids)
    assert errors.count("KeyboardInterrupt") == 1 and "Process" not in errors


@pytest.mark.parametrize("number", [0, -1])
def test_bad_number_of_workers(number):
    with pytest.raises(ValueError, match="number of workers must be at least 1"):
        WorkerPool(number, None)


def test_the_state_of_a_worker_is_its_own():
    state = []
    with WorkerPool(1, state) as pool:
        assert list(gather(pool, [partial(add, [1])]).values()) == [[1]]
    assert state == []


FAKED = """
import torch
from functools import partial
from warmprior.io.workers import WorkerPool, count_devices
from torch._subclasses.fake_tensor import FakeTensorMode

def gradient(state, factor):
    weight = torch.ones((), requires_grad=True)
    (factor * weight).backward()
    return weight.grad.item()

count_devices()  # as a training does that compiles
with FakeTensorMode():
    torch.ones(2)
gradient(None, 1.0)
with WorkerPool(1, None) as pool:
    pool.submit(partial(gradient, factor=3.0))
    print(pool.wait()[0][1])
"""


def test_workers_compute_gradients_after_something_was_compiled():
    # In a process of its own: autograd counts devices once.
    done = subprocess.run([sys.executable, "-c", FAKED], capture_output=True, text=True)
    assert done.stdout == "3.0\n", done.stderr
