"""ChunkStep against closed-form returns for random episode lengths, horizons and discounts."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, RewardSum, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv
from warmprior import ChunkStep


def ones(length):
    """A policy whose chunk tells the decision's step: action i of a chunk is (step + i) / 100."""

    def chunk(data):
        start = data["observation"][..., :1, None] / 100
        ramp = torch.arange(length).view(-1, 1) / 100
        return (start + ramp).expand(*data.batch_size, length, ACTION_DIM).clone()

    return ChunkPolicy(chunk)


def geometric(gamma, first, count):
    """Discounted sum of the rewards first + 1, ..., first + count."""
    return sum(gamma**i * (first + i + 1) for i in range(count))


@settings(max_examples=20, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 11), min_size=1, max_size=3),
    horizon=st.integers(1, 5),
    data=st.data(),
    gamma=st.sampled_from([1.0, 0.9, 0.5]),
    truncate=st.booleans(),
)
def test_returns_in_closed_form(lengths, horizon, data, gamma, truncate):
    execute = data.draw(st.integers(1, horizon))
    prediction = data.draw(st.integers(horizon, 2 * horizon))
    base = SerialEnv(len(lengths), [partial(CountingEnv, n, truncate) for n in lengths])
    chunk = ChunkStep(horizon, execute=execute, prediction_length=prediction, gamma=gamma)
    env = TransformedEnv(base, Compose(StepCounter(), RewardSum(), chunk))
    rollout = env.rollout(8, ones(prediction), break_when_any_done=False)
    for row, length in zip(rollout, lengths, strict=True):
        time = 0
        for t in range(8):
            step, after = row[t], row[t]["next"]
            assert step["observation"][0] == time
            k = min(execute, length - time)
            assert after["executed_steps"].item() == k
            assert after["reward"].item() == pytest.approx(geometric(gamma, time, k), rel=1e-5)
            assert after["observation"][0] == time + k
            # The last action that was executed is action k - 1 of the chunk.
            assert after["observation"][2].item() == pytest.approx((time + k - 1) / 100, abs=1e-6)
            # Per-step transforms before ChunkStep see every control step.
            assert after["step_count"].item() == time + k
            assert after["episode_reward"].item() == sum(range(1, time + k + 1))
            done = time + k == length
            assert after["done"].item() == done
            assert after["truncated"].item() == (done and truncate)
            assert after["terminated"].item() == (done and not truncate)
            time = 0 if done else time + k
    env.close()


def test_rows_that_rest_count_for_no_measure():
    env = TransformedEnv(SerialEnv(2, partial(CountingEnv, 9)), ChunkStep(3, measures={"observation": "sum"}))
    data = env.step_mdp(env.step(ones(3)(env.reset())))
    assert data["observation"][:, 0].tolist() == [1 + 2 + 3] * 2
    stepped = env.step(ones(3)(data).set("_step", torch.tensor([False, True])))["next"]
    assert stepped["observation"][:, 0].tolist() == [0, 4 + 5 + 6]


@pytest.mark.parametrize("prediction", [3, 6])
def test_specs(prediction):
    env = TransformedEnv(SerialEnv(2, partial(CountingEnv, 5)), ChunkStep(3, prediction_length=prediction))
    check_env_specs(env)
    spec = env.full_action_spec["vla_action", "chunk"]
    assert spec.shape == (2, prediction, ACTION_DIM)
    assert (spec.space.low == -1).all() and (spec.space.high == 1).all()
    assert list(env.full_action_spec.keys(True, True)) == [("vla_action", "chunk")]
    assert env.observation_spec["executed_steps"].dtype == torch.int64


def test_bad_numbers():
    lengths = {"execute": (4, 0, 2.5), "prediction_length": (2,), "chunk_length": (0, -1)}
    for name, values in (lengths | {"gamma": (1.5, -0.1, math.nan)}).items():
        for value in values:
            with raises(ValueError, name, value):
                ChunkStep(**{"chunk_length": 3, name: value})


class Paying(CountingEnv):
    """Every step pays the same, which is one end of its bounds."""

    def __init__(self, low, high, reward, length):
        super().__init__(length)
        self.reward_spec, self.reward = Bounded(low, high, (1,)), reward

    def _step(self, tensordict):
        return super()._step(tensordict).set("reward", torch.tensor([self.reward]))


@pytest.mark.parametrize("gamma", [1.0, 0.9, 0.0])
@pytest.mark.parametrize(("low", "high", "reward"), [(0.0, 1.0, 1.0), (-1.0, 0.0, -1.0), (-2.0, -1.0, -1.0)])
def test_the_sum_may_leave_the_bounds_of_one_reward(low, high, reward, gamma):
    base = SerialEnv(2, [partial(Paying, low, high, reward, n) for n in (8, 5)])
    env = TransformedEnv(base, ChunkStep(3, gamma=gamma))
    check_env_specs(env)
    two, three = 1 + gamma, 1 + gamma + gamma**2
    found = env.rollout(2, ones(3))["next", "reward"].squeeze(-1)
    torch.testing.assert_close(found, reward * torch.tensor([[three, three], [three, two]]))
    # The bounds that the wrapped environment gave are its own still.
    assert (base.full_reward_spec["reward"].space.high == high).all()


def test_what_no_chunk_can_be():
    env = TransformedEnv(CountingEnv(5), ChunkStep(3))
    for length in (2, 4):
        with raises(ValueError, "[*B, 3, d_a]", f"({length}, 2"):
            env.step(ones(length)(env.reset()))
    number = CountingEnv(5)
    number.action_spec = Bounded(-1, 1, ())
    with raises(ValueError, "'action'", "[*B, d_a]", "(2,)"):
        TransformedEnv(SerialEnv(2, lambda: number), ChunkStep(3)).rollout(1)
    env = TransformedEnv(CountingEnv(4), ChunkStep(2, measures={"reward": "max"}))
    refuses(lambda: env.step(ones(2)(env.reset())), ValueError, "'reward'")
    number = CountingEnv(4)
    number.reward_spec = Composite(one=Unbounded((1,)), two=Unbounded((1,)))
    with raises(RuntimeError, "one", "two", "'done'"):
        TransformedEnv(number, ChunkStep(2)).rollout(1, ones(2))


class Solved(CountingEnv):
    """Solved at its second, sixth and seventh step; its own reward is the step's number."""

    def __init__(self, length=7):
        super().__init__(length)
        self.observation_spec["success"] = Categorical(2, dtype=torch.bool, shape=(1,))

    def _seen(self, out):
        return out.set("success", torch.tensor([self.t in (2, 6, 7)]))


@pytest.mark.parametrize("gamma", [1.0, 0.5])
@pytest.mark.parametrize("length", [4, 7])
def test_a_reward_by_success_pays_every_solved_step(length, gamma):
    base = SerialEnv(2, [Solved, partial(Solved, length)])
    for counter in ([], [StepCounter()]):  # which counts every step, so no transform may wait
        env = TransformedEnv(base, Compose(*counter, ChunkStep(3, gamma=gamma, by_success=True)))
        check_env_specs(env)
        rollout = env.rollout(3, ones(3), break_when_any_done=False)["next"]
        assert (env.transform[-1]._inner_step()[1] is None) == bool(counter)
        reward = rollout[1]["reward"].flatten()
        third = {4: gamma, 7: 1.0}[length]  # of length 4 it is the next episode's first decision
        assert reward.tolist() == pytest.approx([gamma, {4: 0.0, 7: gamma**2}[length], third])
    with raises(KeyError, "success", "by_success"):
        TransformedEnv(CountingEnv(7), ChunkStep(3, by_success=True)).reset()


@pytest.mark.parametrize("place", ["single", "outside"])
def test_an_event_at_any_executed_step_is_one_of_the_chunk(place):
    class Events(CountingEnv):
        def __init__(self, length=7):
            super().__init__(length)
            flag = Categorical(2, dtype=torch.bool, shape=(1,))
            self.observation_spec["success"], self.observation_spec["bell"] = flag, flag.clone()

        def _seen(self, out):
            out["success"] = torch.tensor([self.t in (2, 7)])
            out["bell"] = torch.tensor([self.t == 4])
            return out

    base = Events() if place == "single" else SerialEnv(2, [partial(Events, n) for n in (7, 4)])
    env = TransformedEnv(base, ChunkStep(3))
    check_env_specs(env)
    rollout = env.rollout(3, ones(3), break_when_any_done=False)
    rows = rollout[None] if place == "single" else rollout
    assert rows["next", "success"][0].flatten().tolist() == [True, False, True]
    assert rows["next", "bell"][0].flatten().tolist() == [False, False, False]  # its last step's
    if place == "outside":  # the third decision is the second episode's first
        assert rows["next", "success"][1].flatten().tolist() == [True, False, True]
        assert rows["next", "bell"][1].flatten().tolist() == [False, True, False]
    rollout = TransformedEnv(Events(), ChunkStep(3, success="bell")).rollout(3, ones(3))
    assert rollout["next", "bell"].flatten().tolist() == [False, True, False]
    assert rollout["next", "success"].flatten().tolist() == [False, False, True]


def test_a_row_that_rests_is_not_stepped_when_another_ends():
    env = TransformedEnv(SerialEnv(2, [partial(CountingEnv, n) for n in (3, 9)]), ChunkStep(4))
    data = ones(4)(env.reset())
    stepped = env.step(data.set("_step", torch.tensor([True, False])))["next"]
    assert stepped["observation"][:, 0].tolist() == [3, 0]
    assert stepped["executed_steps"].flatten().tolist() == [3, 0]
