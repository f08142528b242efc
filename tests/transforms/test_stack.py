"""ObservationStack against the list of observations, with partial steps and resets."""

from functools import partial

import torch
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import refuses
from tests.toy_env import CountingEnv
from warmprior import ObservationStack


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
    refuses(lambda: ObservationStack(0), ValueError, "steps", 0)
    env = TransformedEnv(CountingEnv(9), ObservationStack(2))
    data = env.rand_action(env.reset())
    del data["observation"]
    refuses(lambda: env.step(data), KeyError, "reset")
