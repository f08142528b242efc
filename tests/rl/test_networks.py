import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.errors import raises
from tests.toy_env import Halfway, mlp_actor
from warmprior import BoxTanhNormal, GaussianPrior, PastPrior, PriorDecoder, ResidualSampler
from warmprior.rl import make_prior_space_actor, make_prior_space_critic

stats = pytest.importorskip("scipy.stats")

P, D_A = 3, 2


def make_decoder(prior, delta, **options):
    return PriorDecoder(mlp_actor(prior, **options), delta=delta)


def residuals_of(prior, delta, **options):
    generator = torch.Generator().manual_seed(0)
    sampler = ResidualSampler(make_decoder(prior, delta), generator=generator, **options)
    data = TensorDict({"prior": {"anchor": torch.zeros(3000, P, D_A)}}, [3000])
    return sampler(data)["prior", "delta"]


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


@pytest.mark.parametrize(
    ("prior", "delta", "options", "distribution"),
    [
        (GaussianPrior(P), 1.5, {}, stats.norm()),
        (PastPrior(P), 0.5, {"distribution": "normal"}, stats.norm(scale=0.5)),
        (PastPrior(P), 0.5, {"distribution": "uniform"}, stats.uniform(-0.5, 1.0)),
        (PastPrior(P, sigma=2.0), 0.5, {"distribution": "normal"}, stats.norm(scale=2.0)),
    ],
)
def test_distributions(prior, delta, options, distribution):
    draws = residuals_of(prior, delta, **options)
    assert draws.shape == (3000, P, D_A)
    assert stats.kstest(draws.flatten().numpy(), distribution.cdf).pvalue > 1e-3


def test_clipped_is_the_default_around_a_mean():
    draws = residuals_of(PastPrior(P, sigma=1.0), 0.5).flatten()
    at_the_edge = (draws.abs() == 0.5).float().mean()
    assert float(at_the_edge) == pytest.approx(2 * stats.norm.cdf(-0.5), abs=0.02)
    inside = draws[draws.abs() < 0.5].numpy()
    assert stats.kstest(inside, stats.truncnorm(-0.5, 0.5).cdf).pvalue > 1e-3


def test_residuals_are_as_large_as_the_source_deviates_from_the_anchor():
    cases = (
        (PastPrior(P, sigma=0.3), None, 0.3),
        (PastPrior(P, sigma=0.3), Halfway(), 0.5),
        (GaussianPrior(P), Halfway(), 0.5),
    )
    for prior, start, sigma in cases:
        sampler = ResidualSampler(make_decoder(prior, 0.5, start=start))
        assert sampler.sigma == pytest.approx(sigma) and sampler.distribution == "clipped"


def test_sampler_options():
    decoder = make_decoder(PastPrior(P), 0.5)
    with raises(ValueError, "normal, clipped, uniform"):
        ResidualSampler(decoder, distribution="laplace")
    with raises(ValueError, "'uniform'"):
        ResidualSampler(make_decoder(PastPrior(P, sigma=0.0), 0.5), distribution="clipped")
    # Without noise of the prior's own, the box is all there is.
    assert ResidualSampler(make_decoder(PastPrior(P, sigma=0.0), 0.5)).distribution == "uniform"
    with raises(KeyError, "PriorAnchor"):
        ResidualSampler(decoder)(TensorDict({}, [2]))


@pytest.mark.parametrize("make", [make_prior_space_actor, make_prior_space_critic])
def test_networks_read_observations_in_doubles_and_need_one(make):
    torch.manual_seed(0)
    box = {"delta": 0.5} if make is make_prior_space_actor else {}
    with raises(ValueError, "in_keys"):
        make(D_A, 40, P, in_keys=(), **box)
    with raises(ValueError, "action_dim", "None"):
        make(None, 40, P, **box)
    wide = {
        "observation": torch.zeros(2, 2, 41),
        "prior": dict.fromkeys(("anchor", "delta"), torch.zeros(2, P, D_A)),
    }
    with raises(ValueError, "(2, 2, 41)"):
        make(D_A, 40, P, **box)(TensorDict(wide, [2]))
    module = make(D_A, 4, P, 1, hidden_dim=8, num_layers=1, **box)
    chunks = {"anchor": torch.rand(5, P, D_A), "delta": torch.rand(5, P, D_A)}
    single = TensorDict({"observation": torch.rand(5, 1, 4), "prior": chunks}, [5])
    (key,) = module.out_keys[-1:]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        values = [module(data.clone())[key] for data in (single, single.double())]
    assert values[1].dtype == torch.float32
    torch.testing.assert_close(*values)
