"""Preconditioning: moments against Monte Carlo, coefficients against brute-force regression."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.paths import PolynomialInterpolant, TrigonometricInterpolant
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    LinearInterpolant,
    PastPrior,
    PreconditionedNetwork,
    PreviewPrior,
    SourceMoments,
    VelocityMLP,
    VelocityNetwork,
    WarmPriorActor,
    window_replay_buffer,
)

PATHS = [LinearInterpolant(), TrigonometricInterpolant(), PolynomialInterpolant(3.0)]


class Nothing(VelocityNetwork):
    """A network that has learnt nothing."""

    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps=2):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)

    def forward(self, t, a, observation):
        return torch.zeros_like(a)


class Spy(Nothing):
    """Keeps its input and answers with a constant."""

    def forward(self, t, a, observation):
        self.seen = a
        return torch.ones_like(a)


def moments_of(m0, m1, v0, v1, c, length=1, dim=1):
    def full(values):
        return [torch.full((length, dim), float(x)) for x in values]

    return SourceMoments(*full((m0, m1, v0, v1, c)))


def gaussian_steps(episodes=400, length=30, dim=2, keep=0.0, seed=0):
    """Actions of a stationary Gaussian AR(1) process: ``keep`` is the correlation of neighbours."""
    rng = np.random.default_rng(seed)
    action = np.empty((episodes, length, dim))
    action[:, 0] = rng.normal(size=(episodes, dim))
    for i in range(1, length):
        noise = rng.normal(size=(episodes, dim))
        action[:, i] = keep * action[:, i - 1] + math.sqrt(1 - keep**2) * noise
    action = 0.4 * action + np.array([0.3, -0.2])
    return steps_of(torch.from_numpy(action).float().flatten(0, 1), length)


def steps_of(action, length):
    n = len(action)
    data = {"observation": torch.zeros(n, 3), "action": action, "episode": torch.arange(n) // length}
    return TensorDict(data, [n])


def buffer_of(data, prior, batch_size=4096, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    options = {"batch_size": batch_size, "generator": generator, **options}
    return window_replay_buffer(data, prior, **options)


def is_warm(prior, windows):
    return prior.distribution(windows["history"]).warm.any(1).squeeze(-1)


def observations(a):
    return torch.zeros(len(a), 2, 3)


variances = st.floats(0.01, 4.0)
correlations = st.floats(-0.99, 0.99)


@settings(max_examples=60, deadline=None)
@given(
    path=st.sampled_from(PATHS),
    t=st.floats(0.0, 1.0),
    means=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    v0=variances,
    v1=variances,
    rho=correlations,
    a=st.floats(-2, 2),
)
def test_coefficients_are_gaussian_conditioning(path, t, means, v0, v1, rho, a):
    """E[u_t | a_t] and the deviation from it by 2 x 2 matrices, for any path and any moments."""
    c = rho * math.sqrt(v0 * v1)
    alpha, beta, d_alpha, d_beta = (float(x) for x in path.coefficients(torch.tensor(t, dtype=torch.float64)))
    joint = np.array([[v0, c], [c, v1]])
    maps = np.array([[alpha, beta], [d_alpha, d_beta]])
    mean_a, mean_u = maps @ np.array(means)
    (var_a, cov), (_, var_u) = maps @ joint @ maps.T
    slope = cov / var_a
    moments = moments_of(*means, v0, v1, c)
    expected = mean_u + slope * (a - mean_a)
    rest = math.sqrt(max(var_u - slope * cov, 0.0))
    point = torch.full((1, 1, 1), a)
    inputs = torch.tensor([t]), point, torch.zeros(1, 2, 3)
    mean = PreconditionedNetwork(Nothing(1, 3, 1), moments=moments, interpolant=path)(*inputs)
    spy = Spy(1, 3, 1)
    shifted = PreconditionedNetwork(spy, moments=moments, interpolant=path)(*inputs)
    tolerance = {"rel": 2e-3, "abs": 2e-3}
    assert float(mean) == pytest.approx(expected, **tolerance)
    assert float(spy.seen) == pytest.approx((a - mean_a) / math.sqrt(var_a), **tolerance)
    assert float(shifted - mean) == pytest.approx(rest, **tolerance)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.name)
@pytest.mark.parametrize(
    ("prior", "keep", "withhold"),
    [
        (GaussianPrior(3), 0.0, 0.0),
        (PastPrior(1), 0.9, 0.0),
        (PreviewPrior(2, sigma=0.3), 0.0, 0.5),
        (GaussianPrior(1), 0.9, 0.0),
    ],
    ids=str,
)
def test_zero_network_is_optimal_for_gaussian_data(prior, keep, withhold, path):
    """Brute force: least squares of the velocity on the whole point finds nothing that it misses."""
    dim, length = 2, prior.prediction_length
    data = gaussian_steps(keep=keep)
    windows = buffer_of(data, prior, withhold=withhold)
    moments = SourceMoments.fit(windows, prior, samples=80_000, generator=torch.Generator().manual_seed(1))
    network = PreconditionedNetwork(Nothing(dim, 3, length), moments=moments, interpolant=path)
    batch = torch.cat([windows.sample() for _ in range(20)])
    batch = batch[~batch["action_is_pad"].any(1)]
    if not isinstance(prior, GaussianPrior) and not withhold:
        batch = batch[is_warm(prior, batch)]  # of one Gaussian, not of a mixture
        moments = SourceMoments.fit(batch, prior, generator=torch.Generator().manual_seed(1))
        network = PreconditionedNetwork(Nothing(dim, 3, length), moments=moments, interpolant=path)
    a1 = batch["vla_action", "chunk"]
    a0 = prior.distribution(batch["history"]).sample(torch.Generator().manual_seed(2))
    for t in (0.0, 0.3, 0.8, 1.0):
        times = torch.full((len(a1),), t)
        a_t, u = path(a0, a1, times)
        with torch.no_grad():
            mine = network(times, a_t, observations(a_t))
        design = np.column_stack([np.ones(len(a_t)), a_t.flatten(1).numpy()])
        target = u.flatten(1).numpy()
        solution = np.linalg.lstsq(design, target, rcond=None)[0]
        best = ((design @ solution - target) ** 2).mean()
        assert float((mine - u).square().mean()) == pytest.approx(best, rel=0.01, abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8])
def test_padded_positions_do_not_count(dtype):
    """Every episode is 3 steps long and its last action is far away: position 3 is never seen."""
    data = steps_of(torch.tensor([[0.1], [0.2], [9.0]]).repeat(100, 1), 3)
    prior = GaussianPrior(4)
    windows = buffer_of(data, prior, batch_size=3000).sample()
    windows["action_is_pad"] = windows["action_is_pad"].to(dtype)
    moments = SourceMoments.fit(windows, prior, generator=torch.Generator().manual_seed(0))
    assert moments.target_mean[2:].flatten().tolist() == pytest.approx([9.0, 0.0])
    assert float(moments.target_variance[2]) == pytest.approx(1e-4)  # constant: the floor
    assert float(moments.target_variance[3]) == 1.0 and float(moments.covariance[3]) == 0.0
    chunk = windows["vla_action", "chunk"][:, 1].double()
    seen = chunk[windows["action_is_pad"][:, 1] == 0]
    assert float(moments.target_mean[1]) == pytest.approx(float(seen.mean()), rel=1e-5)
    assert float(moments.target_variance[1]) == pytest.approx(float(seen.var()), rel=1e-2)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.name)
@pytest.mark.parametrize(
    "prior", [PreviewPrior(2, sigma=0.0), PastPrior(2, sigma=0.0), GaussianPrior(2)], ids=str
)
def test_degenerate_ends_stay_finite(prior, path):
    """A constant action, a source without noise, a source that is its target: no NaN, no explosion."""
    data = gaussian_steps(episodes=20)
    data["action"][:, 1] = 0.25
    windows = buffer_of(data, prior, batch_size=512)
    moments = SourceMoments.fit(windows, prior, generator=torch.Generator().manual_seed(0))
    inner = VelocityMLP(2, 3, prior.prediction_length, hidden_dim=16)
    network = PreconditionedNetwork(inner, moments=moments, interpolant=path)
    batch = windows.sample()
    a1 = batch["vla_action", "chunk"]
    a0 = prior.distribution(batch["history"]).sample()
    for t in (0.0, 1e-6, 0.5, 1.0):
        times = torch.full((len(a1),), t)
        a_t, _ = path(a0, a1, times)
        velocity = network(times, a_t, batch["observation"])
        assert torch.isfinite(velocity).all() and velocity.abs().max() < 100
    network.zero_grad()
    velocity.square().mean().backward()
    assert all(torch.isfinite(p.grad).all() for p in inner.parameters())


@pytest.mark.parametrize("rho", [-1.0, 1.0])
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.name)
def test_full_correlation_stays_finite_at_every_time(rho, path):
    """Where source and target cancel on the way, the point has no variance to divide by."""
    network = PreconditionedNetwork(Spy(1, 3, 1), moments=moments_of(0, 0, 1, 1, rho), interpolant=path)
    t = torch.linspace(0, 1, 10_001)
    a = torch.zeros(len(t), 1, 1)
    assert torch.isfinite(network(t, a, observations(a))).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_lower_precision_keeps_what_is_left_to_learn(dtype):
    """Of a correlation of 0.9995, half a percent of the variance is left: too little for bf16's digits."""
    moments = moments_of(0.1, 0.2, 1, 1, 0.9995)
    wide = PreconditionedNetwork(Spy(1, 3, 1), moments=moments)
    narrow = copy.deepcopy(wide).to(dtype)
    t, a = torch.tensor([0.0, 0.5, 1.0]), torch.tensor([0.1, 0.15, 0.2]).view(3, 1, 1)
    expected = wide(t, a, observations(a))
    found = narrow(t.to(dtype), a.to(dtype), observations(a).to(dtype))
    assert found.dtype == dtype
    learnt = math.sqrt(1 - 0.9995**2)
    torch.testing.assert_close(found.float(), expected.float(), atol=0.3 * learnt, rtol=0)


def test_fit_is_deterministic_and_leaves_the_global_generator():
    data, prior = gaussian_steps(episodes=20), PastPrior(2)

    def fit(seed):
        options = {"samples": 1000, "generator": torch.Generator().manual_seed(seed)}
        return SourceMoments.fit(buffer_of(data, prior, 256, seed), prior, **options).state_dict()

    before = torch.get_rng_state()
    one, again, other = fit(0), fit(0), fit(1)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(one[key], again[key]) for key in one)
    assert any(not torch.equal(one[key], other[key]) for key in one)


def test_paths_that_cannot_be():
    with raises(ValueError, "velocity"):
        PreconditionedNetwork(Nothing(2, 3, 2), interpolant=PolynomialInterpolant(0.5))
    network = PreconditionedNetwork(Nothing(2, 3, 2), interpolant=PolynomialInterpolant(2.0))
    actor = WarmPriorActor(network, PastPrior(2))
    FlowMatchingLoss(actor, interpolant=PolynomialInterpolant(2.0))
    with raises(ValueError, "polynomial", "linear"):
        FlowMatchingLoss(actor, interpolant=LinearInterpolant())


def test_windows_of_another_prior_and_with_keys_of_their_own():
    windows = buffer_of(gaussian_steps(episodes=2), PastPrior(2), 8).sample()
    refuses(lambda: SourceMoments.fit(windows, PreviewPrior(2)), ValueError, 2, "PreviewPrior", 4)
    flat = SourceMoments.fit(windows, PastPrior(2), generator=torch.Generator().manual_seed(0))
    folded = windows.reshape(2, 4)
    again = SourceMoments.fit(folded, PastPrior(2), generator=torch.Generator().manual_seed(0))
    assert torch.equal(flat.covariance, again.covariance)

    class Seeing(PastPrior):
        name = "seeing-of-the-moments"

        def distribution(self, history, observation=None):
            source = super().distribution(history)
            return replace(source, loc=source.loc + observation[:, -1:, :1])

    fits, seen = [], torch.randn(8, 2, 3)
    for key in ("observation", "seen"):
        data = windows.copy().set(key, seen)
        generator = torch.Generator().manual_seed(0)
        fits.append(SourceMoments.fit(data, Seeing(2), observation_key=key, generator=generator).source_mean)
    assert torch.equal(*fits) and not torch.equal(fits[0], flat.source_mean)
