"""PriorDecoder: the actor's own ODE from anchor + delta, frozen against everything."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules.models.utils import _reset_parameters_recursive

from tests.toy_env import ACTION_DIM, CountingEnv, random_history
from warmprior import (
    ActionHistory,
    ChiTransformer,
    ChunkStep,
    GaussianPrior,
    HistoryObservation,
    Normalizer,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    PriorDecoder,
    VelocityMLP,
    WarmPriorActor,
    keys,
    make_prior_space_actor,
)

H, D_A, D_O, TO = 3, ACTION_DIM, 5, 2


def make_actor(prior, width=D_O, **options):
    torch.manual_seed(1)
    network = VelocityMLP(D_A, width, prior.prediction_length, TO, hidden_dim=16)
    return WarmPriorActor(network, prior, **options)


def batch(prior, *shape):
    chunk = (*shape, prior.prediction_length, D_A)
    return TensorDict(
        {
            "observation": torch.randn(*shape, TO, D_O),
            "prior": {
                "anchor": torch.randn(chunk),
                "delta": torch.rand(chunk) - 0.5,
            },
        },
        shape,
    )


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


def test_another_number_of_evaluations():
    prior = PastPrior(H)
    actor = make_actor(prior, nfe=3)
    data = batch(prior, 4)
    one = PriorDecoder(actor, delta=0.5, nfe=1)(data.clone())
    a0, o = one["prior", "noise"], data["observation"]
    with torch.no_grad():
        expected = a0 + actor.network(torch.zeros(4), a0, o)
    torch.testing.assert_close(one["vla_action", "chunk"], expected)
    with pytest.raises(ValueError, match="positive multiple of 2 for the heun"):
        PriorDecoder(make_actor(prior, nfe=4, solver="heun"), delta=0.5, nfe=3)


def test_a_policy_that_sees_its_last_actions():
    prior = GaussianPrior(H)
    width = D_O + HistoryObservation.width(H, D_A)
    actor = make_actor(prior, width, nfe=2, observation_key=keys.CONDITIONED)
    data = batch(prior, 4).set("history", random_history(prior, 4))
    data = HistoryObservation()(data)
    data["prior", "anchor"] = torch.zeros_like(data["prior", "anchor"])
    decoder = PriorDecoder(actor, delta=1.5)
    assert keys.CONDITIONED in decoder.in_keys
    out = decoder(data.clone())
    with torch.no_grad():
        reference = actor.ode(data.set(("prior", "noise"), data["prior", "delta"]))
    assert torch.equal(out["vla_action", "chunk"], reference["vla_action", "chunk"])


def fingerprint(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def unchanged(module, before):
    after = module.state_dict()
    return before.keys() == after.keys() and all(torch.equal(before[k], after[k]) for k in before)


@torch.no_grad()
def zero(module):
    for tensor in (*module.parameters(recurse=False), *module.buffers(recurse=False)):
        tensor.zero_()


@pytest.mark.parametrize("network", ["mlp", "transformer"])
def test_nothing_can_change_the_decoder(network):
    prior = PastPrior(H)
    data = TensorDict({"observation": torch.randn(9, D_O), "action": torch.randn(9, D_A)}, [9])
    actor = make_actor(prior, nfe=1, normalizer=Normalizer.fit(data))
    if network == "transformer":
        net = ChiTransformer(D_A, D_O, H, TO, embedding_dim=12, num_layers=1, num_heads=2, dropout=0.5)
        actor = WarmPriorActor(net, prior, nfe=1, normalizer=actor.normalizer)
    decoder = PriorDecoder(actor, delta=0.5)
    policy = TensorDictSequential(make_prior_space_actor(D_A, D_O, H, delta=0.5), decoder)
    before = fingerprint(decoder)
    assert len(before) == len(actor.state_dict())

    policy.train().requires_grad_(True)
    assert not any(module.training for module in decoder.modules())
    assert not list(decoder.parameters()) and not any(b.requires_grad for b in decoder.buffers())
    policy.reset_parameters_recursive()
    _reset_parameters_recursive(policy)  # TorchRL's other one
    policy.apply(zero)  # PyTorch's way to draw initial weights
    assert not any("reset_parameters" in vars(module) for module in decoder.modules())
    optimizer = torch.optim.SGD(policy.parameters(), lr=1.0)
    chunk = policy(batch(prior, 4))["vla_action", "chunk"]
    assert not chunk.requires_grad
    data = policy(batch(prior, 4))
    data["prior", "delta_log_prob"].sum().backward()
    optimizer.step()
    with torch.no_grad():
        for parameter in actor.parameters():  # the policy it was copied from goes on training
            parameter.add_(1.0)
    assert unchanged(decoder, before)
    fixed = batch(prior, 4)
    first = decoder(fixed.clone())["vla_action", "chunk"]
    assert torch.equal(first, decoder(fixed.clone())["vla_action", "chunk"])


def test_the_policy_is_left_alone():
    actor = make_actor(PastPrior(H)).train()
    names = [name for name, _ in actor.named_parameters()]
    PriorDecoder(actor, delta=0.5)
    assert actor.training and [name for name, _ in actor.named_parameters()] == names
    assert all(parameter.requires_grad for parameter in actor.parameters())


def test_tied_parameters_stay_tied():
    class Tied(nn.Module):
        def __init__(self):
            super().__init__()
            self.a = nn.Linear(D_A, D_A)
            self.b = nn.Linear(D_A, D_A)
            self.b.weight = self.a.weight

        def forward(self, t, a, observation):
            return self.b(self.a(a))

    decoder = PriorDecoder(WarmPriorActor(Tied(), PastPrior(H)), delta=0.5)
    network = decoder.ode.network
    assert network.a.weight is network.b.weight
    network.to(torch.float64)
    assert network.a.weight.dtype == network.b.weight.dtype == torch.float64


def test_copies_and_devices():
    decoder = PriorDecoder(make_actor(PastPrior(H), nfe=1), delta=0.5)
    data = batch(PastPrior(H), 4)
    again = copy.deepcopy(decoder)
    assert torch.equal(
        decoder(data.clone())["vla_action", "chunk"], again(data.clone())["vla_action", "chunk"]
    )
    moved = TensorDictSequential(again.double()).to("meta").state_dict()
    assert moved.keys() == {f"module.0.{key}" for key in decoder.state_dict()}
    assert all(value.device.type == "meta" for value in moved.values())
    assert {value.dtype for value in moved.values()} == {torch.float64}
    assert {value.dtype for value in decoder.state_dict().values()} == {torch.float32}


def test_gradient_of_the_residual_by_finite_differences():
    prior = PastPrior(H)
    decoder = PriorDecoder(make_actor(prior, nfe=2), delta=0.5, differentiable=True).double()
    data = batch(prior, 1).double()

    def decode(delta):
        return decoder(data.clone().set(("prior", "delta"), delta))["vla_action", "chunk"]

    delta = data["prior", "delta"].clone().requires_grad_()
    assert torch.autograd.gradcheck(decode, delta)
    with torch.no_grad():
        assert not decode(delta).requires_grad


@pytest.mark.parametrize("delta", [0.0, -0.5, float("nan"), float("inf")])
def test_no_box(delta):
    with pytest.raises(ValueError, match="delta must be a finite number > 0"):
        PriorDecoder(make_actor(PastPrior(H)), delta=delta)


def test_regression_has_no_source_space():
    with pytest.raises(ValueError, match=r"trained at t = 0 alone.* no source space to act in"):
        PriorDecoder(make_actor(GaussianPrior(H), max_nfe=1), delta=0.5)


@pytest.mark.parametrize("missing", ["observation", ("prior", "anchor"), ("prior", "delta")])
def test_missing_key(missing):
    prior = PastPrior(H)
    data = batch(prior, 4)
    del data[missing]
    with pytest.raises(KeyError, match=missing[-1] if isinstance(missing, tuple) else missing):
        PriorDecoder(make_actor(prior), delta=0.5)(data)


def test_shapes_of_another_policy():
    decoder = PriorDecoder(make_actor(PastPrior(H)), delta=0.5)
    with pytest.raises(ValueError, match=r"anchor.*\(4, 6, 2\).*\(P, d_a\) = \(3, 2\)"):
        decoder(batch(PreviewPrior(H), 4))
    data = batch(PastPrior(H), 4)
    data["prior", "delta"] = data["prior", "delta"].flatten(-2)
    with pytest.raises(ValueError, match=r"delta.* has shape \(4, 6\)"):
        decoder(data)


def env_for(prior, length=None):
    length = prior.prediction_length if length is None else length
    chunk = ChunkStep(prior.chunk_length, prediction_length=length)
    anchor = PriorAnchor(make_actor(prior), cold="zero")
    return TransformedEnv(CountingEnv(7), Compose(chunk, ActionHistory(H), anchor))


def test_check_env():
    decoder = PriorDecoder(make_actor(PastPrior(H)), delta=0.5)
    decoder.check_env(env_for(PastPrior(H)))
    decoder.check_env(TransformedEnv(env_for(PastPrior(H)), auto_unwrap=False))
    with pytest.raises(ValueError, match=r"takes chunks of \(P, d_a\) = \(6, 2\), .* predicts \(3, 2\)"):
        decoder.check_env(env_for(PreviewPrior(H)))
    with pytest.raises(KeyError, match="append ChunkStep first"):
        decoder.check_env(CountingEnv(7))
    wide = make_actor(PastPrior(H))
    wide.network.action_dim = 5
    with pytest.raises(ValueError, match=r"\(3, 2\), but the policy predicts \(3, 5\)"):
        PriorDecoder(wide, delta=0.5).check_env(env_for(PastPrior(H)))
