import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from functools import partial

import pytest

pytest.importorskip("loky")

from lab.io.workers import working
from tests.errors import raises
from tests.processes import apart, ended
from warmprior.io.workers import WorkerError


def number(state):
    return os.getpid()


def remember(number, state):
    state.append(number)
    return os.getpid(), list(state)


def sleep(path, state):
    path.with_name(str(os.getpid())).touch()
    time.sleep(600)


def fail(state):
    raise FloatingPointError("the loss became nan")


def kill_oneself(state):
    os.kill(os.getpid(), signal.SIGKILL)


def wait_for(happened, seconds=60):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def sleepers(folder, count):
    """The processes that sleep there, once they do."""
    wait_for(lambda: len(list(folder.iterdir())) == count)
    return [int(path.name) for path in folder.iterdir()]


@apart
def test_every_process_has_a_state_of_its_own_and_an_error_ends_all(tmp_path, forked_workers):
    state = []
    with raises(FloatingPointError, "the loss became nan"), working(2, state) as call:
        found = [call(partial(remember, i)).result() for i in range(6)]
        pid = call(number).result()
        call(partial(sleep, tmp_path / "x"))
        pids = sleepers(tmp_path, 1)
        call(fail).result()
    assert state == [] and os.getpid() != pid
    for process in {pid for pid, _ in found}:
        seen = [numbers for pid, numbers in found if pid == process]
        assert all(numbers == seen[-1][: len(numbers)] for numbers in seen)
    assert sorted(numbers[-1] for _, numbers in found) == list(range(6))
    wait_for(lambda: all(map(ended, [pid, *pids])), 20)


@apart
def test_a_dead_process_ends_all_others(tmp_path, forked_workers):
    with raises(WorkerError, 2, "memory") as raised, working(2, None) as call:
        call(partial(sleep, tmp_path / "x"))
        pids = sleepers(tmp_path, 1)
        call(kill_oneself).result()
    assert isinstance(raised.value.__cause__, BrokenProcessPool)
    wait_for(lambda: all(map(ended, pids)), 20)


FAKED = """
import multiprocessing
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from warmprior.io.workers import count_devices, start_method

def gradient(pipe, factor):
    weight = torch.ones((), requires_grad=True)
    (factor * weight).backward()
    pipe.send(weight.grad.item())

count_devices()  # as a training does that compiles
with FakeTensorMode():
    torch.ones(2)
ours, theirs = multiprocessing.Pipe()
gradient(theirs, 1.0)
process = multiprocessing.get_context(start_method()).Process(target=gradient, args=(theirs, 3.0))
process.start()
print(ours.recv(), ours.recv() if ours.poll(60) else None)
"""


@pytest.mark.slow
def test_forked_workers_compute_gradients_after_something_was_compiled():
    # In a process of its own: autograd counts devices once.
    done = subprocess.run([sys.executable, "-c", FAKED], capture_output=True, text=True)
    assert done.stdout == "1.0 3.0\n", done.stderr
