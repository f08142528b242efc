"""float64 demonstrations and environments, and networks of another precision than either."""

from functools import partial

import pytest
import torch
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, CountingEnv, demonstrations, mlp_actor
from warmprior import (
    FlowMatchingLoss,
    Normalizer,
    PastPrior,
    PreviewPrior,
    policy_transforms,
    window_replay_buffer,
)

H = 3


class StrictEnv(CountingEnv):
    def _step(self, tensordict):
        assert tensordict["action"].dtype == self.action_spec.dtype
        return super()._step(tensordict)


class DoubleEnv(StrictEnv):
    def __init__(self, length=7):
        super().__init__(length)
        self.observation_spec = Composite(observation=Unbounded((4,), dtype=torch.float64))
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,), dtype=torch.float64)

    def _observation(self, action):
        return super()._observation(action).double()


def steps(dtype):
    data = demonstrations(d_o=4)
    return data.update(data.select("observation", "action").to(dtype))


def actor_of(prior, dtype):
    return mlp_actor(prior, hidden_dim=16, nfe=3, clip=1.0).to(dtype)


def loss_of(prior, dtype):
    return FlowMatchingLoss(actor_of(prior, dtype), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("network", [torch.float32, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("data", [torch.float32, torch.float64])
def test_training_gives_the_loss_of_full_precision(data, network):
    prior = PastPrior(H)
    windows = window_replay_buffer(steps(data), prior, batch_size=32).sample()
    assert windows["vla_action", "chunk"].dtype == data
    loss = loss_of(prior, network)
    found = loss(windows)["loss_flow_matching"]
    found.backward()
    assert found.dtype == data  # and not the network's: errors are summed over the batch
    assert all(p.grad.dtype == network and p.grad.isfinite().all() for p in loss.parameters())
    exact = loss_of(prior, torch.float64)(windows)["loss_flow_matching"]
    tolerance = 2e-2 if network == torch.bfloat16 else 1e-5
    torch.testing.assert_close(found.double(), exact.double(), rtol=tolerance, atol=0)


@pytest.mark.parametrize("network", [torch.float32, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("env_class", [StrictEnv, DoubleEnv])
@pytest.mark.parametrize("prior_class", [PastPrior, PreviewPrior])
def test_a_cast_policy_acts_in_the_precision_of_its_environment(prior_class, env_class, network):
    actor = actor_of(prior_class(H), torch.float32).replace(normalizer=Normalizer.fit(steps(torch.float64)))
    base = SerialEnv(2, [partial(env_class, n) for n in (7, 4)])
    env = TransformedEnv(base, policy_transforms(actor.to(network)))
    check_env_specs(env)
    rollout = env.rollout(5, actor, break_when_any_done=False)
    dtype = torch.float64 if env_class is DoubleEnv else torch.float32
    for key in (("history", "actions"), ("prior", "loc"), ("vla_action", "chunk")):
        assert rollout[key].dtype == dtype, key
    assert rollout["observation"].dtype == (torch.float64 if network == torch.float64 else dtype)
    warm = rollout["prior", "warm"]
    assert warm[:, 1:].any() and rollout["vla_action", "chunk"].isfinite().all()


def test_batches_come_to_the_network():
    """As memory-mapped data to a GPU; "meta" stands for a device that other tensors cannot meet."""
    prior = PastPrior(H)
    windows = window_replay_buffer(steps(torch.float32), prior, batch_size=8).sample()
    loss = FlowMatchingLoss(actor_of(prior, torch.float32).to("meta"))
    assert loss(windows)["loss_flow_matching"].device.type == "meta"
