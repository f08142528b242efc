"""Environments in worker processes: every episode once, and an end of all whoever dies or is interrupted."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from torchrl._utils import _check_for_faulty_process
from torchrl.envs import (
    SerialEnv,
)

from tests.envs.test_gymnasium import Dial, registered_dial
from tests.errors import raises
from tests.evaluation.seeded import PRIOR, H, SeededEnv, actor_for, environments, expected
from tests.processes import apart, ended
from tests.toy_env import closing, mlp_actor
from warmprior import (
    GaussianPrior,
    PastPrior,
    policy_transforms,
)
from warmprior.envs import gym_env
from warmprior.envs.description import environment_of, environment_parts, registered_description
from warmprior.evaluation import evaluate, parallel_env
from warmprior.evaluation.parallel import watched
from warmprior.io.workers import WorkerError


@pytest.mark.parametrize("moment", ["before", "during"])
def test_a_killed_worker_is_an_error_and_not_a_hang(moment):
    """TorchRL alone would wait for hours; the watcher looks twice a second."""
    env = environments(2, sleep=0.02)
    result = []

    def kill():
        os.kill(env._workers[1].pid, signal.SIGKILL)

    def run():
        try:
            evaluate(actor_for(), env, episodes=500, first_seed=0)
        except BaseException as error:
            result.append(error)

    evaluate(actor_for(), env, episodes=2, first_seed=0)  # start the workers
    pids = [worker.pid for worker in env._workers]
    if moment == "before":
        kill()
    thread = threading.Thread(target=run, daemon=True)
    started = time.monotonic()
    thread.start()
    if moment == "during":
        time.sleep(0.5)
        kill()
    thread.join(30)
    assert not thread.is_alive(), "evaluation hangs after its worker was killed"
    assert time.monotonic() - started < 20
    (error,) = result
    assert isinstance(error, RuntimeError)
    assert "worker 1 of 2 (exit code -9)" in str(error) and "memory" in str(error)
    time.sleep(0.5)
    assert all(ended(pid) for pid in pids), "a worker still runs"


@pytest.mark.parametrize("closed", [False, True])
def test_a_worker_that_torchrl_finds_dead_first_is_named(closed):
    """It then terminates the others and closes them, and they may be looked at in between."""
    env = environments(2, sleep=0.02)
    env.reset()
    workers = env._workers
    with raises(WorkerError, "worker 1 of 2", "exit code -9"), watched(env):
        os.kill(workers[1].pid, signal.SIGKILL)
        workers[1].join()
        if closed:
            _check_for_faulty_process(workers)
        workers[0].terminate()
        workers[0].join()
        raise ConnectionError


def test_a_spawned_worker_knows_what_this_process_registered(monkeypatch):
    monkeypatch.setattr("warmprior.io.workers._forks", False)
    dial = registered_dial(monkeypatch)
    described = registered_description({**dial, "kwargs": {}, "observation_keys": []})
    actor = mlp_actor(GaussianPrior(2), 1, 2, 1, environment=described)
    workers = parallel_env(*environment_parts(actor), num_envs=1)
    envs = workers, SerialEnv(1, [partial(environment_of, actor)])
    found, expected = (evaluate(actor, env, episodes=5, first_seed=0) for env in envs)
    workers.close()
    outcomes = [(episode.steps, episode.success) for episode in expected]
    assert [(episode.steps, episode.success) for episode in found] == outcomes
    assert {success for _, success in outcomes} == {False, True}


def here_alone(pid):
    if os.getpid() != pid:
        raise LookupError("another process")
    return SeededEnv()


def test_a_worker_that_cannot_build_its_environment_is_no_bare_end_of_file():
    env = parallel_env(partial(here_alone, os.getpid()), partial(policy_transforms, PastPrior(H)), 1)
    env.configure_parallel(shutdown_timeout=0.5)  # TorchRL waits for it
    with raises(WorkerError, "environment", "spawned"):
        env.reset()


def hold_environments(pipe):
    """Start workers, and another child that inherits the parent's ends of their pipes; wait."""
    env = environments(3, sleep=0.01)
    env.reset()
    other = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    other.start()
    pipe.send([*(worker.pid for worker in env._workers), other.pid])
    time.sleep(60)


def test_workers_end_with_a_killed_parent():
    """Their pipes stay open where the parent had other children: they would wait on them for hours."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    parent = context.Process(target=hold_environments, args=(theirs,))
    parent.start()
    assert ours.poll(60)
    *pids, other = ours.recv()
    assert len(pids) == 3 and not any(ended(pid) for pid in pids)
    time.sleep(0.6)  # they look five times a second
    assert not any(ended(pid) for pid in pids)  # nobody has died so far
    os.kill(parent.pid, signal.SIGKILL)
    parent.join()
    deadline = time.monotonic() + 20
    while not all(ended(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    survivors = [pid for pid in pids if not ended(pid)]
    for pid in [*survivors, other]:
        os.kill(pid, signal.SIGKILL)
    assert not survivors


def started_dial():
    """A Gymnasium environment, of which only the first episode after a seed follows from it."""
    return gym_env(Dial(), success="solved")


def test_workers_number_the_episodes_of_any_environment():
    alone = started_dial()
    expected = []
    for seed in range(40, 46):
        alone.set_seed(seed)
        expected.append(alone.reset()["observation"][0].item())
    with closing(
        parallel_env(started_dial, partial(policy_transforms, PRIOR, observation_steps=1), 2)
    ) as env:
        unseeded = torch.stack([env.reset()["observation"][:, 0, 0] for _ in range(3)])
        env.set_seed(40, static_seed=True)
        seeded = torch.stack([env.reset()["observation"][:, 0, 0] for _ in range(3)])
    assert seeded.flatten().tolist() == expected
    assert len({*unseeded.flatten().tolist()}) == 6


class FailingEnv(SeededEnv):
    def _step(self, tensordict):
        raise LookupError("the simulator has lost the robot")


def test_a_worker_with_an_error_of_its_own_was_not_out_of_memory():
    env = parallel_env(FailingEnv, partial(policy_transforms, PRIOR), 2)
    env.configure_parallel(shutdown_timeout=0.5)
    with raises(WorkerError, "worker", "exit code 1", "error of its own") as caught:
        evaluate(actor_for(), env, episodes=2, first_seed=0)
    assert "memory" not in str(caught.value)


ROLLOUT = """
import signal
from functools import partial
from warmprior import PastPrior, policy_transforms
from warmprior.envs import NavigationEnv
from warmprior.evaluation import parallel_env
env = parallel_env(NavigationEnv, partial(policy_transforms, PastPrior(8), observation_steps=1), 2)
env.reset()
# A shell starts what runs in the background without it, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
print("started", flush=True)
END
"""


@pytest.mark.parametrize("end", ["while True: env.rollout(2)", "raise LookupError"])
def test_a_program_with_workers_ends(end):
    """Ctrl-C reaches all processes of a terminal; an error of the program's own leaves workers open."""
    program = [sys.executable, "-W", "ignore", "-c", ROLLOUT.replace("END", end)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(program, cwd=Path(__file__).parents[2], **pipes) as process:
        assert process.stdout.readline() == "started\n"
        if "rollout" in end:
            time.sleep(0.5)
            os.killpg(process.pid, signal.SIGINT)
        try:
            _, said = process.communicate(timeout=20)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert said.rstrip().endswith("KeyboardInterrupt" if "rollout" in end else "LookupError")


@apart
def test_the_caller_of_workers_still_hears_an_interrupt():
    """TorchRL builds an environment in the caller too, which may be another process's child."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    env = environments(1)
    env.reset()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    env.close()


def test_an_interrupt_reaches_the_caller_and_no_worker():
    env = environments(2)
    env.reset()
    workers = env._workers
    for worker in workers:
        os.kill(worker.pid, signal.SIGINT)  # as a terminal does
    assert evaluate(actor_for(), env, episodes=3, first_seed=0) == expected(0, 3)
    with pytest.raises(KeyboardInterrupt), watched(env):
        os.kill(workers[1].pid, signal.SIGKILL)
        workers[1].join()
        raise KeyboardInterrupt
