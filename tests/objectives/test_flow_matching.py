"""Flow matching against the left column of Algorithm 1, written down with the same random numbers."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.paths import PolynomialInterpolant, TrigonometricInterpolant
from tests.states import copied, same
from tests.toy_env import mlp_actor, random_history
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    LinearInterpolant,
    Normalizer,
    PastPrior,
    PreviewPrior,
    Source,
    keys,
    window_replay_buffer,
)
from warmprior.history import history_keys

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
H, D_A, D_O = 3, 2, 5
HALF = torch.pi / 2


def sine(t):
    return torch.sin(HALF * t)


def cosine(t):
    return torch.cos(HALF * t)


COEFFICIENTS = {
    LinearInterpolant: lambda t: (1 - t, t, -1.0, 1.0),
    PolynomialInterpolant: lambda t: (1 - t**2, t**2, -2 * t, 2 * t),
    TrigonometricInterpolant: lambda t: (cosine(t), sine(t), -HALF * sine(t), HALF * cosine(t)),
}


def dataset(lengths=(9, 2, 14)):
    torch.manual_seed(0)
    n = sum(lengths)
    data = {"observation": torch.randn(n, D_O), "action": torch.randn(n, D_A)}
    data["episode"] = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return TensorDict(data, [n])


actor_for = partial(mlp_actor, observation_dim=D_O, hidden_dim=16)


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
    draws, frames = torch.Generator().manual_seed(2), batch["frame"].tolist()
    errors, counted = algorithm_one(data, frames, prior, actor.network, draws, COEFFICIENTS[interpolant])
    expected = {"none": errors * counted, "sum": errors[counted].sum(), "mean": errors[counted].mean()}
    gradients = torch.autograd.grad(expected["mean"], list(actor.network.parameters()))
    for reduction, value in expected.items():
        out = loss_of(actor, batch, interpolant=interpolant(), reduction=reduction)
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


def test_batch_shapes_and_whole_numbers_agree():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 2, 3)
    torch.testing.assert_close(loss_of(actor, data), loss_of(actor, data.reshape(6)))
    whole = data.copy().set(("vla_action", "chunk"), data["vla_action", "chunk"].round())
    numbers = whole.copy().set(("vla_action", "chunk"), whole["vla_action", "chunk"].long())
    assert torch.equal(loss_of(actor, whole), loss_of(actor, numbers))  # as chunks of one-hot actions


def test_the_loss_compiles_for_every_batch_size():
    prior = PastPrior(H, correlation=0.5)
    actor = actor_for(prior).replace(generator=None)
    loss = FlowMatchingLoss(actor, times="u-shaped")  # uniform ones are drawn first
    compiled = torch.compile(loss, backend="eager")
    for count in (3, 5, 7):
        data, found = sample(prior, count), []
        for module in (loss, compiled):
            torch.manual_seed(0)
            found.append(module(data)["loss_flow_matching"])
        torch.testing.assert_close(*found)


def test_no_pad_mask_counts_everything():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    none = data.clone()
    none["action_is_pad"] = torch.zeros(6, H, dtype=torch.bool)
    del data["action_is_pad"]
    assert torch.equal(loss_of(actor, data), loss_of(actor, none))


@pytest.mark.parametrize("entry", ["observation", ("vla_action", "chunk"), ("history", "actions")])
def test_what_a_mask_leaves_out_may_be_nan(entry):
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    kept = torch.arange(6) > 0
    gradients = []
    for batch in (data[1:], data.clone().set(("collector", "mask"), kept)):
        if len(batch) == 6:
            batch[entry][0] = float("nan")
        actor.zero_grad()
        noise = torch.Generator().manual_seed(0)
        # The same source and times for the windows that count.
        a0 = torch.randn(6, H, batch["vla_action", "chunk"].shape[-1], generator=noise)[-len(batch) :]

        def same(history, observation, a0=a0):
            loc = a0 + history["actions"][..., -H:, :].sum() * 0
            return Source(loc, torch.zeros(()), torch.ones_like(loc).bool())

        actor.prior.distribution = same
        times = torch.linspace(0, 1, 6)[-len(batch) :]
        loss = FlowMatchingLoss(actor, times=lambda *_, times=times: times)(batch)["loss_flow_matching"]
        loss.backward()
        gradients.append([p.grad.clone() for p in actor.parameters()])
    for one, two in zip(*gradients, strict=True):
        torch.testing.assert_close(one, two)


def test_a_padded_target_may_be_nan():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    data["action_is_pad"][:, -1] = True
    data["vla_action", "chunk"][:, -1] = float("nan")
    loss_of(actor, data).backward()
    assert all(p.grad.isfinite().all() for p in actor.parameters())


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_only_padding_is_zero_and_not_nan(reduction):
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 6)
    data["action_is_pad"] = torch.ones(6, H, dtype=torch.uint8)
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
    old = {"observation": "observation", "chunk": ("vla_action", "chunk"), "history": "history"}
    old["pad_mask"] = "action_is_pad"
    new = {name: ("deep", "er", name) if nested else f"my_{name}" for name in old}
    renamed = TensorDict({}, [6])
    for name in old:
        renamed[new[name]] = data[old[name]]
    loss = FlowMatchingLoss(actor, generator=torch.Generator().manual_seed(2))
    loss.set_keys(**new)
    history = history_keys(new.pop("history"))
    assert set(loss.in_keys) == {*new.values(), *history}
    assert torch.equal(loss(renamed)["loss_flow_matching"], expected)
    loss.generator.manual_seed(2)
    assert torch.equal(loss(*(renamed[key] for key in loss.in_keys)), expected)


def test_windows_that_do_not_fit():
    actor, data = actor_for(PastPrior(H)), sample(PastPrior(H), 6)
    for missing in (("vla_action", "chunk"), "history", "observation"):
        with raises(KeyError, f"missing: [{missing!r}]", "window_replay_buffer"):
            loss_of(actor, data.exclude(missing))
    with raises(KeyError, "missing: ['steps']", "ActionWindow"):
        loss_of(actor, data.exclude(("history", "steps")))
    for made_for in (PreviewPrior(H), PastPrior(H - 1)):
        other = sample(made_for, 6)
        with raises(ValueError, "('vla_action', 'chunk')", made_for.prediction_length, "PastPrior", H):
            loss_of(actor, other)
        with raises(ValueError, "PastPrior", 3):
            loss_of(actor, data.clone().set("history", other["history"]))


def test_ctrl_c_in_the_network_is_one():
    actor, data = actor_for(PastPrior(H)), sample(PastPrior(H), 4)
    loss, network = FlowMatchingLoss(actor), actor.network
    before = copied(network.state_dict())

    def interrupt(*args):
        raise KeyboardInterrupt

    hook = network.register_forward_pre_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        loss(data)
    hook.remove()
    assert loss(data)["loss_flow_matching"].isfinite()
    assert same(network.state_dict(), before)


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


def test_windows_in_raw_units_are_refused_where_the_policy_has_a_normaliser():
    """Also where a target is missing; normalised windows may reach a little past the range."""
    raw = dataset()
    raw["action"] = 500 * raw["action"]
    normalizer = Normalizer.fit(raw)
    loss = FlowMatchingLoss(actor_for(PastPrior(H), action_dim=D_A, normalizer=normalizer))
    windows = {
        name: window_replay_buffer(data, PastPrior(H), batch_size=25)[:]
        for name, data in (("raw", raw), ("normalised", normalizer.normalize(raw)))
    }
    refuses(lambda: loss(windows["raw"]), ValueError, "normalize(data)", "+-1")
    again = FlowMatchingLoss(loss.actor_network)
    windows["normalised"][keys.CHUNK] *= 1.5
    assert float(again(windows["normalised"])["loss_flow_matching"]) < 100
