"""What follows from where the grippers are, against scipy and numpy's least squares."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises
from warmprior import (
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    RestingJoints,
    RestingPose,
    RestingTrend,
    SourceMoments,
    VelocityMLP,
    VelocityNetwork,
)
from warmprior.envs import absolute_actions
from warmprior.history import window_history, without
from warmprior.modules.registry import from_config

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

P, D_A, TO, D_O = 4, 10, 2, 9
COLUMNS = torch.tensor([[1, 2, 3, 5, 6, 7, 8]])


class Nothing(torch.nn.Module):
    """Untrained: answers zero."""

    prediction_length, action_dim, observation_steps, observation_dim = P, D_A, TO, D_O

    def config(self):
        return {}

    def forward(self, t, a, observation):
        return torch.zeros_like(a)


def observations(n, seed=0):
    """Raw observations ``[n, d_o]`` of one arm."""
    rng = np.random.default_rng(seed)
    found = rng.normal(size=(n, D_O))
    found[:, 1:4] = rng.normal(0.3, 0.2, (n, 3))
    found[:, 5:] = Rotation.random(n, random_state=seed).as_quat()
    return torch.from_numpy(found).float()


def normalizer():
    generator = torch.Generator().manual_seed(0)
    low = {"observation": -1 - torch.rand(D_O, generator=generator), "action": -torch.ones(D_A)}
    return Normalizer(low, {"observation": torch.ones(D_O), "action": 1.5 * torch.ones(D_A)})


@pytest.mark.parametrize("sign", [1, -1])
def test_the_resting_action_is_that_of_no_delta(sign):
    raw, units = observations(30), normalizer()
    raw[:, 5:] *= sign  # both quaternions of a rotation
    expected = absolute_actions(torch.zeros(30, 7), raw[:, 1:4], raw[:, 5:])
    data = units.normalize(TensorDict({"observation": raw, "action": expected}, [30]))
    found = RestingPose(COLUMNS, units)(data["observation"])
    torch.testing.assert_close(found[:, :9], data["action"][:, :9], rtol=0, atol=1e-5)
    assert (found[:, 9] == 0).all()
    wider = torch.cat([data["observation"], torch.full((30, 4), math.nan)], -1)
    torch.testing.assert_close(RestingPose(COLUMNS, units)(wider), found)


def windows(n=4000, noise=0.1, warm=False):
    """Targets that follow from the pose up to noise, at positions that are padded now and then."""
    rng = np.random.default_rng(0)
    raw = torch.stack([observations(n, 1), observations(n, 2)], 1)
    slopes = torch.from_numpy(rng.uniform(0.5, 1.5, (P, D_A))).float()
    resting = RestingPose(COLUMNS)(raw[:, -1])
    target = 1 + resting[:, None] * slopes
    target = target + noise * torch.from_numpy(rng.normal(size=(n, P, D_A))).float()
    pad = torch.from_numpy(rng.random((n, P)).cumsum(1) > 1.8)
    target[pad] = 50.0
    is_warm = warm & (torch.arange(n) % 2 == 0)
    history = window_history(target * ~pad[..., None], torch.full((n, 1), P), target, P)
    made = {
        "observation": raw,
        ("vla_action", "chunk"): target,
        "action_is_pad": pad,
        "history": without(history, ~is_warm),
    }
    return TensorDict(made, [n])


def fit(batch, prior):
    generator = torch.Generator().manual_seed(0)
    return RestingTrend.fit(batch, prior, RestingPose(COLUMNS), generator=generator)


def test_against_least_squares():
    batch = windows()
    trend = fit(batch.copy().set("action_is_pad", batch["action_is_pad"].long()), GaussianPrior(P))
    resting = RestingPose(COLUMNS)(batch["observation"][:, -1]).double().numpy()
    for position in range(P):
        kept = ~batch["action_is_pad"][:, position].numpy()
        goal = batch["vla_action", "chunk"][:, position].double().numpy()[kept]
        for dim in range(D_A - 1):
            slope, _ = np.polyfit(resting[kept, dim], goal[:, dim], 1)
            assert trend.target[position, dim].item() == pytest.approx(slope, abs=1e-4)
    assert (trend.target[:, -1] == 0).all(), "the gripper's command is not where it is"
    source, target = trend(batch["observation"])
    assert source.std() < 0.05, "a source of noise follows from nothing"
    assert target.shape == batch["vla_action", "chunk"].shape


@pytest.mark.parametrize("prior", [GaussianPrior(P), PastPrior(P, sigma=0.5)])
def test_preconditioning_leaves_the_remainder(prior):
    """Untrained, a network is as good as the best linear prediction from point and pose."""
    batch = windows(10_000, warm=isinstance(prior, PastPrior))
    trend = fit(batch, prior)
    generator = torch.Generator().manual_seed(1)
    moments = SourceMoments.fit(batch, prior, trend=trend, generator=generator)
    a0 = prior.distribution(batch["history"]).sample(generator)
    a1, observation = batch["vla_action", "chunk"], batch["observation"]
    resting = RestingPose(COLUMNS)(observation[:, -1]).numpy()
    network = PreconditionedNetwork(Nothing(), moments=moments, trend=trend)
    kept = ~batch["action_is_pad"][:, 0].numpy()
    for time in (0.0, 0.5):
        a_t = (1 - time) * a0 + time * a1
        velocity = network(torch.full((len(batch),), time), a_t, observation).numpy()
        for dim in (0, 4):
            columns = np.column_stack([resting[:, dim], a_t[:, 0, dim], np.ones(len(batch))])
            goal = (a1 - a0)[:, 0, dim].numpy()
            best = columns[kept] @ np.linalg.lstsq(columns[kept], goal[kept], rcond=None)[0]
            mine = np.square(velocity[kept, 0, dim] - goal[kept]).mean()
            assert mine <= 1.02 * np.square(best - goal[kept]).mean()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_cast_trend_keeps_its_units(dtype):
    """The joints are far from zero, where half precision would lose their differences."""
    joints = TensorDict(
        {"observation": 1e5 + 50 * torch.randn(40, 2), "action": 1e5 + 50 * torch.randn(40, 2)}, [40]
    )
    rest = RestingJoints([0, 1], units := Normalizer.fit(joints))
    normalised = units.normalize(joints)["observation"]
    expected = rest(normalised)
    torch.testing.assert_close(rest.to(dtype)(normalised.to(dtype)).float(), expected, atol=0.02, rtol=0)
    trend = RestingTrend(rest, torch.zeros(2), torch.zeros(4, 2), torch.ones(4, 2)).to(dtype)
    assert {part.dtype for part in trend(normalised.to(dtype).unsqueeze(1))} == {dtype}


def test_source_and_target_have_one_length():
    with raises(ValueError, "target", "[3, 2]", "[4, 2]"):
        RestingTrend(RestingJoints([0, 1]), torch.zeros(2), torch.zeros(4, 2), torch.zeros(3, 2))
    with raises(ValueError, "target", "NaN"):
        RestingTrend(RestingJoints([0, 1]), torch.zeros(2), torch.zeros(4, 2), torch.full((4, 2), torch.nan))


JOINTS = [1, 2, -1, 0, 3, 4, 5, 6, 7, -1]


@pytest.mark.parametrize("rest", [RestingPose(COLUMNS, normalizer()), RestingJoints(JOINTS, normalizer())])
def test_config_and_state_bring_it_back(rest):
    batch, prior = windows(200), GaussianPrior(P)
    trend = RestingTrend.fit(batch, prior, rest)
    moments = SourceMoments.fit(batch, prior, trend=trend)
    mlp = VelocityMLP(D_A, D_O, P, TO, hidden_dim=8)
    network = PreconditionedNetwork(mlp, moments=moments, trend=trend)
    again = from_config(VelocityNetwork, network.config())
    again.load_state_dict(network.state_dict())
    inputs = torch.rand(200), batch["vla_action", "chunk"], batch["observation"]
    assert torch.equal(network(*inputs), again(*inputs))
    without = PreconditionedNetwork(mlp, moments=moments)
    assert without.config()["trend"] is None
    assert not torch.equal(network(*inputs), without(*inputs))
