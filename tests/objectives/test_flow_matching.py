"""Flow matching against the left column of Algorithm 1, written down with the same random numbers."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.paths import PolynomialInterpolant, TrigonometricInterpolant
from tests.toy_env import random_history
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    LinearInterpolant,
    PastPrior,
    PreviewPrior,
    VelocityMLP,
    WarmPriorActor,
    window_replay_buffer,
)

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
H, D_A, D_O = 3, 2, 5
COEFFICIENTS = {
    LinearInterpolant: lambda t: (1 - t, t, -1.0, 1.0),
    PolynomialInterpolant: lambda t: (1 - t**2, t**2, -2 * t, 2 * t),
    TrigonometricInterpolant: lambda t: (
        torch.cos(torch.pi / 2 * t),
        torch.sin(torch.pi / 2 * t),
        -torch.pi / 2 * torch.sin(torch.pi / 2 * t),
        torch.pi / 2 * torch.cos(torch.pi / 2 * t),
    ),
}


def dataset(lengths=(9, 2, 14)):
    torch.manual_seed(0)
    n = sum(lengths)
    return TensorDict(
        {
            "observation": torch.randn(n, D_O),
            "action": torch.randn(n, D_A),
            "episode": torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths)),
        },
        [n],
    )


def actor_for(prior, **options):
    torch.manual_seed(11)
    network = VelocityMLP(D_A, D_O, prior.prediction_length, hidden_dim=16)
    return WarmPriorActor(network, prior, **options)


def algorithm_one(data, frames, prior, network, generator, coefficients):
    """Algorithm 1, lines 3 to 12: squared errors ``[B, P, d_a]`` and where they count."""
    episode = data["episode"].tolist()
    length = prior.prediction_length
    epsilon = torch.randn(len(frames), length, D_A, generator=generator)
    times = torch.rand(len(frames), generator=generator)
    errors, counted = [], []
    for b, i in enumerate(frames):
        last = max(j for j in range(len(data)) if episode[j] == episode[i])
        first = min(j for j in range(len(data)) if episode[j] == episode[i])
        a1 = torch.stack([data["action"][min(j, last)] for j in range(i, i + length)])
        a0 = epsilon[b].clone()
        if isinstance(prior, PastPrior) and i - H >= first:
            a0 = data["action"][i - H : i] + prior.sigma * epsilon[b]
        if isinstance(prior, PreviewPrior):
            a0[:H] = a1[:H] + prior.sigma * epsilon[b, :H]
        alpha, beta, d_alpha, d_beta = coefficients(times[b])
        o = torch.stack([data["observation"][max(i - 1, first)], data["observation"][i]])
        v = network(times[b : b + 1], (alpha * a0 + beta * a1)[None], o[None])[0]
        errors.append((v - (d_alpha * a0 + d_beta * a1)) ** 2)
        counted.append(torch.tensor([[j <= last] for j in range(i, i + length)]).expand(-1, D_A))
    return torch.stack(errors), torch.stack(counted)


@pytest.mark.parametrize("interpolant", COEFFICIENTS)
@pytest.mark.parametrize("prior_class", PRIORS)
def test_training_of_algorithm_one(prior_class, interpolant):
    data = dataset()
    prior = prior_class(H, **({} if prior_class is GaussianPrior else {"sigma": 0.4}))
    actor = actor_for(prior)
    generator = torch.Generator().manual_seed(1)
    batch = window_replay_buffer(data, prior, batch_size=40, generator=generator).sample()
    assert batch["action_is_pad"].any()
    errors, counted = algorithm_one(
        data,
        batch["frame"].tolist(),
        prior,
        actor.network,
        torch.Generator().manual_seed(2),
        COEFFICIENTS[interpolant],
    )
    expected = {"none": errors * counted, "sum": errors[counted].sum(), "mean": errors[counted].mean()}
    gradients = torch.autograd.grad(expected["mean"], list(actor.network.parameters()))
    for reduction, value in expected.items():
        loss = FlowMatchingLoss(
            actor, interpolant=interpolant(), reduction=reduction, generator=torch.Generator().manual_seed(2)
        )
        out = loss(batch)["loss_flow_matching"]
        torch.testing.assert_close(out, value, rtol=1e-4, atol=1e-5)
        if reduction == "mean":
            out.backward()
    for parameter, gradient in zip(actor.network.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6)


def sample(prior, *shape):
    length = prior.prediction_length
    torch.manual_seed(4)
    return TensorDict(
        {
            "observation": torch.randn(*shape, 2, D_O),
            "vla_action": {"chunk": torch.randn(*shape, length, D_A)},
            "action_is_pad": torch.rand(*shape, length) < 0.3,
            "history": random_history(prior, *shape, action_dim=D_A, seed=4),
        },
        shape,
    )


def loss_of(actor, data, **options):
    options.setdefault("generator", torch.Generator().manual_seed(2))
    return FlowMatchingLoss(actor, **options)(data)["loss_flow_matching"]


def test_batch_shapes_agree():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 2, 3)
    torch.testing.assert_close(loss_of(actor, data), loss_of(actor, data.reshape(6)))


def test_no_pad_mask_counts_everything():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    none = data.clone()
    none["action_is_pad"] = torch.zeros(6, H, dtype=torch.bool)
    del data["action_is_pad"]
    assert torch.equal(loss_of(actor, data), loss_of(actor, none))


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_only_padding_is_zero_and_not_nan(reduction):
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    data["action_is_pad"] = torch.ones(6, H, dtype=torch.bool)
    loss = loss_of(actor, data, reduction=reduction)
    assert (loss == 0).all()
    loss.sum().backward()
    assert all((p.grad == 0).all() for p in actor.network.parameters())


def test_generator_repeats_and_defaults_to_the_actor_s():
    prior = PastPrior(H)
    data = sample(prior, 6)
    actor = actor_for(prior, generator=torch.Generator().manual_seed(2))
    explicit = loss_of(actor, data)
    implicit = FlowMatchingLoss(actor)(data)["loss_flow_matching"]
    assert torch.equal(explicit, implicit)
    torch.manual_seed(2)
    plain = FlowMatchingLoss(actor_for(prior))
    torch.manual_seed(2)
    assert torch.equal(plain(data)["loss_flow_matching"], explicit)


@pytest.mark.parametrize("nested", [False, True])
def test_set_keys(nested):
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    expected = loss_of(actor, data)
    old = {
        "observation": "observation",
        "chunk": ("vla_action", "chunk"),
        "pad_mask": "action_is_pad",
        "history": "history",
    }
    new = {name: ("deep", "er", name) if nested else f"my_{name}" for name in old}
    renamed = TensorDict({}, [6])
    for name in old:
        renamed[new[name]] = data[old[name]]
    loss = FlowMatchingLoss(actor, generator=torch.Generator().manual_seed(2))
    loss.set_keys(**new)
    assert set(loss.in_keys) == set(new.values())
    assert torch.equal(loss(renamed)["loss_flow_matching"], expected)


@pytest.mark.parametrize("missing", [("vla_action", "chunk"), "history", ("history", "steps"), "observation"])
def test_missing_key(missing):
    prior = PastPrior(H)
    data = sample(prior, 6)
    del data[missing]
    name = missing if isinstance(missing, str) else missing[-1]
    with pytest.raises(KeyError, match=rf"missing: .*{name}.*(window_replay_buffer|ActionWindow)"):
        loss_of(actor_for(prior), data)


@pytest.mark.parametrize(
    ("made_for", "said"),
    [
        (PreviewPrior(H), r"\('vla_action', 'chunk'\) has 6 positions, but Past.* predicts 3: make"),
        (PastPrior(H - 1), r"has 2 positions, but PastPrior.* predicts 3: make the windows"),
    ],
)
def test_windows_of_other_lengths(made_for, said):
    with pytest.raises(ValueError, match=said):
        loss_of(actor_for(PastPrior(H)), sample(made_for, 6))
    data = sample(PastPrior(H), 6)
    data["history"] = sample(made_for, 6)["history"]
    with pytest.raises(ValueError, match=r"PastPrior.* needs 3 remembered .* of 3, but .* has "):
        loss_of(actor_for(PastPrior(H)), data)


def test_ctrl_c_in_the_network_is_one():
    prior = PastPrior(3)
    network = VelocityMLP(2, 5, 3, 2, hidden_dim=8)
    loss = FlowMatchingLoss(WarmPriorActor(network, prior))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    data = sample(prior, 4)

    def interrupt(*args):
        raise KeyboardInterrupt

    hook = network.register_forward_pre_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        loss(data)
    hook.remove()
    assert loss(data)["loss_flow_matching"].isfinite()
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("trailing", [(), (1,)])
def test_weights_and_masks_of_torchrl(reduction, trailing):
    """``priority_weight`` of prioritised sampling, and ``("collector", "mask")`` of padded trajectories."""
    actor = actor_for(PastPrior(H))
    batch = window_replay_buffer(dataset(), actor.prior, batch_size=12).sample().reshape(3, 4)

    def loss(reduction, **options):
        generator = torch.Generator().manual_seed(5)
        module = FlowMatchingLoss(actor, reduction=reduction, generator=generator)
        for name, value in options.items():
            setattr(module, name, value)
        return module(batch)["loss_flow_matching"]

    error = loss("none")  # zero where padded
    counts = (~batch["action_is_pad"]).double()
    mask, weight = torch.rand(3, 4) < 0.6, torch.rand(3, 4)
    batch["collector", "mask"] = mask.reshape(3, 4, *trailing)
    for weighted in (False, True):
        if weighted:
            batch["priority_weight"] = weight.reshape(3, 4, *trailing)
        w = counts * mask.unsqueeze(-1) * (weight.unsqueeze(-1) if weighted else 1)
        expected = error * w.unsqueeze(-1)
        if reduction != "none":
            expected = expected.sum() / (w.sum() * D_A if reduction == "mean" else 1)
        torch.testing.assert_close(loss(reduction).detach(), expected.detach().float())
    plain = loss("none", loss_mask_key=None, use_prioritized_weights=False)
    torch.testing.assert_close(plain, error)
    batch["collector", "mask"] = torch.zeros(3, 4, dtype=torch.bool)
    assert not loss("mean")  # nothing counts: 0, and not NaN
