"""DSRL-NA in a training: what must not change, what must agree, and what must not go unnoticed."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.objectives import HardUpdate, SoftUpdate

from tests.rl.dsrl_parts import D_A, D_O, TO, H, batch, build, make_decoder
from warmprior import (
    DSRLNALoss,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    PriorDecoder,
    PriorSpace,
    ResidualSampler,
    VelocityMLP,
    WarmPriorActor,
    keys,
    make_prior_space_actor,
    make_prior_space_critic,
    policy_transforms,
)
from warmprior.envs import NavigationEnv


def rollout(policy, decoder, inside, frames=40):
    transforms = policy_transforms(decoder.prior, observation_steps=1)
    transforms.append(PriorAnchor(policy))
    if inside:
        transforms.append(PriorSpace(decoder))
    env = TransformedEnv(NavigationEnv(batch_size=[4]), transforms)
    env.set_seed(0)
    torch.manual_seed(0)
    sampler = ResidualSampler(decoder)
    acting = sampler if inside else TensorDictSequential(sampler, decoder)
    return env.rollout(frames, acting, break_when_any_done=False)


def navigation_loss(prior):
    """And the policy in it."""
    torch.manual_seed(0)
    network = VelocityMLP(1, 9, prior.prediction_length, 1, hidden_dim=8)
    data = TensorDict({"observation": torch.randn(9, 9), "action": torch.randn(9, 1)}, [9])
    actor = WarmPriorActor(network, prior, nfe=1, normalizer=Normalizer.fit(data))
    decoder = PriorDecoder(actor, delta=0.5)
    sizes = (1, 9, prior.prediction_length, 1)
    loss = DSRLNALoss(
        make_prior_space_actor(*sizes, delta=0.5, hidden_dim=8),
        make_prior_space_critic(*sizes, in_keys=(keys.OBSERVATION, keys.CHUNK), hidden_dim=8),
        make_prior_space_critic(*sizes, delta=0.5, hidden_dim=8),
        decoder,
        generator=torch.Generator().manual_seed(0),
    )
    return loss, actor


@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior])
def test_either_wiring_gives_the_same_losses(prior_class):
    results = []
    for inside in (False, True):
        loss, policy = navigation_loss(prior_class(4))
        SoftUpdate(loss, tau=0.1)
        if inside:
            loss.set_keys(chunk=("next", *keys.DECODED_CHUNK))
        data = rollout(policy, loss.decoder, inside).reshape(-1)
        torch.manual_seed(2)
        results.append(loss(data.select(*loss.in_keys)))
    assert all(torch.equal(results[0][key], results[1][key]) for key in results[0].keys())  # noqa: SIM118


@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior])
def test_frozen_through_training(prior_class):
    """Collect, store, sample, optimise, update targets, save, move: the decoder does not change."""
    loss, policy = navigation_loss(prior_class(4))
    decoder = loss.decoder
    before = {name: tensor.clone() for name, tensor in decoder.state_dict().items()}
    assert any("normalizer" in name for name in before)
    start = [p.detach().clone() for p in loss.parameters()]
    loss.train().requires_grad_(True)
    updater = HardUpdate(loss, value_network_update_interval=1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, weight_decay=0.1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=16)
    buffer.extend(rollout(policy, decoder, inside=False).reshape(-1).select(*loss.in_keys))
    for compute in loss.schedule(updates=3):
        losses = compute(buffer.sample())
        optimizer.zero_grad()
        sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        optimizer.step()
        updater.step()
    loss.reset_parameters_recursive()
    loss.load_state_dict(loss.state_dict())
    assert any(not torch.equal(p, q) for p, q in zip(loss.parameters(), start, strict=True))
    ids = {tensor.data_ptr() for tensor in decoder.state_dict().values() if tensor.numel()}
    assert not ids & {p.data_ptr() for p in loss.parameters()}
    after = decoder.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert not any(module.training for module in decoder.modules())


@pytest.mark.parametrize(
    "missing",
    [
        "observation",
        ("prior", "anchor"),
        ("vla_action", "chunk"),
        ("next", "prior", "anchor"),
        ("next", "executed_steps"),
        ("next", "terminated"),
    ],
)
def test_buffer_of_another_wiring(missing):
    data = batch()
    del data[missing]
    with pytest.raises(KeyError, match=r"missing: .*set_keys\(chunk") as error:
        build()(data)
    assert f"missing: [{missing!r}]" in error.value.args[0]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_divergence_is_named(value):
    data = batch()
    data["next", "reward"][0] = value
    diverged = r"^NaN or infinity in %s: the training has diverged"
    with pytest.raises(FloatingPointError, match=diverged % "loss_qvalue"):
        build()(data)
    loss = build()
    with torch.no_grad():
        next(iter(loss.noise_qvalue_network_params.values(True, True))).fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=diverged % "loss_qvalue_noise"):
        loss.distillation_loss(batch())
    with pytest.raises(FloatingPointError, match=diverged % "loss_actor"):
        loss(batch())


def test_networks_that_do_not_fit():
    decoder = make_decoder(PastPrior(H))
    sizes = (D_A, D_O, H, TO)
    actor = make_prior_space_actor(*sizes, delta=0.5)
    chunk = make_prior_space_critic(*sizes, in_keys=(keys.OBSERVATION, keys.CHUNK))
    noise = make_prior_space_critic(*sizes, delta=0.5)
    with pytest.raises(ValueError, match=r"qvalue_network must read .*chunk"):
        DSRLNALoss(actor, noise, noise, decoder)
    with pytest.raises(ValueError, match=r"noise_qvalue_network must read .*delta"):
        DSRLNALoss(actor, chunk, chunk, decoder)
    with pytest.raises(ValueError, match=r"box of half side 1.5, the decoder's in one of 0.5"):
        DSRLNALoss(make_prior_space_actor(*sizes, delta=1.5), chunk, noise, decoder)
    with pytest.raises(ValueError, match=r"the actor writes .*shift.*, but the decoder reads .*delta"):
        renamed = make_prior_space_actor(*sizes, delta=0.5, delta_key="shift")
        DSRLNALoss(renamed, chunk, noise, decoder)
    with pytest.raises(TypeError, match=r"without a decoder behind it, got TensorDictSequential"):
        DSRLNALoss(TensorDictSequential(actor, decoder), chunk, noise, decoder)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backup": "max"}, "backup must be 'min' or 'mean'"),
        ({"noise_critic_steps": 0}, "noise_critic_steps must be at least 1"),
        ({"alpha_init": 0.0}, "alpha_init must be a finite number > 0"),
        ({"distillation": "laplace"}, "distribution must be"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)
