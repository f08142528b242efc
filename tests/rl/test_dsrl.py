"""DSRL-NA against equations written by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.modules import TanhNormal

from tests.errors import raises
from tests.rl.dsrl_parts import GAMMA, H, N, batch, build
from warmprior import (
    BoxTanhNormal,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    PriorDecoder,
    ResidualSampler,
    WarmPriorActor,
    keys,
)


def networks(loss):
    def of(name, params):
        out = []
        for i in range(len(params)):
            net = loss.get_stateful_net(name)
            params[i].to_module(net)
            out.append(net)
        return out

    return (
        loss.get_stateful_net("actor_network"),
        of("qvalue_network", loss.qvalue_network_params.data),
        of("qvalue_network", loss.target_qvalue_network_params.data),
        of("noise_qvalue_network", loss.noise_qvalue_network_params.data),
    )


def value(critic, **inputs):
    data = TensorDict({}, [N])
    for key, tensor in inputs.items():
        data.set(getattr(keys, key), tensor)
    return critic(data)["state_action_value"].squeeze(-1)


def decode(loss, observation, noise):
    a = noise
    for i in range(2):
        t = torch.full(a.shape[:1], i / 2)
        a = a + loss.decoder.ode.network(t, a, observation) / 2
    return a


def squashed(actor, state, delta):
    """Draw tanh(loc + scale * eps) * delta; its log-probability before the scaling."""
    out = actor.get_dist_params(state)
    loc, scale = out["delta_loc"], out["delta_scale"]
    u = torch.distributions.Normal(loc, scale).rsample()
    log_prob = torch.distributions.Normal(loc, scale).log_prob(u)
    log_prob = log_prob - 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
    return delta * u.tanh(), log_prob.sum((-1, -2))


@pytest.mark.parametrize("prior_class", [PastPrior, PreviewPrior])
@pytest.mark.parametrize(
    ("options", "delta"),
    [
        ({}, 0.5),
        ({}, 1.5),
        ({"critics": 3}, 0.5),
        ({"backup_entropy": False}, 0.5),
        ({"discount": "decision"}, 0.5),
        ({"alpha_init": 0.3, "target_entropy": -2.0}, 0.5),
    ],
)
def test_losses_by_hand(prior_class, options, delta):
    prior = prior_class(H)
    loss = build(prior, delta, **options)
    with torch.no_grad():  # targets that differ from the critics, as in training
        for parameter in loss.target_qvalue_network_params.values(True, True):
            parameter.mul_(0.7)
    data = batch(prior)
    actor, q, q_target, q_noise = networks(loss)
    alpha, entropy = options.get("alpha_init", 1.0), options.get("target_entropy", 0.0)

    torch.manual_seed(5)
    after = data["next"]
    with torch.no_grad():
        residual, log_prob = squashed(actor, after, delta)
        chunk = decode(loss, after["observation"], after["prior", "anchor"] + residual)
        v = torch.stack([value(c, OBSERVATION=after["observation"], CHUNK=chunk) for c in q_target]).amin(0)
        if options.get("backup_entropy", True):
            v = v - alpha * log_prob
        k = after["executed_steps"][:, 0] if options.get("discount") != "decision" else 1
        y = after["reward"][:, 0] + GAMMA**k * ~after["done"][:, 0] * v
        errors = [value(c, OBSERVATION=data["observation"], CHUNK=data["vla_action", "chunk"]) - y for c in q]
        loss_q = sum(0.5 * e.square().mean() for e in errors)
        residual, log_prob = squashed(actor, data, delta)
        inputs = {"OBSERVATION": data["observation"], "ANCHOR": data["prior", "anchor"]}
        v = torch.stack([value(c, **inputs, DELTA=residual) for c in q_noise]).amin(0)
        loss_actor = (alpha * log_prob - v).mean()
        loss_alpha = (-math.log(alpha) * (log_prob + entropy)).mean()

    torch.manual_seed(5)
    original = data.clone()
    out = loss.reinforcement_loss(data)
    expected = {"qvalue": loss_q, "actor": loss_actor, "alpha": loss_alpha}
    for name, value_ in expected.items():
        torch.testing.assert_close(out[f"loss_{name}"], value_, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(out["entropy"], -log_prob.mean(), rtol=1e-4, atol=1e-4)
    td_error = torch.stack(errors).abs().amax(0)
    torch.testing.assert_close(data["td_error"], td_error, rtol=1e-4, atol=1e-4)
    assert (data.exclude("td_error") == original).all()
    assert not out["entropy"].requires_grad and not out["td_error"].requires_grad


def test_the_state_after_an_end_may_be_nan():
    """Some simulators that restart rows write that."""
    loss, data = build(), batch()
    blank = data.clone()
    for key in ("observation", ("prior", "anchor")):
        blank["next", key][data["next", "done"].squeeze(-1)] = math.nan
    losses = []
    for one in (data, blank):
        torch.manual_seed(5)
        losses.append(loss(one)["loss_qvalue"])
    torch.testing.assert_close(*losses)


def test_padded_rows_count_nowhere():
    """As `split_trajectories` pads: such rows have a False mask, and any values."""
    loss, data = build(), batch()
    data["collector", "mask"] = torch.arange(N) % 2 == 0
    other = data.clone()
    other["next", "reward"][1::2] = 1e3
    results = []
    for one in (data, other):
        torch.manual_seed(5)
        results.append(loss(one))
    assert (results[0] == results[1]).all()
    torch.testing.assert_close(results[0]["td_error"], data["td_error"][::2].mean())


def test_an_actor_of_torchrls_own_distribution_is_measured_in_units_of_the_box():
    results = []
    for kind in (BoxTanhNormal, TanhNormal):
        loss = build(delta=1.5)
        loss.actor_network[-1].distribution_class = kind
        torch.manual_seed(5)
        results.append(loss(batch()))
    torch.testing.assert_close(*results)


def test_a_log_probability_per_action_is_refused():
    loss = build()
    loss.actor_network[-1].distribution_kwargs["event_dims"] = 1
    with raises(ValueError, f"({N}, {H})", f"({N},)", "event_dims=2"):
        loss(batch())


@pytest.mark.parametrize("discount", ["step", "decision"])
def test_decisions_that_multistep_joins_are_refused(discount):
    """TorchRL's transform keeps the first decision's end and executed steps."""
    joined = batch().set("steps_to_next_obs", torch.full((N, 1), 3))
    with raises(ValueError, "MultiStep"):
        build(discount=discount)(joined)
    build(discount=discount)(joined.set("steps_to_next_obs", torch.ones(N, 1)))
    # TorchRL's own losses need a copy of the executed steps under this name, in the same buffer.
    build(discount=discount)(joined.set("steps_to_next_obs", joined["next", "executed_steps"].clone()))


@pytest.mark.parametrize("prior", [GaussianPrior(H), PastPrior(H), PastPrior(H, sigma=0.0)])
def test_distillation_by_hand(prior):
    """Head by head, online action critics at decoded draws; the gradient is the noise critics' alone."""
    loss = build(prior)
    loss.distillation.generator = torch.Generator().manual_seed(2)
    data = batch()
    _, q, _, q_noise = networks(loss)
    sampler = ResidualSampler(loss.decoder, generator=torch.Generator().manual_seed(2))
    delta = sampler(data.clone())["prior", "delta"]
    chunk = decode(loss, data["observation"], data["prior", "anchor"] + delta)
    inputs = {"OBSERVATION": data["observation"], "ANCHOR": data["prior", "anchor"]}
    for critic in q_noise:
        critic.requires_grad_(True)
    expected = torch.zeros(())
    for critic, noise_critic in zip(q, q_noise, strict=True):
        with torch.no_grad():
            target = value(critic, OBSERVATION=data["observation"], CHUNK=chunk)
        expected = expected + 0.5 * (value(noise_critic, **inputs, DELTA=delta) - target).square().mean()
    expected.backward()
    original = data.clone()
    out = loss.distillation_loss(data)
    assert (data == original).all() and set(data.keys(True)) == set(original.keys(True))
    torch.testing.assert_close(out["loss_qvalue_noise"], expected.detach(), rtol=1e-4, atol=1e-5)
    out["loss_qvalue_noise"].backward()
    named = dict(loss.named_parameters())
    for i, critic in enumerate(q_noise):
        for name, p in critic.named_parameters():
            ours = named["noise_qvalue_network_params." + name].grad[i]
            torch.testing.assert_close(ours, p.grad, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "reached"),
    [
        ("loss_actor", "actor_network"),
        ("loss_qvalue", "qvalue_network"),
        ("loss_alpha", "log_alpha"),
        ("loss_qvalue_noise", "noise_qvalue_network"),
    ],
)
def test_each_loss_trains_its_own_network(name, reached):
    loss = build()
    loss(batch())[name].backward()
    with_gradient = {n for n, p in loss.named_parameters() if p.grad is not None}
    assert with_gradient == {n for n, _ in loss.named_parameters() if n.startswith(reached)}
    assert with_gradient


@pytest.mark.slow
def test_training_reaches_a_known_optimum():
    """The policy stands still, so the best residual is known: the agent must come near it."""

    class Still(nn.Module):
        def forward(self, t, a, observation):
            return torch.zeros_like(a)

    decoder = PriorDecoder(WarmPriorActor(Still(), PastPrior(H), nfe=1), delta=0.5)
    loss = build(decoder=decoder, hidden_dim=64, alpha_init=0.3)
    loss.log_alpha.requires_grad_(False)
    states = batch()[:1].expand(256).clone()
    states["next", "done"] = torch.ones(256, 1, dtype=torch.bool)
    best = torch.tensor([[0.3, -0.2], [0.0, 0.4]])
    goal = states["prior", "anchor"] + best
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    everywhere = loss.distillation = ResidualSampler(decoder, distribution="uniform")
    sampler = TensorDictSequential(everywhere, decoder)
    torch.manual_seed(0)
    for _ in range(300):
        data = sampler(states.clone())
        error = (data["vla_action", "chunk"] - goal).square().sum((-1, -2))
        data["next", "reward"] = -10 * error.unsqueeze(-1)
        losses = loss(data)
        optimizer.zero_grad()
        sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        optimizer.step()
    with torch.no_grad():
        parameters = loss.get_stateful_net("actor_network").get_dist_params(states[:1])
    found = 0.5 * parameters["delta_loc"][0].tanh()
    assert float((found - best).abs().max()) < 0.2
    assert float((found - best).abs().mean()) < 0.12 < 0.22 < float(best.abs().mean())


def test_losses_are_0_if_no_row_has_weight():
    out = build()(batch().set("priority_weight", torch.zeros(N)))
    assert all(value == 0 for name, value in out.items() if name.startswith("loss_"))


def test_schedule():
    loss = build(noise_critic_steps=3)
    names = [compute.__name__ for compute in loss.schedule(updates=2)]
    assert names == ["reinforcement_loss"] * 2 + ["distillation_loss"] * 3
    assert [c.__name__ for c in build().schedule(20)].count("distillation_loss") == 10
    with raises(ValueError, "updates"):
        loss.schedule(0)
