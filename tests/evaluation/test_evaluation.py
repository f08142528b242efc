"""Evaluation: every episode once, whatever the environment, and no hang when a worker dies."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl._utils import _check_for_faulty_process
from torchrl.data import Categorical
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    FrameSkipTransform,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from tests.envs.test_gymnasium import Dial, registered_dial
from tests.errors import raises, refuses
from tests.processes import apart, ended
from tests.toy_env import ACTION_DIM, CountingEnv, closing, mlp_actor
from warmprior import (
    GaussianPrior,
    Normalizer,
    PastPrior,
    PriorAnchor,
    PriorDecoder,
    ResidualSampler,
    WarmPriorActor,
    normalizing_transforms,
    policy_transforms,
)
from warmprior.data import demonstrations_of
from warmprior.envs import gym_env
from warmprior.envs.description import environment_of, environment_parts, registered_description
from warmprior.evaluation import Episode, evaluate, parallel_env, play_episode
from warmprior.evaluation.parallel import watched
from warmprior.io.workers import WorkerError
from warmprior.tasks import Play, Task

H = 3


class SeededEnv(CountingEnv):
    """Episode length, start and success follow from the seed as in a simulator.

    Episode of seed ``s`` lasts ``3 + s % 5`` steps and is solved if ``s`` is divisible by 3. With
    ``log`` every reset appends its seed to a file.
    """

    def __init__(self, log=None, sleep=0.0):
        super().__init__()
        self.log, self.sleep = log, sleep
        self.base, self.count, self.seed_ = 0, 0, 0
        self.observation_spec["success"] = Categorical(2, dtype=torch.bool, shape=(1,))

    def _set_seed(self, seed):
        self.base, self.count = seed, 0

    def _reset(self, tensordict=None, **kwargs):
        self.seed_ = self.base + self.count
        self.count += 1
        self.length = length_of(self.seed_)
        self.episode = self.seed_ - 1  # CountingEnv shows it in its observation
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(f"{self.seed_}\n")
        return super()._reset(tensordict)

    def _seen(self, out):
        return out.set("success", out["done"] & (self.seed_ % 3 == 0))

    def _step(self, tensordict):
        time.sleep(self.sleep)
        return super()._step(tensordict)


def length_of(seed):
    return 3 + seed % 5


def expected(first_seed, episodes):
    seeds = range(first_seed, first_seed + episodes)
    nothing = TensorDict({}, [0])  # decisions take no part in comparisons
    return [Episode(seed, seed % 3 == 0, length_of(seed), nothing) for seed in seeds]


class Recorder(nn.Module):
    """A velocity that depends on the observation, and remembers which episodes it saw."""

    def __init__(self):
        super().__init__()
        self.weight, self.seen = nn.Parameter(torch.tensor(0.1)), set()

    def forward(self, t, a, observation):
        self.seen.update(observation[:, -1, 1].int().tolist())
        return self.weight * observation.mean((1, 2))[:, None, None] - a


PRIOR = PastPrior(H)


def environments(num_envs, **options):
    return parallel_env(partial(SeededEnv, **options), partial(policy_transforms, PRIOR), num_envs)


def actor_for(prior=PRIOR):
    return WarmPriorActor(Recorder(), prior, nfe=2)


class NoiseSuccess(SeededEnv):
    """Success depends on what the policy does, and so on its random numbers."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        return out.set("success", tensordict["action"].sum(-1, keepdim=True) > 0)


class PlainEnv(SeededEnv):
    """As most of TorchRL's environments: resets are numbered from the seed, and workers unknown."""

    def __init__(self, log=None):
        super().__init__(log=log)


def single(make_env=PlainEnv, prior=PRIOR):
    return TransformedEnv(make_env(), policy_transforms(prior))


def chunks_of(episodes):
    return torch.cat([episode.decisions["vla_action", "chunk"] for episode in episodes])


def test_an_episode_depends_on_its_seeds_alone():
    """Not on the environment's history, the policy's generators, or the order of the episodes."""
    env, actor = single(NoiseSuccess), actor_for()
    torch.manual_seed(0)
    whole = evaluate(actor, env, episodes=9, first_seed=3, policy_seed=2)
    torch.rand(5)
    again = [
        play_episode(actor, env if seed % 2 else single(NoiseSuccess), seed, policy_seed=2)
        for seed in range(11, 2, -1)
    ]
    assert again[::-1] == whole
    assert torch.equal(chunks_of(again[::-1]), chunks_of(whole))


def test_the_noise_of_an_episode_is_that_of_the_documented_seed():
    actor = actor_for(GaussianPrior(H))
    actor.forward = lambda data, generator: data.set(
        ("vla_action", "chunk"), actor.sampler(data, generator)["prior", "noise"]
    )
    first = {}
    for seeds in ((0, 7), (7, 0), (1, 7), (0, 8), (2**32, 7)):
        noise_seed = int(np.random.SeedSequence(seeds).generate_state(1, "uint64")[0])
        generator = torch.Generator().manual_seed(noise_seed)
        policy_seed, seed = seeds
        env = single(prior=GaussianPrior(H))
        episode = play_episode(actor, env, seed, policy_seed=policy_seed)
        for chunk in episode.decisions["vla_action", "chunk"]:
            assert torch.equal(chunk, torch.randn(H, ACTION_DIM, generator=generator))
        first[seeds] = tuple(episode.decisions["vla_action", "chunk"][0].flatten().tolist())
    assert len(set(first.values())) == len(first)


class Blurred(CountingEnv):
    """Draws what it shows from PyTorch's global generator."""

    def __init__(self):
        super().__init__(5)
        self.observation_spec["success"] = Categorical(2, dtype=torch.bool, shape=(1,))

    def _seen(self, out):
        seen = out["observation"] + torch.randn(2 + ACTION_DIM)
        return out.update({"observation": seen, "success": out["done"]})


def test_a_compiled_policy_plays_the_same_episodes():
    policy, chunks = mlp_actor(PRIOR, nfe=2), []
    for each in (policy, torch.compile(policy, backend="eager")):
        env = TransformedEnv(SerialEnv(2, Blurred), policy_transforms(PRIOR))
        chunks.append(chunks_of(evaluate(each, env, episodes=3, first_seed=0)))
    torch.testing.assert_close(*chunks)


def test_actor_is_left_as_it_was_but_for_its_mode():
    generator = torch.Generator().manual_seed(5)
    actor = WarmPriorActor(Recorder(), PastPrior(H), nfe=2, generator=generator).train()
    state, before = generator.get_state(), torch.get_rng_state()
    with closing(environments(1)) as env:
        evaluate(actor, env, episodes=1, first_seed=0)
    assert actor.sampler.generator is generator
    assert torch.equal(generator.get_state(), state)
    assert torch.equal(torch.get_rng_state(), before)
    assert not actor.training and actor.sampling.nfe == 2


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


def test_any_policy_that_writes_chunks():
    """An agent, or residuals alone: seeded, and without a trace in PyTorch's global generator."""
    prior = PastPrior(H)
    actor = actor_for(prior)
    decoder = PriorDecoder(actor, delta=0.5)
    policy = TensorDictSequential(ResidualSampler(decoder), decoder)
    transforms = partial(policy_transforms, prior)
    env = TransformedEnv(parallel_env(NoiseSuccess, transforms, 2), PriorAnchor(actor))
    play = partial(evaluate, policy, env, episodes=6, first_seed=3)
    with closing(env):
        torch.manual_seed(0)
        before = torch.get_rng_state()
        one = play()
        evaluate(actor, env, episodes=2, first_seed=3)  # the environment draws alone
        assert torch.equal(torch.get_rng_state(), before)
        torch.rand(5)
        again, other = play(), play(policy_seed=1)
    assert again == one and torch.equal(chunks_of(again), chunks_of(one))
    assert not torch.isclose(chunks_of(other)[:3], chunks_of(one)[:3]).any()


def batched(kind, make_env, num_envs, transforms_inside=False):
    options = {"mp_start_method": "fork"} if kind is ParallelEnv else {}
    if transforms_inside:
        return kind(num_envs, partial(single, make_env), **options)
    return TransformedEnv(kind(num_envs, make_env, **options), policy_transforms(PRIOR))


PLACES = {
    "one worker": lambda log: environments(1, log=log),
    "workers": lambda log: environments(3, log=log),
    "single": lambda log: single(partial(PlainEnv, log=log)),
    "transforms outside": lambda log: batched(SerialEnv, partial(PlainEnv, log=log), 3),
    "transforms inside": lambda log: batched(ParallelEnv, partial(PlainEnv, log=log), 3, True),
}


@pytest.mark.parametrize("place", PLACES)
def test_every_episode_once(place, tmp_path):
    log, actor = tmp_path / "resets", actor_for()
    with closing(PLACES[place](log)) as env:
        for first, episodes in ((40, 7), (5, 2), (60, 3), (80, 1)):
            before = len(log.read_text().split()) if log.exists() else 0
            result = evaluate(actor, env, episodes=episodes, first_seed=first)
            assert result == expected(first, episodes)
            seeds = range(first, first + episodes)
            played = [int(line) for line in log.read_text().split()][before:]
            assert set(seeds) <= actor.network.seen and set(seeds) <= set(played)
            assert place != "single" or played == list(seeds)


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


def test_environments_that_cannot_be_judged():
    refuses(lambda: evaluate(actor_for(), single(CountingEnv), episodes=1, first_seed=0), KeyError, "success")
    with raises(KeyError, "policy_transforms"):
        evaluate(actor_for(), PlainEnv(), episodes=1, first_seed=0)


def test_policy_and_environment_need_one_normaliser():
    ones = {"observation": torch.ones(2 + ACTION_DIM), "action": torch.ones(ACTION_DIM)}
    mine, other = (Normalizer({k: -s * v for k, v in ones.items()}, ones) for s in (1.0, 3.0))
    actor = mlp_actor(PRIOR, nfe=1, normalizer=mine)

    def play(normalizer):
        transforms = policy_transforms(PastPrior(H), normalizer=normalizer)
        env = TransformedEnv(SeededEnv(), transforms)
        return evaluate(actor, env, episodes=1, first_seed=0)

    assert play(mine)[0].steps == length_of(0)
    # Wherever the transforms are.
    transforms = [StepCounter(), policy_transforms(PastPrior(H), normalizer=mine)]
    for env in (
        TransformedEnv(SeededEnv(), Compose(*transforms)),
        TransformedEnv(TransformedEnv(SeededEnv(), transforms[1].clone()), StepCounter()),
        # The environment's own units, below, are its own.
        TransformedEnv(
            TransformedEnv(SeededEnv(), Compose(*normalizing_transforms(other))),
            transforms[1].clone(),
            auto_unwrap=False,
        ),
    ):
        assert evaluate(actor, env, episodes=1, first_seed=0)[0].steps == length_of(0)
    # Of observations alone.
    alone = Normalizer(*({"observation": s * ones["observation"]} for s in (-1.0, 3.0)))
    seen = TransformedEnv(
        SeededEnv(), Compose(*normalizing_transforms(alone), policy_transforms(PastPrior(H)))
    )
    assert evaluate(actor.replace(normalizer=alone), seen, episodes=1, first_seed=0)[0].steps == length_of(0)
    for wrong in (None, other):
        with raises(ValueError, "normalizer=policy.normalizer"):
            play(wrong)
    # An environment follows the policy.
    env = TransformedEnv(SeededEnv(), policy_transforms(actor))
    mine.load_state_dict(other.state_dict(), assign=True)
    assert evaluate(actor, env, episodes=1, first_seed=0)[0].steps == length_of(0)
    # A network's own normaliser is no policy's.
    plain = actor.replace(normalizer=None)
    plain.network.normalizer = mine
    env = TransformedEnv(SeededEnv(), policy_transforms(PRIOR))
    assert evaluate(plain, env, episodes=1, first_seed=0)[0].steps == length_of(0)


def test_workers_keep_the_statistics_that_they_started_with():
    ones = {"observation": torch.ones(2 + ACTION_DIM), "action": torch.ones(ACTION_DIM)}
    mine, other = (Normalizer({k: -s * v for k, v in ones.items()}, ones) for s in (1.0, 3.0))
    actor = mlp_actor(PRIOR, nfe=1, normalizer=mine)
    for normalizer in (mine, other):
        env = parallel_env(SeededEnv, partial(policy_transforms, PRIOR, normalizer=normalizer), 1)
        with closing(env):
            if normalizer is mine:
                assert len(evaluate(actor, env, episodes=2, first_seed=0)) == 2
                mine.load_state_dict(other.state_dict())
                with raises(ValueError, "normalizer=policy.normalizer", "close"):
                    evaluate(actor, env, episodes=2, first_seed=0)
                env.close()
            assert len(evaluate(actor, env, episodes=2, first_seed=0)) == 2
    outside = TransformedEnv(SerialEnv(1, SeededEnv), policy_transforms(PRIOR, normalizer=other))
    mine.action_scale.mul_(2)
    with raises(ValueError, "normalizer=policy.normalizer"):
        evaluate(actor, outside, episodes=2, first_seed=0)


@pytest.mark.parametrize("batch", [None, SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
@pytest.mark.parametrize(
    "outside", [FrameSkipTransform(2), ConditionalSkip(lambda data: data["executed_steps"] > 0)]
)
def test_what_repeats_or_skips_chunks_from_outside_is_refused(batch, outside):
    """Played, an episode of n steps would be one of n / 2, or never end."""

    def make():
        return TransformedEnv(SeededEnv(), policy_transforms(PRIOR))

    inside = make() if batch is None else batch(2, make)
    env = TransformedEnv(inside, Compose(StepCounter(), outside.clone()), auto_unwrap=False)
    with closing(env), raises(RuntimeError, type(outside).__name__, "inside"):
        evaluate(mlp_actor(PRIOR, nfe=1), env, episodes=2, first_seed=0)


def test_a_frame_skip_of_one_repeats_nothing_and_is_played():
    actor = mlp_actor(PRIOR, nfe=1)
    inside = SerialEnv(1, lambda: TransformedEnv(SeededEnv(), policy_transforms(PRIOR)))
    skipped = evaluate(actor, TransformedEnv(inside, FrameSkipTransform(1)), episodes=2, first_seed=0)
    assert skipped == evaluate(actor, inside, episodes=2, first_seed=0)


@pytest.mark.parametrize("given", [{"success": "solved"}, {"measures": {"reward": "sum"}}])
def test_a_task_has_its_own_success_and_measures(given):
    rows = TensorDict({"observation": torch.rand(9, 1), "action": torch.rand(9, ACTION_DIM)}, [9])
    task = Task(
        demonstrations_of(rows.set("episode", torch.zeros(9, dtype=torch.int64)), "own"),
        play=Play(CountingEnv),
    )
    with raises(ValueError, next(iter(given))):
        evaluate(mlp_actor(PastPrior(4)), task, episodes=1, first_seed=0, **given)
