"""The composed transforms: what a policy sees and what the simulator gets."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv
from warmprior import (
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreviewPrior,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
)

NORMALIZER = Normalizer.fit(
    TensorDict(
        {
            "observation": torch.tensor([[0.0, -1.0, -0.5, 3.0], [10.0, 5.0, 0.5, 3.0]]),
            "action": torch.tensor([[-0.5, -0.1], [0.25, 0.3]]),
        },
        [2],
    )
)


def build(place, prior, lengths=(7, 4), **options):
    def transforms():
        return policy_transforms(prior, normalizer=NORMALIZER, **options)

    def one(n):
        return TransformedEnv(CountingEnv(n), transforms())

    batched = SerialEnv if "serial" in place else partial(ParallelEnv, mp_start_method="fork")
    if place == "single":
        return one(lengths[0])
    if place.endswith("inside"):
        return batched(len(lengths), [partial(one, n) for n in lengths])
    base = batched(len(lengths), [partial(CountingEnv, n) for n in lengths])
    return TransformedEnv(base, transforms())


@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior])
@pytest.mark.parametrize("place", ["single", "serial-inside", "serial-outside"])
def test_specs(place, prior_class):
    env = build(place, prior_class(3))
    check_env_specs(env)
    assert env.observation_spec["observation"].shape[-2:] == (2, 4)
    env.close(raise_if_closed=False)


@pytest.mark.parametrize("observation_steps", [1, 2, 3])
@pytest.mark.parametrize("place", ["single", "serial-inside", "serial-outside", "parallel-inside"])
def test_policy_sees_the_last_normalised_observations(place, observation_steps):
    """The stack is of control steps, also across the steps inside a chunk, and starts afresh."""
    prior = PastPrior(3)
    env = build(place, prior, observation_steps=observation_steps)
    lengths = (7,) if place == "single" else (7, 4)

    policy = ChunkPolicy(lambda data: torch.full((*data.batch_size, 3, ACTION_DIM), 0.5))
    rollout = env.rollout(6, policy, break_when_any_done=False)
    rollout = rollout[None] if place == "single" else rollout
    env.close(raise_if_closed=False)
    loc, scale = NORMALIZER.loc("observation"), NORMALIZER.scale("observation")
    executed = 0.5 * NORMALIZER.scale("action") + NORMALIZER.loc("action")
    for row, length in zip(rollout, lengths, strict=True):
        time = 0
        for t in range(6):
            stack = row["observation"][t] * scale + loc
            expected = [max(time - back, 0) for back in reversed(range(observation_steps))]
            torch.testing.assert_close(stack[:, 0], torch.tensor(expected).float())
            for moment, frame in zip(expected, stack, strict=True):
                action = executed if moment else torch.zeros(ACTION_DIM)
                torch.testing.assert_close(frame[2:], action)
            after = row["next", "observation"][t] * scale + loc
            time = min(time + 3, length)
            assert after[-1, 0].round() == time
            time = 0 if time == length else time


@pytest.mark.parametrize("place", ["single", "serial-inside", "parallel-inside"])
def test_executes_fewer_than_predicted(place):
    prior = PreviewPrior(3)
    env = build(place, prior, execute=2, gamma=0.5)
    network = VelocityMLP(ACTION_DIM, 4, 6, hidden_dim=8)
    rollout = env.rollout(3, WarmPriorActor(network, prior, nfe=1))
    env.close(raise_if_closed=False)
    rollout = rollout[None] if place == "single" else rollout
    # Rewards are 1, 2, 3, 4: the first decision earns 1 + 2 / 2, the second 3 + 4 / 2.
    assert rollout["next", "reward"][:, :2, 0].tolist() == [[2.0, 5.0]] * len(rollout)
    chunk, loc = rollout["vla_action", "chunk"], rollout["prior", "loc"]
    assert torch.equal(loc[:, 1, :3], chunk[:, 0, 2:5])
    assert rollout["prior", "warm"][:, 1, :3].all() and not rollout["prior", "warm"][:, 0].any()


def test_composes_with_other_transforms():
    prior = PastPrior(3)
    env = TransformedEnv(CountingEnv(7), Compose(StepCounter(max_steps=5), policy_transforms(prior)))
    check_env_specs(env)
    rollout = env.rollout(10)
    assert rollout["next", "executed_steps"].flatten().tolist() == [3, 2]
    assert rollout["next", "truncated"].flatten().tolist() == [False, True]
    assert not rollout["next", "terminated"].any()


def test_the_normaliser_is_not_consumed():
    """Two environments from one normaliser, and the normaliser itself unchanged."""
    before = {name: value.clone() for name, value in NORMALIZER.state_dict().items()}
    first, second = build("single", PastPrior(3)), build("single", PastPrior(3))
    first.reset()
    torch.testing.assert_close(first.reset()["observation"][..., 0], second.reset()["observation"][..., 0])
    for name, value in NORMALIZER.state_dict().items():
        assert torch.equal(value, before[name])


def test_episodes_do_not_share_observations():
    env = build("single", PastPrior(3))
    env.rollout(2)
    stack = env.reset()["observation"]
    assert torch.equal(stack[0], stack[1])
    fresh = env.reset()["observation"]
    assert fresh[0, 1] > stack[0, 1]  # the episode's number


def test_the_normaliser_knows_the_action():
    ones = {"observation": torch.ones(4), "move": torch.ones(2)}
    normalizer = Normalizer({key: -2 * value for key, value in ones.items()}, ones)
    with pytest.raises(ValueError, match=r"'move'.*not the environment's action 'action'"):
        policy_transforms(PastPrior(3), normalizer=normalizer)
    transforms = policy_transforms(PastPrior(3), normalizer=normalizer, action_key="move")
    moved = transforms[:2].inv(TensorDict({"move": torch.ones(2)}))["move"]
    assert moved.tolist() == [1.0, 1.0]  # of the range from -2 to 1
