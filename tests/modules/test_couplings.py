"""Pairings of source and data, against brute force and closed forms."""

from __future__ import annotations

from itertools import permutations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from warmprior import GaussianPrior, OTPrior, PastPrior, ReflowPrior, VelocityMLP, WarmPriorActor
from warmprior.modules import SourceMoments
from warmprior.training import BehaviourCloning, TrainingConfig

pytest.importorskip("scipy")

H = 2


@settings(max_examples=25, deadline=None)
@given(n=st.integers(2, 5), weight=st.sampled_from([0.0, 0.5, 100.0]), seed=st.integers(0, 1000))
def test_the_plan_is_the_best_of_all_permutations(n, weight, seed):
    g = torch.Generator().manual_seed(seed)
    a0, a1 = (torch.randn(n, H, 3, generator=g) for _ in range(2))
    seen = torch.randn(n, 2, 4, generator=g)
    paired, target = OTPrior(H, observation_weight=weight).couple(a0, a1, observation=seen)
    assert target is a1

    def cost(order):
        o = list(order)
        moved = (a0[o] - a1).square().sum() + weight * (seen[o] - seen).square().sum()
        return float(moved)

    best = min(permutations(range(n)), key=cost)
    assert torch.equal(paired, a0[list(best)])


def test_dear_observations_leave_everything_in_its_place():
    a0, a1 = torch.randn(300, H, 1), torch.randn(300, H, 1)
    seen = torch.arange(300.0).view(300, 1, 1)
    same, _ = OTPrior(H, observation_weight=1e6).couple(a0, a1, observation=seen)
    assert torch.equal(same, a0)
    free, _ = OTPrior(H, observation_weight=0.0).couple(a0, a1, observation=seen)
    assert torch.equal(free.flatten(1).sum(1).sort()[0], a0.flatten(1).sum(1).sort()[0])
    # Groups of at most 256, of nearly one size: each half is paired within itself.
    assert set(free[150:, 0, 0].tolist()) == set(a0[150:, 0, 0].tolist())
    assert float((free - a1).square().mean()) < 0.5 * float((a0 - a1).square().mean())


def test_no_window_is_left_over():
    a0, a1 = torch.randn(257, 1, 1), torch.randn(257, 1, 1)
    a0[-1], a1[-1] = 100.0, -100.0
    paired, _ = OTPrior(1, observation_weight=0.0).couple(a0, a1)
    assert float(paired[-1]) < 100.0


def test_batch_dimensions_stay():
    a0, a1, seen = torch.randn(2, 3, H, 1), torch.randn(2, 3, H, 1), torch.randn(2, 3, 1, 4)
    paired, _ = OTPrior(H).couple(a0, a1, observation=seen)
    flat, _ = OTPrior(H).couple(
        *(x.flatten(0, 1) for x in (a0, a1)), observation=seen.flatten(0, 1)
    )
    assert torch.equal(paired.flatten(0, 1), flat)


def demonstrations():
    g = torch.Generator().manual_seed(0)
    data = {
        "observation": torch.randn(400, 3, generator=g),
        "action": torch.randn(400, 1, generator=g),
        "episode": torch.arange(400) // 40,
    }
    return TensorDict(data, [400])


def test_moments_are_those_of_the_pairs():
    """Paired without regard of the observation, sources come close to their targets."""
    from warmprior import window_replay_buffer

    correlations = []
    for prior in (GaussianPrior(1), OTPrior(1, observation_weight=0.0)):
        g = torch.Generator().manual_seed(0)
        buffer = window_replay_buffer(demonstrations(), prior, batch_size=256, generator=g)
        moments = SourceMoments.fit(buffer, prior, samples=2048, generator=g)
        deviation = (moments.source_variance * moments.target_variance).sqrt()
        correlations.append(float((moments.covariance / deviation).mean()))
    assert abs(correlations[0]) < 0.1 and correlations[1] > 0.95


def test_batches_of_one_are_refused_before_training(tmp_path):
    prior = OTPrior(H)
    with pytest.raises(ValueError, match="at least 2"):
        prior.couple(torch.zeros(1, H, 1), torch.zeros(1, H, 1), observation=torch.zeros(1, 1, 3))
    with pytest.raises(ValueError, match="observation_weight=0"):
        prior.couple(torch.zeros(2, H, 1), torch.zeros(2, H, 1))
    nested = TensorDict({"pose": torch.zeros(2, 1, 3)}, [2])
    with pytest.raises(ValueError, match=r"ot compares.*nested.*observation_weight=0"):
        prior.couple(torch.zeros(2, H, 1), torch.zeros(2, H, 1), observation=nested)
    for weight in (-1.0, float("inf"), float("nan"), True, "abc"):
        with pytest.raises(ValueError, match="observation_weight"):
            OTPrior(H, observation_weight=weight)
    actor = WarmPriorActor(VelocityMLP(1, 3, H, 1, hidden_dim=8), prior)
    config = TrainingConfig(iterations=1, batch_size=1)
    with pytest.raises(ValueError, match="batches of at least 2, got 1"):
        BehaviourCloning(actor, demonstrations(), config, tmp_path, observation_steps=1)


class Known(nn.Module):
    """``v = o - a``: Euler steps shrink the way to the observation by ``1 - 1/n`` each."""

    def forward(self, t, a, observation):
        return observation[:, :1, :1] - a


def test_reflow_pairs_sources_with_the_ends_of_the_teachers_flow():
    prior = ReflowPrior(H, teacher_nfe=4)
    a0, a1 = torch.randn(5, H, 1), torch.zeros(5, H, 1)
    seen = torch.randn(5, 1, 3)
    with pytest.raises(ValueError, match="no teacher"):
        prior.couple(a0, a1, observation=seen)
    with pytest.raises(ValueError, match="learns from gaussian"):
        prior.learn_from(WarmPriorActor(Known(), PastPrior(H)))
    prior.learn_from(WarmPriorActor(Known(), GaussianPrior(H)))
    same, target = prior.couple(a0, a1, observation=seen)
    assert same is a0
    level = seen[:, :, :1]
    torch.testing.assert_close(target, level + 0.75**4 * (a0 - level))
    assert prior.config() == {"name": "reflow", "chunk_length": H, "teacher_nfe": 4}
    with pytest.raises(ValueError, match=f"chunks of {H} actions, but its teacher of {H + 1}"):
        prior.learn_from(WarmPriorActor(Known(), GaussianPrior(H + 1)))
    for nfe in (0, 2.5, True):
        with pytest.raises(ValueError, match="teacher_nfe"):
            ReflowPrior(H, teacher_nfe=nfe)
    with pytest.raises(ValueError, match="has no teacher"):
        GaussianPrior(H).learn_from(None)


def test_a_teacher_follows_the_data_to_their_device():
    prior = ReflowPrior(H)
    prior.learn_from(WarmPriorActor(VelocityMLP(1, 3, H, 1, hidden_dim=8), GaussianPrior(H)))
    shapes = (5, H, 1), (5, H, 1), (5, 1, 3)
    for device in ("cpu", "meta"):
        a0, a1, seen = (torch.zeros(shape, device=device) for shape in shapes)
        assert prior.couple(a0, a1, observation=seen)[1].device.type == device
