"""What follows linearly from the observation, against numpy's least squares."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from warmprior import (
    GaussianPrior,
    ObservationTrend,
    PastPrior,
    PreconditionedNetwork,
    SourceMoments,
    VelocityMLP,
    VelocityNetwork,
)

P, D_A, TO, D_O = 4, 2, 2, 3


class Nothing(torch.nn.Module):
    """Untrained: answers zero."""

    prediction_length, action_dim, observation_steps, observation_dim = P, D_A, TO, D_O

    def config(self):
        return {}

    def forward(self, t, a, observation):
        return torch.zeros_like(a)


def windows(n=4000, noise=0.1, warm=False):
    """Targets that follow from the observation up to noise, at positions that are padded now and then."""
    rng = np.random.default_rng(0)
    observation = rng.normal(0.3, 0.5, (n, TO, D_O))
    weight = rng.normal(size=(TO * D_O, P * D_A))
    target = 1 + observation.reshape(n, -1) @ weight + noise * rng.normal(size=(n, P * D_A))
    pad = rng.random((n, P)).cumsum(1) > 1.8
    target = target.reshape(n, P, D_A)
    target[pad] = 50.0
    made = {
        "observation": observation,
        ("vla_action", "chunk"): target,
        "action_is_pad": pad,
        ("prior", "loc"): target * ~pad[..., None],
        ("prior", "warm"): warm & (np.arange(n)[:, None, None].repeat(P, 1) % 2 == 0),
    }
    tensors = {key: torch.as_tensor(value) for key, value in made.items()}
    return TensorDict(
        {k: v if v.dtype == torch.bool else v.float() for k, v in tensors.items()}, [n]
    )


def fit(batch, prior):
    return ObservationTrend.fit(batch, prior, generator=torch.Generator().manual_seed(0))


def test_against_least_squares():
    batch = windows()
    source, target = fit(batch, GaussianPrior(P))(batch["observation"])
    inputs = batch["observation"].flatten(1).double().numpy()
    for position in range(P):
        kept = ~batch["action_is_pad"][:, position].numpy()
        columns = np.column_stack([inputs[kept], np.ones(kept.sum())])
        goal = batch["vla_action", "chunk"][:, position].double().numpy()[kept]
        expected = columns @ np.linalg.lstsq(columns, goal, rcond=None)[0]
        found = target[:, position].numpy()[kept]
        found = found - found.mean(0) + expected.mean(0)  # the moments have the means
        np.testing.assert_allclose(found, expected, atol=5e-3)  # the ridge
    assert source.std() < 0.05, "a source of noise follows from nothing"


def test_the_source_follows_too():
    """Half of the windows are warm, with the target as their mean."""
    batch = windows(noise=0.0, warm=True)
    trend = fit(batch, PastPrior(P, sigma=0.5))
    kept = ~batch["action_is_pad"].any(1)
    ratio = (trend.source / trend.target)[trend.target.abs() > 0.5]
    assert kept.any()
    np.testing.assert_allclose(ratio, 0.5, atol=0.1)


@pytest.mark.parametrize("prior", [GaussianPrior(P), PastPrior(P, sigma=0.5)])
def test_preconditioning_leaves_the_remainder(prior):
    """Untrained, a network is as good as the best linear prediction from point and observation."""
    batch = windows(20_000, warm=isinstance(prior, PastPrior))
    trend = fit(batch, prior)
    moments = SourceMoments.fit(
        batch, prior, trend=trend, generator=torch.Generator().manual_seed(1)
    )
    torch.manual_seed(2)
    a0 = prior.sample(batch["prior", "loc"], batch["prior", "warm"], None)
    a1, observation = batch["vla_action", "chunk"], batch["observation"]
    network = PreconditionedNetwork(Nothing(), moments=moments, trend=trend)
    for time in (0.0, 0.5):
        a_t = (1 - time) * a0 + time * a1
        velocity = network(torch.full((len(batch),), time), a_t, observation).detach().numpy()
        kept = ~batch["action_is_pad"][:, 0].numpy()
        columns = np.column_stack(
            [observation.flatten(1).numpy(), np.ones(len(batch)), np.zeros(len(batch))]
        )[kept]
        for dim in range(D_A):
            columns[:, -1] = a_t[:, 0, dim].numpy()[kept]
            goal = (a1 - a0)[:, 0, dim].numpy()[kept]
            best = columns @ np.linalg.lstsq(columns, goal, rcond=None)[0]
            mine = np.square(velocity[kept, 0, dim] - goal).mean()
            assert mine <= 1.03 * np.square(best - goal).mean()


def test_config_and_state_bring_it_back():
    batch, prior = windows(200), GaussianPrior(P)
    trend = fit(batch, prior)
    moments = SourceMoments.fit(batch, prior, trend=trend)
    mlp = VelocityMLP(D_A, D_O, P, TO, hidden_dim=8)
    network = PreconditionedNetwork(mlp, moments=moments, trend=trend)
    again = VelocityNetwork.from_config(network.config())
    again.load_state_dict(network.state_dict())
    inputs = torch.rand(200), batch["vla_action", "chunk"], batch["observation"]
    assert torch.equal(network(*inputs), again(*inputs))
    without = PreconditionedNetwork(mlp, moments=moments)
    assert "trend" not in without.config()
    assert not torch.equal(network(*inputs), without(*inputs))


def test_entries_after_the_observation_are_not_looked_at():
    trend = fit(windows(200), GaussianPrior(P))
    observation = torch.randn(5, TO, D_O)
    wider = torch.cat([observation, torch.full((5, TO, 7), math.nan)], -1)
    torch.testing.assert_close(trend(wider), trend(observation))


def test_refusals():
    one = torch.ones(TO * D_O, P, D_A)
    with pytest.raises(ValueError, match=r"\[To, d_o\].*got the shapes"):
        ObservationTrend(torch.ones(TO, D_O + 1), one, one)
    with pytest.raises(ValueError, match="target holds NaN"):
        ObservationTrend(torch.ones(TO, D_O), one, one * math.nan)
    trend = ObservationTrend.zero(TO, D_O, P, D_A)
    with pytest.raises(ValueError, match=r"trend is of \(To, d_o, P, d_a\)"):
        PreconditionedNetwork(VelocityMLP(D_A, D_O, P, TO + 1), trend=trend)
