"""Memory gain of policies whose dependence on the mean is known."""

import math

import pytest
import torch

from lab.measures.memory_gain import memory_gain
from lab.methods.learned_sources import ForecastPrior, ForecastStart
from tests.diagnostics.fields import D_A, Field, H, batch, policy, remember
from tests.errors import refuses
from warmprior import (
    GaussianPrior,
    HistoryObservation,
    PastPrior,
    PreviewPrior,
    RealTimeChunking,
    WarmPriorActor,
)
from warmprior.diagnostics import flow

N = 20_000


def windows(prior, n=50, warm=True, **extra):
    length = prior.prediction_length
    loc = torch.rand(n, length, D_A, generator=torch.Generator().manual_seed(2))
    return HistoryObservation()(remember(batch(n, length), loc, warm).update(extra))


def by_hand(act, data, shift=0.05):
    """Slope of ``act(windows, generator)`` along the directions that a measurement draws."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(len(data), 1, D_A, generator=generator)
    direction = torch.nn.functional.normalize(normal, dim=-1)
    state, chunks = generator.get_state(), []
    for sign in (1, -1):
        generator.set_state(state)
        moved = data.clone()
        moved["history", "actions"] += sign * shift * direction
        moved["history", "forecast"][:, :H] += sign * shift * direction
        with torch.no_grad():
            chunks.append(act(moved, generator))
    return float(((chunks[0] - chunks[1]) * direction).sum(-1).mean()) / (2 * shift)


def repeats(share):
    """One Euler step gives the share of the source; a tensor [H, 1], position by position."""
    return lambda t, a, observation: (share - 1.0) * a


@pytest.mark.parametrize("prior", [PastPrior(H, sigma=0.5), PreviewPrior(H)])
@pytest.mark.parametrize("share", [-0.4, 0.0, 0.3, 1.0, 2.0])
def test_the_gain_is_the_share_that_is_repeated(prior, share):
    found = memory_gain(policy(repeats(share), prior), windows(prior), nfes=(1,))
    assert found == {1: pytest.approx(share, abs=1e-5)}


def test_the_gain_is_the_mean_slope_over_dimensions():
    """A dimension of the memory gains nothing by what appears in another one."""
    prior, matrix = PastPrior(H), torch.tensor([[1.0, 2.0], [0.0, -0.5]])
    field = policy(lambda t, a, o: a @ matrix.T - a, prior)
    found = memory_gain(field, windows(prior, N), nfes=(1,))
    assert found[1] == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize("shift", [0.01, 0.05, 0.2])
def test_a_flow_that_branches_has_the_slope_of_its_mean(shift):
    """Actions are the sign of the source: E[a | mu] = erf(mu / (sigma sqrt 2)), whatever the shift."""
    prior = PastPrior(H, sigma=0.5)
    data = windows(prior, 4 * N)
    data["history", "actions"].zero_()
    field = policy(lambda t, a, o: a.sign() - a, prior)
    found = memory_gain(field, data, nfes=(1,), shift=shift)[1]
    along = shift / math.sqrt(D_A)  # per dimension, as good as linear
    assert found == pytest.approx(math.erf(along / 0.5 / math.sqrt(2)) / along, rel=0.05)


def test_a_cold_source_has_no_memory():
    for prior in (GaussianPrior(H), PastPrior(H), PreviewPrior(H)):
        found = memory_gain(policy(repeats(0.7), prior), windows(prior, warm=False), nfes=(1, 3))
        assert found == {1: 0.0, 3: 0.0}


def test_only_executed_positions_inside_the_episode_count():
    prior = PreviewPrior(H)
    shares = torch.tensor([0.1, 0.2, 0.3, 9.0, 9.0, 9.0])[:, None]
    pad = torch.zeros(10, 2 * H, dtype=torch.bool)
    pad[0, 1:] = True
    data = windows(prior, 10, action_is_pad=pad)
    counted = [0.1] + 9 * [0.1, 0.2, 0.3]
    found = memory_gain(policy(repeats(shares), prior), data, nfes=(1,))
    assert found[1] == pytest.approx(sum(counted) / len(counted), rel=1e-4)
    data["action_is_pad"][:] = True
    assert math.isnan(memory_gain(policy(repeats(shares), prior), data, nfes=(1,))[1])


@pytest.mark.parametrize(("sigma", "correlation"), [(0.5, 0.0), (1.0, 0.0), (0.5, 0.5), (0.5, 1.0)])
def test_noise_lowers_the_gain_by_what_averaging_over_the_chunk_leaves(sigma, correlation):
    """Actions are one height for a chunk and for its past: E[a1 - a0 | a_t] by the normal equations."""
    prior, spread = PastPrior(H, sigma=sigma, correlation=correlation), 0.3
    signal = spread**2 * torch.ones(H, H, dtype=torch.float64)
    white, common = torch.eye(H, dtype=torch.float64), torch.ones(H, H, dtype=torch.float64)
    noise = sigma**2 * ((1 - correlation) * white + correlation * common)

    def exact(t, a, observation):
        left = 1 - float(t.flatten()[0])  # a_t = height + left * noise
        slope = -left * noise @ torch.linalg.pinv(signal + left**2 * noise)
        return torch.einsum("ij,njd->nid", slope.float(), a)

    kept = sigma**2 * (correlation + (1 - correlation) / H)
    field = policy(exact, prior)
    found = memory_gain(field, windows(prior), nfes=(1, 300))
    assert found[1] == pytest.approx(spread**2 / (spread**2 + kept), rel=1e-3)
    assert found[300] == pytest.approx(spread / math.sqrt(spread**2 + kept), rel=5e-3)


@pytest.mark.parametrize("learned", ["source", "start"])
def test_what_is_learned_is_asked_with_the_shifted_history(learned):
    """STEP starts at a later time, from its forecast of what is remembered and less noise."""
    torch.manual_seed(0)
    if learned == "source":
        prior, start = ForecastPrior(H, widths=[D_A, 4, 1]), None
    else:
        prior, start = GaussianPrior(H), ForecastStart(H, start_time=0.5, widths=[D_A, 4, 1])
    data = windows(prior)
    stays = policy(lambda t, a, o: torch.zeros_like(a), prior, start=start)  # executes where it starts
    found = memory_gain(stays, data, nfes=(1,), shift=0.05)[1]

    def act(moved, generator):
        history, observation = moved["history"], moved["observation"]
        noise = prior.distribution(history, observation).sample(generator)
        return noise if start is None else start(noise, history, observation)

    assert found == pytest.approx(by_hand(act, data), rel=1e-3) and abs(found) > 1e-4


def test_a_guided_policy_is_measured_as_it_acts():
    """Against the policy itself, on both sides by hand; its guidance takes the source's own sigma."""
    prior = PastPrior(H, sigma=0.5)
    guided = WarmPriorActor(Field(lambda t, a, o: a.sin()), prior, nfe=4, guidance=RealTimeChunking())
    data = windows(prior, 20)
    refuses(lambda: memory_gain(guided, data), KeyError, "replace(guidance=None)")
    data["rtc", "delay"] = torch.ones(20, 1, dtype=torch.int64)
    found = memory_gain(guided, data, nfes=(4,), shift=0.05)[4]

    def act(moved, generator):
        return guided(moved, generator=generator)["vla_action", "chunk"]

    assert found == pytest.approx(by_hand(act, data), rel=1e-3)


def test_it_is_repeatable_and_leaves_the_policy_as_it_is(monkeypatch):
    prior = PastPrior(H)
    field = policy(lambda t, a, o: a.sin() * o.mean((1, 2), keepdim=True), prior).train()
    data = windows(prior)
    before = data.clone()
    found = memory_gain(field, data, nfes=(1, 3))
    monkeypatch.setattr(flow, "SPLIT", 7)
    assert found == pytest.approx(memory_gain(field, data, nfes=(1, 3)))
    assert field.training and (data == before).all()
