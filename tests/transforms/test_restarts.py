"""Simulators that restart rows inside a step: every decision ends where its episode does."""

import pytest
import torch

pytest.importorskip("gymnasium")

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    AutoResetEnv,
    AutoResetTransform,
    EnvBase,
    GymEnv,
    GymWrapper,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from tests.errors import raises, refuses
from tests.toy_env import ends_of
from warmprior import PastPrior, keys, policy_transforms
from warmprior.history import ENTRIES

H, LENGTHS = 4, (6, 4, 3)
PRIOR = PastPrior(H)


class Rows(EnvBase):
    """Batched episodes of :data:`LENGTHS` steps; the observation is step and length, the reward the step.

    Args:
        restarts: whether the step that ends an episode begins the next one, and shows that.
        resets: whether single rows can be reset.
    """

    def __init__(self, lengths=LENGTHS, restarts=False, resets=True):
        n = len(lengths)
        super().__init__(batch_size=[n])
        self.lengths, self.restarts, self.resets = torch.tensor(lengths)[:, None], restarts, resets
        self.observation_spec = Composite(observation=Unbounded((n, 2)), shape=[n])
        self.action_spec = Bounded(-1, 1, (n, 2))
        self.reward_spec = Unbounded((n, 1))
        self.done_spec = ends_of(n)
        self.t = torch.zeros(n, 1)

    def _set_seed(self, seed):
        """Nothing is random."""

    def _seen(self):
        return torch.cat([self.t, self.lengths], -1)

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones_like(self.t, dtype=torch.bool)
        elif not self.resets:
            raise RuntimeError("no partial resets")
        self.t = torch.where(mask, 0, self.t)
        return TensorDict({"observation": self._seen()}, self.batch_size).update(self.done_spec.zero())

    def _step(self, tensordict):
        self.t = self.t + 1
        done, reward = self.t >= self.lengths, self.t.clone()
        if self.restarts:
            self.t = torch.where(done, 0, self.t)
        flags = {"done": done, "terminated": done, "truncated": torch.zeros_like(done)}
        return TensorDict({"observation": self._seen(), "reward": reward, **flags}, self.batch_size)


def native(lengths=LENGTHS, resets=True):
    env = Rows(lengths, restarts=True, resets=resets)
    env._torchrl_native_autoreset = True
    return env


def chosen(tensordict):
    """Chunks that tell row, step and position."""
    seen = tensordict["observation"][..., -1:, :]
    chunk = torch.arange(H)[:, None] / 10 + seen
    return tensordict.set(keys.CHUNK, chunk)


def played(env, decisions=7):
    return env.rollout(decisions, chosen, break_when_any_done=False)


def reference(lengths, execute, decisions=7):
    """The decisions of each row by themselves: TorchRL's own way, one environment after the other."""
    alone = [TransformedEnv(Rows((n,)), policy_transforms(PRIOR, execute=execute)) for n in lengths]
    return torch.cat([played(env, decisions) for env in alone])


def check_equal(found, expected, seen_at_ends=False):
    kept = [keys.EXECUTED, *((keys.HISTORY, name) for name in ENTRIES)]
    for key in [*kept, "observation", *(("next", key) for key in ("reward", "done"))]:
        torch.testing.assert_close(found[key], expected[key], msg=str(key))
    for key in kept:
        torch.testing.assert_close(found["next"][key], expected["next"][key], msg=str(key))
    known = ~expected["next", "done"].squeeze(-1) | seen_at_ends
    torch.testing.assert_close(found["next", "observation"][known], expected["next", "observation"][known])


@pytest.mark.parametrize("execute", [1, 2, 3, 4])
@pytest.mark.parametrize("lengths", [(6, 4, 3), (4, 4, 4), (1, 9, 2), (5, 3, 7)])
def test_native_autoresets_end_decisions_where_episodes_end(execute, lengths):
    env = TransformedEnv(native(lengths), policy_transforms(PRIOR, execute=execute))
    check_equal(played(env), reference(lengths, execute))


@pytest.mark.parametrize("execute", [1, 3])
def test_native_autoresets_inside_a_collector_and_with_step_counters(execute):
    transforms = policy_transforms(PRIOR, execute=execute)
    transforms.insert(0, StepCounter())
    transforms.insert(0, RewardSum())
    env = TransformedEnv(native(), transforms)
    (data,) = Collector(env, chosen, frames_per_batch=21, total_frames=21)
    expected = reference(LENGTHS, execute)
    check_equal(data, expected)
    start = expected["history", "steps"] == 0
    assert (data["step_count"][start] == 0).all() and (data["episode_reward"][start] == 0).all()


def test_native_autoresets_without_resets_of_rows_take_single_steps():
    env = TransformedEnv(native(resets=False), policy_transforms(PRIOR, execute=1))
    check_equal(played(env), reference(LENGTHS, 1))
    env = TransformedEnv(native(resets=False), policy_transforms(PRIOR, execute=2))
    refuses(lambda: played(env), RuntimeError, "Rows", "execute=1")


@pytest.mark.parametrize("execute", [1, 3])
def test_environments_that_torchrl_resets_rest_or_run_on(execute):
    env = TransformedEnv(Rows(), policy_transforms(PRIOR, execute=execute))
    check_equal(played(env), reference(LENGTHS, execute), seen_at_ends=True)


class Auto(Rows):
    """Resets of rows do nothing: the step before has made them."""

    def _reset(self, tensordict=None, **kwargs):
        if tensordict is not None and "_reset" in tensordict:
            return tensordict.copy()
        return super()._reset(tensordict)


@pytest.mark.parametrize("append", [True, False])
def test_autoresets_of_torchrl_take_single_steps(append):
    def env(execute, lengths=LENGTHS):
        base = AutoResetEnv(Auto(lengths, restarts=True), AutoResetTransform())
        if not append:
            return TransformedEnv(base, policy_transforms(PRIOR, execute=execute), auto_unwrap=False)
        for transform in [t.clone() for t in policy_transforms(PRIOR, execute=execute)]:
            base.append_transform(transform)
        return base

    check_equal(played(env(1)), reference(LENGTHS, 1))
    refuses(lambda: played(env(3)), RuntimeError, "execute=1")
    check_equal(played(env(3, (6,))), reference((6,), 3))  # one row alone stops at its end


@pytest.mark.parametrize("inside", [False, True])
def test_workers_may_restart_by_themselves(inside):
    def around(env):
        return TransformedEnv(env, policy_transforms(PRIOR, execute=3))

    first, last = (around, lambda env: env) if inside else (lambda env: env, around)
    make = [lambda n=n: first(AutoResetEnv(Auto((n,), restarts=True), AutoResetTransform())) for n in LENGTHS]
    env = last(SerialEnv(3, make))
    found, expected = env.rollout(7, env.rand_action, break_when_any_done=False), reference(LENGTHS, 3)
    for key in (keys.EXECUTED, "reward", "done"):
        torch.testing.assert_close(found["next", key].squeeze(1), expected["next", key])


def test_batches_inside_of_workers_take_single_steps():
    def make():
        return AutoResetEnv(Auto(restarts=True), AutoResetTransform())

    for batched in (make, Rows):
        env = TransformedEnv(SerialEnv(2, batched), policy_transforms(PRIOR, execute=2))
        with raises(RuntimeError, "execute=1"):
            env.reset()


class Walk(gymnasium.Env):
    """Gymnasium's counterpart of a row of :class:`Rows`."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, length):
        self.length, self.t = length, 0

    def _seen(self):
        return np.array([self.t, self.length], dtype=np.float32)

    def reset(self, seed=None, options=None):
        self.t = 0
        return self._seen(), {}

    def step(self, action):
        self.t += 1
        return self._seen(), float(self.t), self.t >= self.length, False, {}


def vector(mode, execute, nested, lengths=LENGTHS):
    walks = [lambda n=n: Walk(n) for n in lengths]
    base = GymWrapper(SyncVectorEnv(walks, autoreset_mode=mode))
    return TransformedEnv(base, policy_transforms(PRIOR, execute=execute), auto_unwrap=not nested)


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("execute", [1, 2, 4])
def test_vector_environments_without_autoreset(execute, nested):
    found = played(vector(AutoresetMode.DISABLED, execute, nested))
    check_equal(found, reference(LENGTHS, execute), seen_at_ends=True)


@pytest.mark.parametrize("nested", [False, True])
def test_vector_environments_that_restart_in_the_same_step(nested):
    found = played(vector(AutoresetMode.SAME_STEP, 1, nested))
    check_equal(found, reference(LENGTHS, 1), seen_at_ends=True)
    with raises(RuntimeError, "execute=1", "AutoresetMode.DISABLED"):
        played(vector(AutoresetMode.SAME_STEP, 2, nested))
    check_equal(played(vector(AutoresetMode.SAME_STEP, 3, nested, (6,))), reference((6,), 3))


@pytest.mark.parametrize("execute", [1, 2])
def test_vector_environments_that_restart_a_step_late_are_refused(execute):
    # TorchRL's GymWrapper refuses the mode, and its GymEnv takes it.
    env = TransformedEnv(GymEnv("Pendulum-v1", num_envs=2), policy_transforms(PRIOR, execute=execute))
    refuses(lambda: env.rollout(2), RuntimeError, "NEXT_STEP", "AutoresetMode.DISABLED")
    env.close()


@pytest.mark.slow
def test_rows_of_brax_end_inside_their_chunks():
    """Every decision played again from the state that it began with: ``pip install brax``."""
    pytest.importorskip("brax")
    from torchrl.envs import BraxEnv

    base = BraxEnv("inverted_pendulum", batch_size=[3], device="cpu")
    env = TransformedEnv(base, policy_transforms(PRIOR, execute=3, observation_steps=1))
    env.set_seed(0)
    played = env.rollout(12, break_when_any_done=False)
    ended = played["next", "done"].squeeze(-1)
    assert (ended & (played["next", keys.EXECUTED].squeeze(-1) < 3)).any() and not ended.all(0).any()
    for decision in played.unbind(1):
        data, chunk, after = decision.select("state"), decision[keys.CHUNK], decision["next"]
        total = torch.zeros(3, 1)
        for i in range(3):
            going = i < after[keys.EXECUTED].squeeze(-1)
            result = base.step(data.set("action", chunk[:, i]))["next"]
            total[going] += result["reward"][going]
            for row in going.nonzero().flatten().tolist():
                if i + 1 == after[keys.EXECUTED][row]:
                    torch.testing.assert_close(after["observation"][row, 0], result["observation"][row])
                    assert result["done"][row] == after["done"][row]
            data = result.select("state")
        torch.testing.assert_close(after["reward"], total)
