"""PriorDecoder: the actor's own ODE from anchor + delta, frozen against everything."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, TransformedEnv

from tests.errors import raises
from tests.states import copied, same
from tests.toy_env import ACTION_DIM, CountingEnv, mlp_actor
from warmprior import (
    ActionHistory,
    ChiTransformer,
    ChunkStep,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    PriorDecoder,
    ResidualSampler,
    WarmPriorActor,
    make_prior_space_actor,
)
from warmprior.rl import residual_reach

H, D_A, D_O, TO = 3, ACTION_DIM, 5, 2
make_actor = partial(mlp_actor, observation_dim=D_O, hidden_dim=16)


def batch(prior, *shape):
    chunk = (*shape, prior.prediction_length, D_A)
    source = {"anchor": torch.randn(chunk), "delta": torch.rand(chunk) - 0.5}
    return TensorDict({"observation": torch.randn(*shape, TO, D_O), "prior": source}, shape)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior])
def test_euler_from_anchor_plus_delta(prior_class, shape):
    prior = prior_class(H)
    actor = make_actor(prior, nfe=3, clip=0.5)
    decoder = PriorDecoder(actor, delta=0.5)
    data = batch(prior, *shape)
    a = (data["prior", "anchor"] + data["prior", "delta"]).reshape(-1, prior.prediction_length, D_A)
    o = data["observation"].reshape(-1, TO, D_O)
    expected_noise = a.reshape(*shape, *a.shape[1:])
    with torch.no_grad():
        for i in range(3):
            a = a + actor.network(torch.full(a.shape[:1], i / 3), a, o) / 3
    out = decoder(data)
    assert torch.equal(out["prior", "noise"], expected_noise)
    expected = a.clamp(-0.5, 0.5).reshape(expected_noise.shape)
    torch.testing.assert_close(out["vla_action", "chunk"], expected)
    assert (a.abs() > 0.5).any() and (a.abs() < 0.5).any()  # the clip matters


@pytest.mark.parametrize("residuals", [1, 2])
def test_residuals_are_held(residuals):
    """One residual for two or four actions, as when each of them had been chosen alike."""
    actor = make_actor(PastPrior(4), nfe=2)
    data = batch(PastPrior(4), 5)
    chosen = data["prior", "delta"][:, :residuals]
    alike = torch.stack([chosen[:, i * residuals // 4] for i in range(4)], 1)
    decoder = PriorDecoder(actor, delta=0.5, residual_length=residuals)
    held = decoder(data.clone().set(("prior", "delta"), chosen))
    expected = PriorDecoder(actor, delta=0.5)(data.set(("prior", "delta"), alike))
    for key in expected["prior"].keys() - {"delta"}:
        assert torch.equal(held["prior", key], expected["prior", key])
    assert torch.equal(held["vla_action", "chunk"], expected["vla_action", "chunk"])
    drawn = ResidualSampler(decoder)(data)["prior", "delta"]
    networks = make_prior_space_actor(**decoder.sizes, delta=0.5)
    assert networks(data)["prior", "delta"].shape == drawn.shape == (5, residuals, D_A)
    with raises(ValueError, "residual_length (3)", "(4)"):
        PriorDecoder(actor, delta=0.5, residual_length=3)
    with raises(ValueError, "residual_length (3)", "(4)"):
        make_prior_space_actor(**decoder.sizes | {"residual_length": 3}, delta=0.5)


class Slope(torch.nn.Module):
    """The velocity ``k * a``, so one step decodes ``(1 + k) * a_0``."""

    def __init__(self, slope):
        super().__init__()
        self.slope = slope

    def forward(self, t, a, observation):
        return self.slope * a


@pytest.mark.parametrize("residuals", [1, 3])
def test_the_reach_of_a_linear_field(residuals):
    """Uniform residuals in the box have a standard deviation of ``delta / sqrt(3)``."""
    decoder = PriorDecoder(make_actor(PastPrior(3), nfe=1), delta=0.6, residual_length=residuals)
    decoder.ode.network = Slope(-0.75)
    generator = torch.Generator().manual_seed(0)
    found = residual_reach(decoder, batch(PastPrior(3), 400), draws=50, generator=generator)
    assert found == pytest.approx(0.25 * 0.6 / 3**0.5, rel=0.01)
    with raises(ValueError, "draws"):
        residual_reach(decoder, batch(PastPrior(3), 4), draws=1)


@pytest.mark.parametrize("network", ["mlp", "transformer"])
def test_nothing_can_change_the_decoder(network):
    prior = PastPrior(H)
    data = TensorDict({"observation": torch.randn(9, D_O), "action": torch.randn(9, D_A)}, [9])
    actor = make_actor(prior, nfe=1, normalizer=Normalizer.fit(data))
    if network == "transformer":
        net = ChiTransformer(D_A, D_O, H, TO, hidden_dim=12, num_layers=1, num_heads=2, dropout=0.5)
        actor = WarmPriorActor(net, prior, nfe=1, normalizer=actor.normalizer)
    decoder = PriorDecoder(actor, delta=0.5)
    policy = TensorDictSequential(make_prior_space_actor(D_A, D_O, H, delta=0.5), decoder)
    before = copied(decoder.state_dict())
    assert len(before) == len(actor.state_dict())

    assert not any(p.requires_grad for p in decoder.parameters())
    policy.train().requires_grad_(True)
    assert not any(module.training for module in decoder.modules())
    optimizer = torch.optim.SGD(policy.parameters(), lr=1.0)
    chunk = policy(batch(prior, 4))["vla_action", "chunk"]
    assert not chunk.requires_grad
    data = policy(batch(prior, 4))
    data["prior", "delta_log_prob"].sum().backward()
    optimizer.step()
    with torch.no_grad():
        for parameter in actor.parameters():  # the policy it was copied from goes on training
            parameter.add_(1.0)
    assert same(decoder.state_dict(), before)
    fixed = batch(prior, 4)
    first = decoder(fixed.clone())["vla_action", "chunk"]
    assert torch.equal(first, decoder(fixed.clone())["vla_action", "chunk"])


def test_another_policy():
    with raises(ValueError, "t = 0"):  # regression, which has no source space
        PriorDecoder(make_actor(GaussianPrior(H), max_nfe=1), delta=0.5)
    decoder = PriorDecoder(make_actor(PastPrior(H)), delta=0.5)
    with raises(ValueError, "anchor", "has shape [4, 6, 2]", "expected [4, 3, 2]"):
        decoder(batch(PreviewPrior(H), 4))
    data = batch(PastPrior(H), 4)
    data["prior", "delta"] = data["prior", "delta"].flatten(-2)
    with raises(ValueError, "delta", "has shape [4, 6]", "expected [4, 3, 2]"):
        decoder(data)


def env_for(prior, length=None):
    length = prior.prediction_length if length is None else length
    chunk = ChunkStep(prior.chunk_length, prediction_length=length)
    anchor = PriorAnchor(make_actor(prior))
    return TransformedEnv(CountingEnv(7), Compose(chunk, ActionHistory(H), anchor))


def test_check_env():
    decoder = PriorDecoder(make_actor(PastPrior(H)), delta=0.5)
    decoder.check_env(env_for(PastPrior(H)))
    decoder.check_env(TransformedEnv(env_for(PastPrior(H)), auto_unwrap=False))
    with raises(ValueError, "has shape [6, 2], expected [3, 2]"):
        decoder.check_env(env_for(PreviewPrior(H)))
    with raises(KeyError, "ChunkStep"):
        decoder.check_env(CountingEnv(7))
    wide = make_actor(PastPrior(H))
    wide.network.action_dim = 5
    with raises(ValueError, "has shape [3, 2], expected [3, 5]"):
        PriorDecoder(wide, delta=0.5).check_env(env_for(PastPrior(H)))
