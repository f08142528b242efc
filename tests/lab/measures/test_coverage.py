"""Coverage of sources, where the share of targets inside is known."""

import math
from functools import partial

import pytest
import torch

from lab.measures.source_errors import source_coverage
from tests.diagnostics.fields import D_A, H, remember, targets
from tests.errors import raises
from tests.toy_env import mlp_actor
from warmprior import CVAEPrior, PastPrior, PreviewPrior

N = 20_000
actor = partial(mlp_actor, steps=1)


def windows(prior, spread):
    loc = torch.rand(N, prior.prediction_length, D_A, generator=torch.Generator().manual_seed(2))
    return remember(targets(prior, N, spread, loc), loc)


@pytest.mark.parametrize("level", [0.5, 0.9])
@pytest.mark.parametrize("prior", [PastPrior(H, sigma=0.4), PreviewPrior(H, sigma=0.4)])
def test_a_source_that_spreads_like_the_data_covers_its_level(prior, level):
    assert source_coverage(actor(prior), windows(prior, 0.4), level=level) == pytest.approx(level, abs=0.01)
    # Half as wide: P(|z| < q / 2) for the quantile q.
    z = torch.distributions.Normal(0.0, 1.0)
    narrow = float(2 * z.cdf(z.icdf(torch.tensor((1 + level) / 2)) / 2) - 1)
    found = source_coverage(actor(prior), windows(prior, 0.8), level=level)
    assert found == pytest.approx(narrow, abs=0.01)


def test_only_executed_positions_inside_the_episode_count():
    prior = PreviewPrior(H, sigma=0.0)
    data = windows(prior, 0.0)
    data["vla_action", "chunk"][:, 0] += 1.0
    data["vla_action", "chunk"][:, H:] += 9.0
    assert source_coverage(actor(prior), data) == pytest.approx(2 / 3)
    data["action_is_pad"][:, 0] = True
    assert source_coverage(actor(prior), data) == 1.0


def test_what_is_no_gaussian_has_none():
    prior = CVAEPrior(H, widths=[D_A, 4, 1])
    assert math.isnan(source_coverage(actor(prior), windows(prior, 1.0)))
    with raises(ValueError, "level", 1.0):
        source_coverage(actor(PastPrior(H)), windows(PastPrior(H), 1.0), level=1.0)
