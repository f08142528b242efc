"""The rows of the prior table, against plain Python over lists of executed actions."""

from __future__ import annotations

import math
import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from warmprior import GaussianPrior, PastPrior, PreviewPrior, Prior

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
PAPER_SIGMA = {GaussianPrior: 1.0, PastPrior: 0.5, PreviewPrior: 1.0}


@pytest.mark.parametrize("prior_class", PRIORS)
@pytest.mark.parametrize("horizon", [1, 2, 8])
def test_lengths_and_default_sigma(prior_class, horizon):
    prior = prior_class(horizon)
    assert prior.prediction_length == (2 * horizon if prior_class is PreviewPrior else horizon)
    assert prior.sigma == PAPER_SIGMA[prior_class]
    assert prior.cold_probability == 0.0


def training_reference(prior, history, valid, target):
    """One window at a time: mean per position, or ``None`` where cold."""
    horizon, length = prior.chunk_length, prior.prediction_length
    if isinstance(prior, GaussianPrior):
        return [None] * length
    if isinstance(prior, PastPrior):
        return [history[j] for j in range(horizon)] if all(valid) else [None] * length
    return [target[j] if j < horizon else None for j in range(length)]


@pytest.mark.parametrize("prior_class", PRIORS)
@pytest.mark.parametrize("horizon", [1, 3])
def test_training_mean(prior_class, horizon):
    torch.manual_seed(0)
    prior = prior_class(horizon)
    history = torch.randn(2, 5, horizon, 2)
    valid = torch.rand(2, 5, horizon) < 0.7
    valid[0, 0], valid[0, 1] = True, False
    target = torch.randn(2, 5, prior.prediction_length, 2)
    loc, warm = prior.training_mean(history, valid, target)
    assert loc.shape == target.shape
    assert warm.shape == (*target.shape[:-1], 1) and warm.dtype == torch.bool
    for i in range(2):
        for j in range(5):
            expected = training_reference(prior, history[i, j], valid[i, j], target[i, j])
            for position, mean in enumerate(expected):
                assert bool(warm[i, j, position]) == (mean is not None)
                if mean is not None:
                    assert torch.equal(loc[i, j, position], mean)


def test_training_mean_does_not_write_into_its_inputs():
    history, target = torch.randn(3, 4, 2), torch.randn(3, 8, 2)
    valid = torch.zeros(3, 4, dtype=torch.bool)
    before = history.clone(), target.clone()
    for prior in (PastPrior(4), PreviewPrior(4), GaussianPrior(4)):
        loc, _ = prior.training_mean(history, valid, target[:, : prior.prediction_length])
        loc.add_(1.0)
    assert torch.equal(history, before[0]) and torch.equal(target, before[1])


@settings(max_examples=40, deadline=None)
@given(
    horizon=st.integers(1, 5),
    decisions=st.integers(1, 8),
    batch=st.integers(1, 3),
    prior_class=st.sampled_from(PRIORS),
    seed=st.integers(0, 10**6),
)
def test_next_mean_over_decisions_with_any_number_of_executed_actions(
    horizon, decisions, batch, prior_class, seed
):
    """Several decisions, each sub-environment executing its own ``k <= H`` actions."""
    rng = random.Random(seed)
    generator = torch.Generator().manual_seed(seed)
    prior = prior_class(horizon)
    length = prior.prediction_length
    loc = torch.zeros(batch, length, 2)
    elapsed = torch.zeros(batch, 1, dtype=torch.int64)
    executed: list[list[torch.Tensor]] = [[] for _ in range(batch)]
    for _ in range(decisions):
        chunk = torch.randn(batch, length, 2, generator=generator)
        k = torch.tensor([[rng.randint(1, horizon)] for _ in range(batch)])
        elapsed = elapsed + k
        loc, warm = prior.next_mean(loc, chunk, k, elapsed)
        assert loc.shape == chunk.shape and warm.shape == (batch, length, 1)
        for b in range(batch):
            count = int(k[b])
            executed[b] += [chunk[b, i] for i in range(count)]
            if prior_class is GaussianPrior:
                expected = None
            elif prior_class is PastPrior:
                expected = executed[b][-horizon:] if len(executed[b]) >= horizon else None
            else:
                expected = [chunk[b, count + i] for i in range(horizon)]
            if expected is None:
                assert not warm[b].any()
                continue
            assert warm[b, :horizon].all() and not warm[b, horizon:].any()
            assert torch.equal(loc[b, :horizon], torch.stack(expected))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("prior_class", PRIORS)
def test_next_mean_batch_shapes(batch, prior_class):
    prior = prior_class(3)
    chunk = torch.randn(*batch, prior.prediction_length, 2)
    k = torch.full((*batch, 1), 3)
    loc, warm = prior.next_mean(torch.zeros_like(chunk), chunk, k, k)
    assert loc.shape == chunk.shape and warm.shape == (*batch, prior.prediction_length, 1)
    if prior_class is PastPrior:
        assert torch.equal(loc, chunk)  # Algorithm 1: the previous chunk itself
    if prior_class is PreviewPrior:
        assert torch.equal(loc[..., :3, :], chunk[..., 3:, :])


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.5, 2.0])
def test_sample_is_equation_one(sigma):
    prior = PastPrior(3, sigma=sigma)
    loc = torch.randn(50, 3, 2)
    warm = torch.rand(50, 3, 1) < 0.5
    a0 = prior.sample(loc, warm, torch.Generator().manual_seed(3))
    eps = torch.randn(50, 3, 2, generator=torch.Generator().manual_seed(3))
    for i in range(50):
        for tau in range(3):
            expected = loc[i, tau] + sigma * eps[i, tau] if warm[i, tau] else eps[i, tau]
            torch.testing.assert_close(a0[i, tau], expected)


def test_sigma_zero_is_deterministic_where_warm():
    prior = PastPrior(3, sigma=0.0)
    loc, warm = torch.randn(4, 3, 2), torch.ones(4, 3, 1, dtype=torch.bool)
    assert torch.equal(prior.sample(loc, warm), loc)
    assert torch.equal(prior.sample(loc, warm), prior.sample(loc, warm))


def test_sample_moments():
    prior = PastPrior(1, sigma=0.3)
    loc = torch.full((40_000, 1, 1), 5.0)
    warm = (torch.arange(40_000) % 2 == 0).view(-1, 1, 1)
    a0 = prior.sample(loc, warm, torch.Generator().manual_seed(0))
    hot, cold = a0[::2], a0[1::2]
    # Five standard errors.
    assert abs(hot.mean() - 5.0) < 5 * 0.3 / math.sqrt(20_000)
    assert abs(hot.std() - 0.3) < 5 * 0.3 / math.sqrt(40_000)
    assert abs(cold.mean()) < 5 / math.sqrt(20_000)
    assert abs(cold.std() - 1.0) < 5 / math.sqrt(40_000)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 1.0])
def test_correlated_noise_shares_its_variance_over_the_warm_positions(correlation):
    """Variance ``sigma^2``; covariance ``c sigma^2`` between warm positions of one dimension alone."""
    prior = PreviewPrior(3, sigma=0.5, correlation=correlation)
    loc = torch.full((40_000, 6, 2), 2.0)
    warm = (torch.arange(6) < 3)[:, None].expand(40_000, 6, 1)
    a0 = prior.sample(loc, warm, torch.Generator().manual_seed(0))
    assert torch.allclose(a0[:, :3].mean(0), loc[0, :3], atol=0.02)
    found = torch.cov(a0.transpose(1, 2).flatten(1).T)  # by dimension, then position
    block = 0.25 * ((1 - correlation) * torch.eye(3) + correlation)
    expected = torch.block_diag(block, torch.eye(3), block, torch.eye(3))
    assert torch.allclose(found, expected, atol=0.03)
    # What of it reaches the average over the chunk.
    average = float(a0[:, :3].mean(1).var())
    assert average == pytest.approx(0.25 * (correlation + (1 - correlation) / 3), rel=0.04)


def test_white_noise_is_what_it_was_before_there_was_another():
    """Same draws and the same configuration, from which policies have their names."""
    prior, g = PastPrior(4), torch.Generator().manual_seed(0)
    assert (
        "correlation" not in prior.config()
        and PastPrior(4, correlation=0.5).config()["correlation"]
    )
    loc, warm = torch.rand(5, 4, 2), torch.rand(5, 4, 1) < 0.5
    a0 = prior.sample(loc, warm, g)
    eps = torch.randn(5, 4, 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(a0, torch.where(warm, loc + 0.5 * eps, eps))


def test_withhold_share_and_whole_samples():
    prior = PreviewPrior(4, cold_probability=0.3)
    warm = torch.zeros(100, 100, 8, 1, dtype=torch.bool)
    warm[..., :4, :] = True
    kept = prior.withhold(warm, torch.Generator().manual_seed(0))
    per_sample = kept.squeeze(-1).sum(-1)
    assert set(per_sample.unique().tolist()) == {0, 4}  # all or nothing
    share = (per_sample == 0).float().mean().item()
    assert abs(share - 0.3) < 5 * math.sqrt(0.3 * 0.7 / 10_000)
    assert torch.equal(kept, prior.withhold(warm, torch.Generator().manual_seed(0)))
    assert not torch.equal(kept, prior.withhold(warm, torch.Generator().manual_seed(1)))


@pytest.mark.parametrize(("probability", "share"), [(0.0, 1.0), (1.0, 0.0)])
def test_withhold_limits(probability, share):
    warm = torch.ones(500, 2, 1, dtype=torch.bool)
    kept = PastPrior(2, cold_probability=probability).withhold(warm)
    assert kept.float().mean() == share


def test_withhold_never_warms():
    warm = torch.zeros(100, 2, 1, dtype=torch.bool)
    assert not PastPrior(2, cold_probability=0.5).withhold(warm).any()


def test_paper_setting_draws_nothing():
    """With the default the generator's stream is that of Algorithm 1."""
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    PastPrior(2).withhold(torch.ones(3, 2, 1, dtype=torch.bool), generator)
    assert torch.equal(before, generator.get_state())


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((0,), {}, "chunk_length"),
        ((-3,), {}, "chunk_length"),
        ((4,), {"sigma": -0.1}, "sigma"),
        ((4,), {"sigma": float("nan")}, "sigma"),
        ((4,), {"sigma": float("inf")}, "sigma"),
        ((4,), {"cold_probability": -0.1}, "cold_probability"),
        ((4,), {"cold_probability": 1.1}, "cold_probability"),
        ((4,), {"cold_probability": float("nan")}, "cold_probability"),
        ((4,), {"sigma": True}, "sigma"),
        ((4,), {"correlation": True}, "correlation"),
        ((4,), {"correlation": "abc"}, "correlation must be a finite number, got 'abc'"),
        ((4,), {"correlation": None}, "correlation"),
    ],
)
@pytest.mark.parametrize("prior_class", PRIORS)
def test_bad_arguments(prior_class, arguments, options, message):
    with pytest.raises(ValueError, match=message):
        prior_class(*arguments, **options)


@pytest.mark.parametrize("prior_class", PRIORS)
def test_config_round_trip(prior_class):
    prior = prior_class(5, sigma=0.25, cold_probability=0.5)
    again = Prior.from_config(prior.config())
    assert type(again) is prior_class and again.config() == prior.config()
    assert repr(again) == repr(prior)


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown prior 'nope'.*gaussian.*past.*preview"):
        Prior.from_config({"name": "nope", "chunk_length": 2})
