"""The agent's networks and its residuals."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from warmprior import (
    BoxTanhNormal,
    GaussianPrior,
    PastPrior,
    PriorDecoder,
    ResidualSampler,
    StartPoint,
    VelocityMLP,
    WarmPriorActor,
    make_prior_space_actor,
    make_prior_space_critic,
)
from warmprior.rl.anchor import residual_sigma

stats = pytest.importorskip("scipy.stats")

P, D_A, D_O, TO = 3, 2, 5, 2


def batch(n):
    chunk = (n, P, D_A)
    return TensorDict(
        {
            "observation": torch.randn(n, TO, D_O),
            "prior": {"anchor": torch.randn(chunk), "delta": torch.rand(chunk) - 0.5},
            "vla_action": {"chunk": torch.randn(chunk)},
        },
        [n],
    )


def make_actor(prior, **options):
    return WarmPriorActor(VelocityMLP(D_A, D_O, P), prior, **options)


def make_decoder(prior, delta, **options):
    return PriorDecoder(make_actor(prior, **options), delta=delta)


@pytest.mark.parametrize("delta", [0.1, 1.0, 1.5])
def test_densities_in_units_of_the_box(delta):
    """Those of the squashed Gaussian on [-1, 1], for drawn values and for given ones."""
    torch.manual_seed(0)
    loc, scale = torch.randn(40, P, D_A), torch.rand(40, P, D_A) + 0.5
    box = BoxTanhNormal(loc, scale, low=-delta, high=delta, event_dims=2)
    for draw in (box.rsample_and_log_prob, box.sample_and_log_prob):
        value, log_prob = draw()
        assert value.abs().max() <= delta
        u = (value / delta).double().clamp(-1 + 1e-7, 1 - 1e-7).atanh()
        reference = stats.norm.logpdf(u.detach().numpy(), loc.double().numpy(), scale.double().numpy())
        reference = torch.as_tensor(reference) - torch.log(1 - u.tanh() ** 2)
        inside = (value.abs() < 0.999 * delta).all(-1).all(-1)
        assert inside.sum() > 10
        for found in (log_prob, box.log_prob(value)):
            torch.testing.assert_close(
                found.double()[inside], reference.sum((1, 2))[inside], rtol=1e-2, atol=1e-2
            )


@pytest.mark.parametrize("delta", [0.5, 1.5])
def test_actor_is_a_squashed_gaussian(delta):
    """Log-probability of tanh(u) scaled by delta, summed over the chunk, by change of variables."""
    actor = make_prior_space_actor(D_A, D_O, P, TO, delta=delta, hidden_dim=16)
    data = batch(50)
    with torch.no_grad():
        out = actor(data)
    loc, scale, value = out["delta_loc"], out["delta_scale"], out["prior", "delta"]
    assert value.shape == (50, P, D_A) and value.abs().max() <= delta
    u = (value / delta).double().atanh()
    reference = stats.norm.logpdf(u.numpy(), loc.double().numpy(), scale.double().numpy())
    reference = torch.as_tensor(reference) - torch.log(delta * (1 - u.tanh() ** 2))
    torch.testing.assert_close(
        out["prior", "delta_log_prob"].double(), reference.sum((1, 2)), rtol=1e-3, atol=1e-3
    )


def test_actor_network_by_hand():
    actor = make_prior_space_actor(D_A, D_O, P, TO, delta=0.5, hidden_dim=16, num_layers=2)
    linear = [m for m in actor.modules() if isinstance(m, nn.Linear)]
    assert len(linear) == 3 and sum(isinstance(m, nn.LayerNorm) for m in actor.modules()) == 2
    data = batch(4)
    x = torch.cat([data["observation"].flatten(1), data["prior", "anchor"].flatten(1)], 1)
    for layer in linear[:-1]:
        x = torch.tanh(nn.functional.layer_norm(layer(x), (16,)))
    with torch.no_grad():
        linear[-1].bias[-1] = 100.0  # a standard deviation far out of range
        linear[-1].bias[P * D_A] = -100.0
    loc, log_std = linear[-1](x).chunk(2, -1)
    out = actor(data)
    torch.testing.assert_close(out["delta_loc"], loc.view(4, P, D_A))
    expected = log_std.clamp(-20, 2).exp().view(4, P, D_A)
    torch.testing.assert_close(out["delta_scale"], expected)
    assert float(out["delta_scale"][0, -1, -1]) == pytest.approx(math.exp(2))


def test_which_inputs_count():
    data = batch(4)
    for in_keys in (["observation"], ["observation", ("vla_action", "chunk")]):
        critic = make_prior_space_critic(D_A, D_O, P, TO, in_keys=in_keys, hidden_dim=16)
        value = critic(data.clone())["state_action_value"]
        for key in ("observation", ("prior", "anchor"), ("vla_action", "chunk")):
            changed = data.clone().set(key, data[key] + 1)
            same = torch.equal(critic(changed)["state_action_value"], value)
            assert same == (key not in in_keys)
    quantiles = make_prior_space_critic(D_A, D_O, P, TO, out_features=25)
    assert quantiles(data)["state_action_value"].shape == (4, 25)


def test_critics_see_residuals_in_units_of_the_box():
    data = batch(4)
    torch.manual_seed(0)
    small = make_prior_space_critic(D_A, D_O, P, TO, delta=0.5)
    torch.manual_seed(0)
    large = make_prior_space_critic(D_A, D_O, P, TO, delta=1.5)
    value = small(data.clone())["state_action_value"]
    data["prior", "delta"] = 3 * data["prior", "delta"]
    torch.testing.assert_close(large(data)["state_action_value"], value)


@pytest.mark.parametrize("make", [make_prior_space_actor, make_prior_space_critic])
def test_bad_sizes(make):
    with pytest.raises(ValueError, match="delta must be a finite number > 0"):
        make(D_A, D_O, P, delta=0.0)
    with pytest.raises(ValueError, match="hidden_dim must be at least 1"):
        make(D_A, D_O, P, delta=1.0, hidden_dim=0)
    with pytest.raises(ValueError, match="in_keys is empty"):
        make(D_A, D_O, P, delta=1.0, in_keys=[])
    network = make(D_A, D_O, P, TO, delta=1.0)
    data = batch(4)
    data["observation"] = torch.randn(4, TO, D_O + 1)
    with pytest.raises(ValueError, match=r"built for .* inputs, got the shapes \[\(4, 2, 6\)"):
        network(data)


@pytest.mark.parametrize(
    ("prior", "delta", "options", "distribution"),
    [
        (GaussianPrior(P), 1.5, {}, stats.norm()),
        (PastPrior(P), 0.5, {"distribution": "normal"}, stats.norm(scale=0.5)),
        (PastPrior(P), 0.5, {"distribution": "uniform"}, stats.uniform(-0.5, 1.0)),
        (PastPrior(P), 0.5, {"distribution": "normal", "sigma": 2.0}, stats.norm(scale=2.0)),
    ],
)
def test_distributions(prior, delta, options, distribution):
    generator = torch.Generator().manual_seed(0)
    sampler = ResidualSampler(make_decoder(prior, delta), generator=generator, **options)
    data = TensorDict({"prior": {"anchor": torch.zeros(3000, P, D_A)}}, [3000])
    draws = sampler(data)["prior", "delta"]
    assert draws.shape == (3000, P, D_A)
    assert stats.kstest(draws.flatten().numpy(), distribution.cdf).pvalue > 1e-3


def test_clipped_is_the_default_around_a_mean():
    sampler = ResidualSampler(
        make_decoder(PastPrior(P, sigma=1.0), 0.5), generator=torch.Generator().manual_seed(0)
    )
    draws = sampler(TensorDict({"prior": {"anchor": torch.zeros(3000, P, D_A)}}, [3000]))
    draws = draws["prior", "delta"].flatten()
    at_the_edge = (draws.abs() == 0.5).float().mean()
    assert float(at_the_edge) == pytest.approx(2 * stats.norm.cdf(-0.5), abs=0.02)
    inside = draws[draws.abs() < 0.5].numpy()
    assert stats.kstest(inside, stats.truncnorm(-0.5, 0.5).cdf).pvalue > 1e-3


class Halved(StartPoint):
    """Half-way from noise to a quarter."""

    name = "halved-of-the-residuals"
    time = 0.5
    noise_share = 0.4

    def centre(self, history, observation):
        return torch.full_like(history["forecast"], 0.25)

    def forward(self, noise, history, observation):
        return self.centre(history, observation) + self.noise_share * noise


def test_residuals_are_as_large_as_the_source_deviates_from_the_anchor():
    cases = (
        (PastPrior(P, sigma=0.3), None, 0.3),
        (PastPrior(P, sigma=0.3), Halved(), 0.4),
        (GaussianPrior(P), Halved(), 0.4),
    )
    for prior, start, sigma in cases:
        sampler = ResidualSampler(make_decoder(prior, 0.5, start=start))
        assert sampler.sigma == pytest.approx(sigma) and sampler.distribution == "clipped"


def test_around_zero_residuals_are_standard_normal_whatever_the_noise_of_the_source():
    """Of sources without a mean, ``sigma`` is not the width."""

    class Cold(PastPrior):
        name = "cold-of-the-residuals"

        def mean(self, history):
            loc, warm = super().mean(history)
            return loc, torch.zeros_like(warm)

    for prior in (GaussianPrior(P), Cold(P, sigma=0.1)):
        actor = make_actor(prior)
        sampler = ResidualSampler(PriorDecoder(actor, delta=1.5))
        assert residual_sigma(actor) == sampler.sigma == 1.0 and sampler.distribution == "normal"


def test_sampler_options():
    decoder = make_decoder(PastPrior(P), 0.5)
    with pytest.raises(ValueError, match="must be 'normal', 'clipped' or 'uniform'"):
        ResidualSampler(decoder, distribution="laplace")
    with pytest.raises(ValueError, match="sigma must be a finite number > 0"):
        ResidualSampler(make_decoder(PastPrior(P, sigma=0.0), 0.5), distribution="clipped")
    # Without noise of the prior's own, the box is all there is.
    assert ResidualSampler(make_decoder(PastPrior(P, sigma=0.0), 0.5)).distribution == "uniform"
    with pytest.raises(KeyError, match="PriorAnchor writes it"):
        ResidualSampler(decoder)(TensorDict({}, [2]))
