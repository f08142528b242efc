"""Pairings of source and data, against brute force and closed forms."""

from itertools import permutations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from tests.errors import raises, refuses
from tests.objectives.test_flow_matching import actor_for, sample
from tests.toy_env import demonstrations, mlp_actor
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    OTCoupling,
    ReflowCoupling,
    SourceMoments,
    WarmPriorActor,
    window_replay_buffer,
)

pytest.importorskip("scipy")

H = 2


@settings(max_examples=25, deadline=None)
@given(n=st.integers(2, 5), weight=st.sampled_from([0.0, 0.5, 100.0]), seed=st.integers(0, 1000))
def test_the_plan_is_the_best_of_all_permutations(n, weight, seed):
    g = torch.Generator().manual_seed(seed)
    a0, a1 = (torch.randn(n, H, 3, generator=g) for _ in range(2))
    seen = torch.randn(n, 2, 4, generator=g)
    paired, target = OTCoupling(weight)(a0, a1, seen)
    assert target is a1

    def cost(o):
        return float((a0[o] - a1).square().sum() + weight * (seen[o] - seen).square().sum())

    assert torch.equal(paired, a0[min(map(list, permutations(range(n))), key=cost)])


def test_dear_observations_leave_everything_in_its_place():
    a0, a1 = torch.randn(300, H, 1), torch.randn(300, H, 1)
    seen = torch.arange(300.0).view(300, 1, 1)
    same, _ = OTCoupling(1e6)(a0, a1, seen)
    assert torch.equal(same, a0)
    free, _ = OTCoupling(0.0)(a0, a1, seen)
    assert torch.equal(free.flatten(1).sum(1).sort()[0], a0.flatten(1).sum(1).sort()[0])
    # Groups of at most 256, of nearly one size: each half is paired within itself.
    assert set(free[150:, 0, 0].tolist()) == set(a0[150:, 0, 0].tolist())
    assert float((free - a1).square().mean()) < 0.5 * float((a0 - a1).square().mean())


def test_moments_are_those_of_the_pairs():
    """Paired without regard of the observation, sources come close to their targets."""
    prior, correlations = GaussianPrior(1), []
    for coupling in (None, OTCoupling(0.0)):
        g = torch.Generator().manual_seed(0)
        buffer = window_replay_buffer(demonstrations(400, 40, d_a=1), prior, batch_size=256, generator=g)
        moments = SourceMoments.fit(buffer, prior, coupling=coupling, samples=2048, generator=g)
        deviation = (moments.source_variance * moments.target_variance).sqrt()
        correlations.append(float((moments.covariance / deviation).mean()))
    assert abs(correlations[0]) < 0.1 and correlations[1] > 0.95


def test_what_cannot_be_paired():
    couple, chunk = OTCoupling(), torch.zeros(2, H, 1)
    refuses(lambda: couple(chunk[:1], chunk[:1], torch.zeros(1, 1, 3)), ValueError, 2)
    for seen in (None, TensorDict({"pose": torch.zeros(2, 3)}, [2])):
        with raises(ValueError, "observation_weight=0"):
            couple(chunk, chunk, seen)
        OTCoupling(0.0)(chunk, chunk, seen)
    for weight in (-1.0, float("inf"), float("nan"), True, "abc"):
        with raises(ValueError, "observation_weight"):
            OTCoupling(weight)


class Known(nn.Module):
    """``v = o - a``: Euler steps shrink the way to the observation by ``1 - 1/n`` each."""

    def forward(self, t, a, observation):
        return observation[:, :1, :1] - a


def test_reflow_pairs_sources_with_the_ends_of_the_teachers_flow():
    # The steps of the teacher's own evaluations do not matter.
    teacher = WarmPriorActor(Known(), GaussianPrior(H), solver="heun", grid="dense-jump:0.9")
    couple = ReflowCoupling(teacher, nfe=4)
    a0, a1, seen = torch.randn(5, H, 1), torch.zeros(5, H, 1), torch.randn(5, 1, 3)
    same, target = couple(a0, a1, seen)
    assert same is a0
    level = seen[:, :, :1]
    torch.testing.assert_close(target, level + 0.75**4 * (a0 - level))
    refuses(lambda: couple(torch.zeros(5, H + 1, 1), a1, seen), ValueError, H + 1, H)
    for nfe in (0, 2.5, True):
        with raises(ValueError, "nfe"):
            ReflowCoupling(couple.teacher, nfe=nfe)


def test_a_teacher_is_frozen_and_follows_the_data_to_their_device():
    actor = mlp_actor(GaussianPrior(H), 1, 3, steps=1)
    couple = ReflowCoupling(actor)
    assert not couple.teacher.training and not any(p.requires_grad for p in actor.parameters())
    for device in ("cpu", "meta"):
        a0, a1, seen = (torch.zeros(s, device=device) for s in ((5, H, 1), (5, H, 1), (5, 1, 3)))
        assert couple(a0, a1, seen)[1].device.type == device


def test_the_coupling_reaches_the_loss():
    """Sources drawn first, paired with targets in their order, times after them."""
    prior = GaussianPrior(3)
    actor, data = actor_for(prior), sample(prior, 16)

    def reversed_(a0, a1, observation):
        assert torch.equal(observation, data["observation"])
        return a0.flip(0), a1

    generator = torch.Generator().manual_seed(3)
    loss = FlowMatchingLoss(actor, coupling=reversed_, generator=generator)
    found = loss(data)["loss_flow_matching"]
    generator, target = torch.Generator().manual_seed(3), data["vla_action", "chunk"]
    a0 = torch.randn(target.shape, generator=generator).flip(0)
    t = torch.rand(16, generator=generator)
    a_t = a0 + t[:, None, None] * (target - a0)
    error = actor.network(t, a_t, data["observation"]) - (target - a0)
    torch.testing.assert_close(found, error.square()[~data["action_is_pad"]].mean())
