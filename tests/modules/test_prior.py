import pytest
import torch

from tests.errors import raises
from tests.toy_env import random_history
from warmprior import GaussianPrior, PastPrior, PreviewPrior

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]


@pytest.mark.parametrize("correlation", [0.0, 0.3, 1.0])
def test_correlated_noise_shares_its_variance_over_the_warm_positions(correlation):
    """Variance ``sigma^2``; covariance ``c sigma^2`` between warm positions of one dimension alone."""
    prior = PreviewPrior(3, sigma=0.5, correlation=correlation)
    history = random_history(prior, 1, cold=0.0).expand(40_000)
    a0 = prior.distribution(history).sample(torch.Generator().manual_seed(0))
    loc = prior.distribution(history).loc
    assert torch.allclose(a0[:, :3].mean(0), loc[0, :3], atol=0.02)
    found = torch.cov(a0.transpose(1, 2).flatten(1).T)  # by dimension, then position
    block = 0.25 * ((1 - correlation) * torch.eye(3) + correlation)
    expected = torch.block_diag(block, torch.eye(3), block, torch.eye(3))
    assert torch.allclose(found, expected, atol=0.03)
    # What of it reaches the average over the chunk.
    average = float((a0 - loc)[:, :3].mean(1).var())
    assert average == pytest.approx(0.25 * (correlation + (1 - correlation) / 3), rel=0.04)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("chunk_length", 0),
        *(("sigma", v) for v in (-0.1, float("nan"))),
        ("correlation", 1.1),
        ("correlation", "abc"),
    ],
)
@pytest.mark.parametrize("prior_class", PRIORS)
def test_bad_arguments(prior_class, name, value):
    unknown = prior_class is GaussianPrior and name != "chunk_length"
    with raises(TypeError if unknown else ValueError, name, *([] if unknown else [value])):
        prior_class(**{"chunk_length": 4, name: value})
