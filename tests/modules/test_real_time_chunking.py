"""Guidance by the rest of the last chunk: against the published formulas, LeRobot and known posteriors."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.toy_env import mlp_actor, stirred
from warmprior import PastPrior, PreviewPrior, RealTimeChunking
from warmprior.history import advance, cold_history, without
from warmprior.modules.real_time_chunking import spliced

B, P, D = 3, 10, 4


def reference_weight(schedule, i, start, end):
    """Position by position, as the paper and the comments of the official code tell it."""
    start = min(start, end)
    if i >= end:
        return 0.0
    if i < start:
        return 1.0
    linear = (end - i) / (end - start + 1)
    return linear if schedule == "linear" else linear * (math.exp(linear) - 1) / (math.e - 1)


@pytest.mark.parametrize("schedule", ["exp", "linear"])
def test_weights_of_every_delay_and_horizon(schedule):
    pairs = torch.cartesian_prod(torch.arange(P + 1), torch.arange(P + 1))
    found = RealTimeChunking(schedule=schedule).weights(pairs[:, 0], pairs[:, 1], P)
    expected = [
        [reference_weight(schedule, i, start, end) for i in range(P)] for start, end in pairs.tolist()
    ]
    torch.testing.assert_close(found, torch.tensor(expected))


def network():
    """A velocity in which every position depends on all others."""
    torch.manual_seed(0)
    mix = torch.nn.Linear(P * D + 1, P * D).double()

    def velocity(t, a):
        return torch.tanh(mix(torch.cat([a.flatten(1), t[:, None]], 1))).view_as(a)

    return velocity


def batch(dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)
    a, y = (torch.randn(B, P, D, generator=generator, dtype=dtype) for _ in range(2))
    left, delay = torch.tensor([[7], [4], [10]]), torch.tensor([[3], [0], [4]])
    return a, torch.where((torch.arange(P) < left).unsqueeze(-1), y, 0.0), left, delay


def at(t, a):
    return torch.full(a.shape[:1], t, dtype=a.dtype)


@pytest.mark.parametrize("t", [0.0, 0.1, 0.5, 0.9])
def test_the_official_formula(t):
    """With the Jacobian written out: v + min(c / r^2, beta) J^T W (Y - a_hat)."""
    velocity = network()
    a, y, left, delay = batch()
    found = RealTimeChunking().guided(velocity, y, left, delay)(at(t, a), a)
    for row in range(B):

        def clean(x):
            return x + (1 - t) * velocity(torch.tensor([t], dtype=x.dtype), x)

        x = a[row : row + 1]
        jacobian = torch.autograd.functional.jacobian(clean, x).view(P * D, P * D)
        weights = torch.tensor(
            [reference_weight("exp", i, int(delay[row]), int(left[row])) for i in range(P)], dtype=a.dtype
        )
        error = weights[:, None] * (y[row] - clean(x)[0])
        inverse_r2 = (t**2 + (1 - t) ** 2) / (1 - t) ** 2
        weight = min((1 - t) / t * inverse_r2, 5.0) if t else 5.0
        v = velocity(torch.tensor([t], dtype=x.dtype), x)[0]
        expected = v + weight * (jacobian.T @ error.flatten()).view(P, D)
        torch.testing.assert_close(found[row], expected.detach())


@pytest.mark.parametrize("time", [1.0, 0.8, 0.5, 0.1])
def test_without_the_jacobian_it_is_lerobots(time):
    """Their time runs from 1 (noise) to 0, and their velocity points to the noise."""
    rtc = pytest.importorskip("lerobot.policies.rtc")
    from lerobot.configs import RTCAttentionSchedule

    velocity = network()
    a, y, *_ = batch()
    config = rtc.RTCConfig(
        prefix_attention_schedule=RTCAttentionSchedule.LINEAR, max_guidance_weight=10.0, execution_horizon=7
    )
    with torch.no_grad():
        theirs = rtc.RTCProcessor(config).denoise_step(a, y, 3, time, lambda x: -velocity(at(1 - time, x), x))
    ours = RealTimeChunking(
        schedule="linear", max_guidance_weight=10.0, execution_horizon=7, jacobian=False, sigma=1.0
    )
    everything, delay = torch.full((B, 1), P), torch.full((B, 1), 3)
    guided = ours.guided(velocity, y, everything, delay, sigma=torch.tensor(0.3))
    # Theirs computes the weight in single precision.
    torch.testing.assert_close(guided(at(1 - time, a), a), -theirs, rtol=1e-5, atol=1e-5)
    exact = RealTimeChunking(schedule="linear", max_guidance_weight=10.0, execution_horizon=7)
    difference = exact.guided(velocity, y, everything, delay)(at(1 - time, a), a) + theirs
    assert difference.abs().max() > 0.05  # another method


def gaussian_velocity(mean, mu, sigma):
    """Return the velocity for data N(mean, 1) and an independent source N(mu, sigma^2)."""

    def velocity(t, a):
        t = t[:, None, None]
        gain = t / (t**2 + sigma**2 * (1 - t) ** 2)
        clean = mean + gain * (a - t * mean - (1 - t) * mu)
        return (clean - a) / (1 - t)

    return velocity


@pytest.mark.parametrize("t", [0.1, 0.5, 0.9])
def test_known_posteriors_of_gaussians(t):
    """Given the whole of Y, the velocity at the positions of Y is (Y - a_t) / (1 - t), whatever the source.

    The source is warm on half of the positions, and has a mean: each position has a sigma of its own.
    """
    a, y, *_ = batch()
    generator = torch.Generator().manual_seed(2)
    mean, mu = (torch.randn(1, P, D, generator=generator, dtype=a.dtype) for _ in range(2))
    sigma = torch.where(torch.arange(P) < P // 2, 0.5, 1.0).to(a).view(1, P, 1)
    velocity = gaussian_velocity(mean, mu, sigma)
    left = torch.arange(P) % 2 == 0  # of the forecast every second position is made to count
    rtc = RealTimeChunking(max_guidance_weight=1e9)
    everything = delay = torch.full((B, 1), P)  # W = 1 at all positions
    target = torch.where(left.view(1, P, 1), y, a + (1 - t) * velocity(at(t, a), a))
    found = rtc.guided(velocity, target, everything, delay, sigma)(at(t, a), a)
    expected = torch.where(left.view(1, P, 1), (y - a) / (1 - t), velocity(at(t, a), a))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    published = RealTimeChunking(max_guidance_weight=1e9, sigma=1.0).guided(
        velocity, target, everything, delay, sigma
    )(at(t, a), a)
    warm = torch.arange(P) < P // 2
    assert (published - expected)[:, left & warm].abs().max() > 0.01
    torch.testing.assert_close(published[:, ~warm], expected[:, ~warm], rtol=1e-9, atol=1e-9)


def test_the_weight_at_both_ends():
    ends = torch.tensor([0.0, 1.0])
    assert RealTimeChunking().guidance_weight(ends).tolist() == [5.0, 5.0]
    # A source without noise says at once where its flow ends: there is nothing to weigh at its start.
    assert RealTimeChunking().guidance_weight(ends, torch.tensor(0.0)).tolist() == [0.0, 5.0]


def test_rows_without_a_forecast_are_not_guided():
    velocity = network()
    a, y, left, delay = batch()
    left[1] = 0
    plain = velocity(at(0.3, a), a)
    guided = RealTimeChunking().guided(velocity, y, left, delay)(at(0.3, a), a)
    assert torch.equal(guided[1], plain[1].detach()) and not torch.equal(guided[0], plain[0])
    assert RealTimeChunking().guided(velocity, y, 0 * left, delay) is velocity


def test_gradients_are_its_own_affair():
    velocity = network()
    a, y, left, delay = batch()
    rtc = RealTimeChunking()
    expected = rtc.guided(velocity, y, left, delay)(at(0.3, a), a)
    with torch.no_grad():
        found = rtc.guided(velocity, y, left, delay)(at(0.3, a), a)
    assert torch.equal(found, expected) and not found.requires_grad
    with torch.inference_mode():
        with raises(RuntimeError, "torch.no_grad", "jacobian=False"):
            rtc.guided(velocity, y, left, delay)(at(0.3, a), a)
        free = RealTimeChunking(jacobian=False)
        assert free.guided(velocity, y, left, delay)(at(0.3, a), a).isfinite().all()


def test_options_and_delays_that_cannot_be():
    wrong = {"schedule": "cosine", "execution_horizon": 0, "max_guidance_weight": 0.0, "sigma": -0.1}
    for name, value in wrong.items():
        with raises(ValueError, name, value):
            RealTimeChunking(**{name: value})
    _, y, left, delay = batch()
    late = delay + torch.tensor([[5], [0], [0]])
    refuses(lambda: RealTimeChunking().guided(network(), y, left, late), ValueError, "delay", 8, 7)
    with raises(ValueError, "execution_horizon=2", "delay", 3):
        RealTimeChunking(execution_horizon=2).guided(network(), y, left, delay)
    for wrong in ((left[:2], delay), (left, delay.squeeze(1))):
        with raises(ValueError, "has shape", 3, 1):
            RealTimeChunking().guided(network(), y, *wrong)


def decision(prior, *batch):
    """Three actions are left of the chunk before."""
    generator = torch.Generator().manual_seed(3)
    sizes = prior.chunk_length, prior.prediction_length, 2
    chunk = torch.randn(*batch, *sizes[1:], generator=generator)
    executed = torch.full((*batch, 1), prior.prediction_length - 3)
    history = advance(cold_history(batch, *sizes), chunk, executed)
    seen = torch.randn(*batch, 2, 3, generator=generator)
    delay = torch.full((*batch, 1), 2)
    return TensorDict({"observation": seen, "history": history, "rtc": {"delay": delay}}, batch)


def actor(prior, **options):
    return stirred(mlp_actor(prior, observation_dim=3, hidden_dim=16, nfe=4, **options))


def test_the_actor_knows_the_sigma_of_its_source():
    """Positions that are cold have 1; the chunk is that of the guided integration by hand."""
    prior, rtc = PreviewPrior(2, sigma=0.5), RealTimeChunking(schedule="linear")
    policy, data = actor(prior, guidance=rtc), decision(prior, 5)
    data["history"] = without(data["history"], torch.arange(5) == 4)
    data["rtc", "delay"][4] = 0
    with torch.no_grad():
        found = policy(data.clone(), generator=torch.Generator().manual_seed(7))
        a = found["prior", "noise"]
        sigma = torch.tensor([0.5, 0.5, 1.0, 1.0]).view(1, 4, 1).repeat(5, 1, 1)
        sigma[4] = 1.0
        guided = rtc.guided(
            lambda t, x: policy.network(t, x, data["observation"]),
            data["history", "forecast"],
            torch.tensor([[3]] * 4 + [[0]]),
            data["rtc", "delay"],
            sigma,
        )
        for i in range(4):
            a = a + guided(torch.full((5,), i / 4), a) / 4
    torch.testing.assert_close(found["vla_action", "chunk"], a)


def test_the_deviation_of_a_source_may_be_a_number():
    class Even(PastPrior):
        name = "even-of-the-tests"

        def distribution(self, history, observation=None):
            return replace(super().distribution(history), scale=0.5)  # as PastPrior has where it is warm

    policy, data = actor(PastPrior(4), guidance=RealTimeChunking()), decision(PastPrior(4), 3)
    data["history", "steps"].fill_(4)
    even = policy.replace(prior=Even(4))
    one, other = (p(data.clone(), generator=torch.Generator().manual_seed(7)) for p in (policy, even))
    assert torch.equal(one["vla_action", "chunk"], other["vla_action", "chunk"])


def test_missing_keys():
    data = decision(PastPrior(4), 2).exclude("rtc")
    with raises(KeyError, "InferenceDelay", "AsyncExecutor"):
        actor(PastPrior(4), guidance=RealTimeChunking())(data)


def test_what_is_executed_of_a_late_chunk():
    chunk, forecast = torch.zeros(3, 4, 1), torch.ones(3, 4, 1)
    found = spliced(chunk, forecast, torch.tensor([[0], [1], [4]]))
    assert found.squeeze(-1).tolist() == [[0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 1]]
