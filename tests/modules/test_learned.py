"""Sources that learn before the flow: what they learn, on data whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from warmprior import (
    A2APrior,
    CVAEPrior,
    ForecastPrior,
    GaussianPrior,
    LeapPrior,
    LearnedPrior,
    LearningWindows,
    PriorSampler,
    StepPrior,
    VelocityMLP,
    WarmPriorActor,
    integrate,
    window_transforms,
)
from warmprior.modules import Prior
from warmprior.training import learn_prior

H, D_A, D_O = 2, 1, 2
LEARNED = (ForecastPrior, LeapPrior, A2APrior, CVAEPrior, StepPrior)
NOISE = 0.3


def demonstrations(episodes=60, steps=40, seed=0):
    """``a[i] = o[i, 0] + noise``, with one observation per half episode; the second entry tells nothing."""
    generator = torch.Generator().manual_seed(seed)
    level = torch.rand(episodes, 2, generator=generator).repeat_interleave(steps // 2, 1) - 0.5
    noise = NOISE * torch.randn(episodes, steps, generator=generator)
    other = torch.rand(episodes, steps, generator=generator)
    data = {
        "observation": torch.stack([level, other], -1).flatten(0, 1),
        "action": (level + noise).flatten()[:, None],
        "episode": torch.arange(episodes).repeat_interleave(steps),
    }
    return TensorDict(data, [episodes * steps])


def learned(kind, data, iterations=400, **options):
    prior = kind(H, hidden_dim=32, **options).sized(D_A, D_O, 1)
    learn_prior(
        prior,
        data,
        iterations=iterations,
        observation_steps=1,
        learning_rate=1e-2,
    )
    return prior


def windows(prior, data, frames):
    return window_transforms(data, prior, observation_steps=1)(
        TensorDict({"frame": frames}, [len(frames)])
    )


@pytest.fixture(scope="module")
def data():
    return demonstrations()


@pytest.fixture(scope="module")
def unseen():
    return demonstrations(seed=1)


# The middle of each half: the chunk and the history lie in it as well.
MIDDLES = torch.tensor([e * 40 + i for e in range(60) for i in (8, 28)])


def distribution(prior, batch):
    return prior.distribution(batch["prior", "loc"], batch["prior", "warm"], batch["observation"])


@pytest.mark.parametrize("kind", [ForecastPrior, LeapPrior])
def test_a_gaussian_source_learns_mean_and_spread(kind, data, unseen):
    prior = learned(kind, data)
    batch = windows(prior, unseen, MIDDLES)
    mean, scale = distribution(prior, batch)
    level = batch["observation"][:, 0, :1, None].expand_as(mean)
    assert float((mean - level).square().mean().sqrt()) < 0.08
    assert float(scale.mean()) == pytest.approx(NOISE, rel=0.1)


def test_the_calibration_makes_errors_as_large_as_they_are_said_to_be():
    """Per position and dimension, and without what lies past the end of an episode."""
    prior = ForecastPrior(H, hidden_dim=8).sized(3, D_O, 1)
    g = torch.Generator().manual_seed(0)
    loc, warm = torch.rand(500, H, 3, generator=g), torch.ones(500, H, 1, dtype=torch.bool)
    seen = torch.rand(500, 1, D_O, generator=g)
    factor = torch.tensor([[0.2, 1.0, 5.0], [3.0, 0.5, 2.0]])
    mean, scale = prior.distribution(loc, warm, seen)
    a1 = mean + factor * scale * torch.randn(500, H, 3, generator=g)
    counted = torch.rand(500, H, 1, generator=g) < 0.7
    a1 = a1.masked_fill(~counted, 100.0)
    prior.calibrate(LearningWindows(a1, counted, loc, warm, seen))
    same, calibrated = prior.distribution(loc, warm, seen)
    assert torch.equal(same, mean)
    torch.testing.assert_close(calibrated / scale, factor.expand_as(scale), rtol=0.1, atol=0)
    squared = ((a1 - mean) / calibrated).square().masked_fill(~counted, 0.0).sum(0)
    torch.testing.assert_close(squared / counted.sum(0), torch.ones(H, 3))
    narrow = ForecastPrior.from_config(prior.config() | {"sigma": 0.5})
    narrow.load_state_dict(prior.state_dict())
    torch.testing.assert_close(narrow.distribution(loc, warm, seen)[1], 0.5 * calibrated)


def test_no_calibrated_scale_is_below_the_smallest():
    """And its typical value is what residuals in its source space are drawn with."""
    prior = ForecastPrior(H, hidden_dim=8, sigma=0.5).sized(D_A, D_O, 1)
    loc, warm = torch.rand(50, H, D_A), torch.ones(50, H, 1, dtype=torch.bool)
    seen, counted = torch.rand(50, 1, D_O), torch.rand(50, H, 1) < 0.7
    mean, _ = prior.distribution(loc, warm, seen)
    prior.calibrate(LearningWindows(mean, counted, loc, warm, seen))  # without any error
    torch.testing.assert_close(prior.distribution(loc, warm, seen)[1], torch.full_like(mean, 0.01))
    assert prior.residual_sigma == pytest.approx(0.01)
    a1 = mean + 0.3 * torch.randn(mean.shape)
    prior.calibrate(LearningWindows(a1, counted, loc, warm, seen))
    scale = prior.distribution(loc, warm, seen)[1][counted]
    assert prior.residual_sigma == pytest.approx(float(scale.square().mean().sqrt()))
    again = ForecastPrior.from_config(prior.config())
    again.load_state_dict(prior.state_dict())
    assert again.residual_sigma == prior.residual_sigma
    with pytest.raises(ValueError, match="no networks yet"):
        ForecastPrior(H).residual_sigma  # noqa: B018


def test_the_loss_of_a_cvae_is_its_equation():
    prior = CVAEPrior(H, hidden_dim=8, latent_dim=3, beta=0.7).sized(D_A, D_O, 1)
    g = torch.Generator().manual_seed(0)
    a1, seen = torch.randn(5, H, D_A, generator=g), torch.randn(5, 1, D_O, generator=g)
    counted, loc = torch.ones(5, H, 1, dtype=torch.bool), torch.zeros(5, H, D_A)
    windows = LearningWindows(a1, counted, loc, counted, seen)
    found = prior.learning_loss(windows, torch.Generator().manual_seed(1))
    code = prior.encoder(torch.cat([seen.flatten(1), a1.flatten(1)], -1))
    mean, deviation = code[:, :3], (0.5 * code[:, 3:]).exp()
    z = mean + deviation * torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
    error = a1.flatten(1) - prior.decoder(torch.cat([seen.flatten(1), z], -1))
    q, standard = torch.distributions.Normal(mean, deviation), torch.distributions.Normal(0.0, 1.0)
    divergence = torch.distributions.kl_divergence(q, standard).sum(-1)
    length = H * D_A
    expected = error.square().sum(-1) / length + 0.7 * 3 / length * divergence
    torch.testing.assert_close(found, expected.mean())


def test_only_what_a_source_sees_changes_it(data):
    batch = windows(GaussianPrior(H), data, MIDDLES)
    batch["prior", "loc"] = torch.full_like(batch["prior", "loc"], 0.5)
    batch["prior", "warm"].fill_(True)
    for kind, changed in (
        (ForecastPrior, {"loc", "observation"}),
        (LeapPrior, {"observation"}),
        (A2APrior, {"loc"}),
    ):
        prior = learned(kind, data, iterations=5)
        before = distribution(prior, batch)[0]
        for name, key in (("loc", ("prior", "loc")), ("observation", "observation")):
            other = batch.clone()
            other[key] += 1.0
            assert bool((distribution(prior, other)[0] != before).any()) == (name in changed)
        cold = batch.clone()
        cold["prior", "warm"].fill_(False)
        unknown = cold.clone()
        unknown["prior", "loc"] += 7.0  # of a cold window it must not matter
        assert torch.equal(distribution(prior, cold)[0], distribution(prior, unknown)[0])


def test_a2a_is_a_deterministic_forecast_of_the_last_actions(data, unseen):
    prior = learned(A2APrior, data, iterations=800)
    batch = windows(prior, unseen, MIDDLES)
    loc, warm = batch["prior", "loc"], batch["prior", "warm"]
    source = prior.sample(loc, warm, observation=batch["observation"])
    assert torch.equal(source, distribution(prior, batch)[0])
    # Linear regression of the level (variance 1/12) on the mean of the last H actions.
    gain = (1 / 12) / (1 / 12 + NOISE**2 / H)
    best = gain * loc.mean(-2, keepdim=True)
    assert float((source - best).square().mean().sqrt()) < 0.06


def test_a_cvae_draws_what_the_data_hold(unseen):
    """Two modes at one observation: the decoder's draws have both, and nothing between."""
    generator = torch.Generator().manual_seed(0)
    side = torch.randint(2, (200,), generator=generator).repeat_interleave(10).double().float()
    data = TensorDict(
        {
            "observation": torch.zeros(2000, D_O),
            "action": (2 * side - 1)[:, None] * 0.8,
            "episode": torch.arange(200).repeat_interleave(10),
        },
        [2000],
    )
    prior = learned(CVAEPrior, data, iterations=800, sigma=0.0, latent_dim=2)
    loc, warm = torch.zeros(500, H, 1), torch.zeros(500, H, 1, dtype=torch.bool)
    drawn = prior.sample(loc, warm, generator, torch.zeros(500, 1, D_O))[:, 0, 0]
    near = [(drawn - mode).abs() < 0.25 for mode in (-0.8, 0.8)]
    assert all(0.25 < float(n.float().mean()) < 0.75 for n in near)
    assert float((near[0] | near[1]).float().mean()) > 0.75


class TestStep:
    """STEP's start, against its equation; its flow is that of the standard normal source."""

    def prior(self, **options):
        prior = StepPrior(H, hidden_dim=8, **options).sized(D_A, D_O, 1)
        prior.forecast = lambda loc, warm, observation: torch.full_like(loc, 0.4)
        return prior

    def test_the_start_is_on_the_path_to_the_forecast(self):
        prior = self.prior(start_time=0.75, stall=0.0)
        loc, warm = torch.zeros(5000, H, D_A), torch.ones(5000, H, 1, dtype=torch.bool)
        start = prior.start(loc, warm, torch.Generator().manual_seed(0), torch.zeros(5000, 1, D_O))
        assert float(start.mean()) == pytest.approx(0.3, abs=0.02)
        assert float(start.std()) == pytest.approx(0.25, rel=0.03)
        source = prior.sample(loc, warm, torch.Generator().manual_seed(0))
        assert torch.allclose(start, 0.25 * source + 0.3)
        anchor = prior.anchor(loc, warm, torch.zeros(5000, 1, D_O))
        torch.testing.assert_close(start, anchor + prior.residual_sigma * source)
        assert prior.moves_source
        assert float(source.std()) == pytest.approx(1.0, rel=0.03)

    def test_a_robot_that_stays_meets_more_noise(self):
        prior = self.prior(start_time=0.5, stall=0.1, stall_noise=0.5)
        loc = torch.tensor([0.4, 0.0, 0.4])[:, None, None].expand(3, H, D_A)
        warm = torch.tensor([True, True, False])[:, None, None].expand(3, H, 1)
        generator = torch.Generator().manual_seed(0)
        start = prior.start(loc, warm, generator, torch.zeros(3, 1, D_O))
        eps = torch.randn(3, H, D_A, generator=torch.Generator().manual_seed(0))
        factor = torch.tensor([1.5, 1.0, 1.0])[:, None, None]
        torch.testing.assert_close(start, 0.5 * factor * eps + 0.2)

    def test_an_actor_integrates_from_there(self):
        prior = self.prior(start_time=0.5)
        actor = WarmPriorActor(VelocityMLP(D_A, D_O, H, 1, hidden_dim=8), prior, nfe=2)
        assert actor.ode.start_time == actor.replace(nfe=1).ode.start_time == 0.5
        data = TensorDict(
            {
                "observation": torch.rand(3, 1, D_O),
                "prior": {
                    "loc": torch.rand(3, H, D_A),
                    "warm": torch.ones(3, H, 1, dtype=torch.bool),
                },
            },
            [3],
        )
        out = actor(data, generator=torch.Generator().manual_seed(0))
        a = out["prior", "noise"]
        for t in (0.5, 0.75):
            a = a + 0.25 * actor.network(torch.full((3,), t), a, data["observation"])
        torch.testing.assert_close(out["vla_action", "chunk"], a)
        with pytest.raises(ValueError, match="start_time"):
            integrate(lambda t, a: a, a, nfe=1, start_time=1.0)

    @pytest.mark.parametrize(
        "options",
        [{"start_time": 1.0}, {"start_time": True}, {"stall": -1.0}, {"stall_noise": math.inf}],
    )
    def test_options_out_of_range(self, options):
        with pytest.raises(ValueError, match=next(iter(options))):
            StepPrior(H, **options)


@pytest.mark.parametrize("kind", LEARNED)
def test_configurations_build_the_same_prior(kind, data):
    made = Prior.make(kind.name, H)
    assert made.config()["action_dim"] is None and made.config()["hidden_dim"] == 256
    assert Prior.make(f"{kind.name},hidden_dim=256", H).config() == made.config()
    prior = learned(kind, data, iterations=2)
    again = Prior.from_config(prior.config())
    assert again.config() == prior.config() and not prior.is_gaussian
    again.load_state_dict(prior.state_dict())
    loc, warm = torch.rand(3, H, D_A), torch.ones(3, H, 1, dtype=torch.bool)
    seen = torch.rand(3, 1, D_O)
    starts = [p.start(loc, warm, torch.Generator().manual_seed(1), seen) for p in (prior, again)]
    assert torch.equal(*starts)
    assert prior.sized(D_A, D_O, 1) is prior
    assert not any(p.requires_grad for p in again.parameters())


@pytest.mark.parametrize("kind", LEARNED)
def test_cold_probability_is_taken_where_withholding_the_mean_changes_the_source(kind):
    prior = kind(H, hidden_dim=8).sized(D_A, D_O, 1)
    loc, warm = torch.rand(3, H, D_A), torch.ones(3, H, 1, dtype=torch.bool)
    seen = torch.rand(3, 1, D_O)
    drawn = [
        prior.sample(loc, w, torch.Generator().manual_seed(1), seen)
        for w in (warm, torch.zeros_like(warm))
    ]
    assert kind.takes("cold_probability") != torch.equal(*drawn)


@pytest.mark.parametrize("kind", [LeapPrior, CVAEPrior])
def test_a_share_without_effect_beside_the_name_is_left_out_but_files_may_hold_one(kind):
    """As of the Gaussian source; what was saved is still what it was."""
    plain = kind(H).config()
    assert Prior.make(kind.name, H, cold_probability=0.3).config() == plain
    for share in (0.0, 0.3):
        saved = plain | {"cold_probability": share}
        assert Prior.from_config(saved).config() == saved


def test_the_same_seed_learns_the_same_and_leaves_other_draws_alone(data):
    torch.manual_seed(3)
    first = learned(ForecastPrior, data, iterations=5)
    after = torch.rand(1)
    second = learned(ForecastPrior, data, iterations=5)
    assert all(
        torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True)
    )
    torch.manual_seed(3)
    ForecastPrior(H, hidden_dim=32).sized(D_A, D_O, 1)  # its initial weights are drawn
    assert torch.equal(torch.rand(1), after)


def test_a_sampler_hands_on_the_observation(data):
    prior = learned(ForecastPrior, data, iterations=2)
    batch = windows(prior, data, MIDDLES)
    with pytest.raises(ValueError, match="observation_key"):
        PriorSampler(prior)(batch)
    out = PriorSampler(prior, observation_key="observation")(
        batch, generator=torch.Generator().manual_seed(0)
    )
    mean, scale = distribution(prior, batch)
    eps = torch.randn(mean.shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(out["prior", "noise"], mean + scale * eps)


def test_bad_input_is_named(data):
    with pytest.raises(ValueError, match="needs action_dim"):
        ForecastPrior(H, action_dim=1)
    with pytest.raises(ValueError, match="at least 1"):
        ForecastPrior(H, action_dim=0, observation_dim=1, observation_steps=1)
    with pytest.raises(ValueError, match=r"no networks yet.*sized"):
        ForecastPrior(H).distribution(torch.zeros(1, H, 1), torch.zeros(1, H, 1).bool())
    with pytest.raises(ValueError, match="was built for"):
        ForecastPrior(H).sized(1, 2, 1).sized(1, 3, 1)
    for latent_dim in (0, 2.5):
        with pytest.raises(ValueError, match="latent_dim"):
            CVAEPrior(H, latent_dim=latent_dim)
    for beta in (0.0, math.inf, "abc"):
        with pytest.raises(ValueError, match="beta"):
            CVAEPrior(H, beta=beta)
    for hidden_dim in (0, 1.5, True):
        with pytest.raises(ValueError, match="hidden_dim"):
            LeapPrior(H, hidden_dim=hidden_dim)
    with pytest.raises(ValueError, match="observation_steps"):
        LeapPrior(H, action_dim=1, observation_dim=1, observation_steps=1.5)
    nested = TensorDict({"pose": torch.zeros(1, 1, D_O)}, [1])
    with pytest.raises(ValueError, match=r"forecast takes one tensor.*nested"):
        ForecastPrior(H).sized(D_A, D_O, 1).distribution(
            torch.zeros(1, H, D_A), torch.zeros(1, H, 1).bool(), nested
        )
    with pytest.raises(ValueError, match="no networks yet"):
        learn_prior(ForecastPrior(H), data, iterations=1, observation_steps=1)
    prior = ForecastPrior(H).sized(D_A, D_O, 1)
    for options in ({"iterations": 0}, {"iterations": 1, "held_out": 1.0}):
        with pytest.raises(ValueError, match="iterations >= 1"):
            learn_prior(prior, data, observation_steps=1, **options)
    broken = data.clone()
    broken["action"][5] = math.nan
    with pytest.raises((ValueError, FloatingPointError), match="NaN"):
        learn_prior(prior, broken, iterations=20, observation_steps=1)


def test_a_base_without_networks_cannot_learn():
    class Empty(LearnedPrior):
        name = "empty-learned"

    with pytest.raises(NotImplementedError):
        Empty(H).sized(1, 1, 1)
