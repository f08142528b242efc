"""ObservationStack against the list of observations, with partial steps and resets."""

from functools import partial

import pytest
import torch
from torchrl.envs import CatFrames, Compose, SerialEnv, TransformedEnv, UnsqueezeTransform
from torchrl.envs.utils import check_env_specs

from tests.errors import raises
from tests.toy_env import CountingEnv
from warmprior import ObservationStack


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_equals_cat_frames_on_a_single_environment(steps):
    ours = TransformedEnv(CountingEnv(6), ObservationStack(steps))
    theirs = TransformedEnv(
        CountingEnv(6),
        Compose(
            UnsqueezeTransform(-2, in_keys=["observation"]), CatFrames(steps, dim=-2, in_keys=["observation"])
        ),
    )
    check_env_specs(ours)
    theirs.base_env.episode = ours.base_env.episode
    torch.manual_seed(0)
    one = ours.rollout(15, break_when_any_done=False)
    torch.manual_seed(0)
    two = theirs.rollout(15, break_when_any_done=False)
    assert torch.equal(one["observation"], two["observation"])
    assert torch.equal(one["next", "observation"], two["next", "observation"])


def test_rows_that_reset_or_rest_alone():
    env = TransformedEnv(SerialEnv(2, [partial(CountingEnv, n) for n in (2, 9)]), ObservationStack(3))
    check_env_specs(env)
    data = env.reset()
    for _ in range(2):
        data = env.step_mdp(env.step(env.rand_action(data)))
    assert data["observation"][..., 0].tolist() == [[0, 1, 2], [0, 1, 2]]
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert data["observation"][..., 0].tolist() == [[0, 0, 0], [0, 1, 2]]
    data = env.rand_action(data).set("_step", torch.tensor([False, True]))
    data = env.step_mdp(env.step(data))
    assert data["observation"][..., 0].tolist() == [[0, 0, 0], [1, 2, 3]]
    data = env.rand_action(data).set("_step", torch.tensor([True, False]))
    data = env.step_mdp(env.step(data))
    assert data["observation"][..., 0].tolist() == [[0, 0, 1], [1, 2, 3]]


def test_errors():
    with raises(ValueError, "steps", 0):
        ObservationStack(0)
    env = TransformedEnv(CountingEnv(9), ObservationStack(2))
    data = env.rand_action(env.reset())
    del data["observation"]
    with raises(KeyError, "reset"):
        env.step(data)
