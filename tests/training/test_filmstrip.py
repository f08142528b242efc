"""The pictures are of the very episode that was evaluated."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from warmprior import PastPrior, VelocityMLP, WarmPriorActor, policy_transforms
from warmprior.training import play_episode, record_filmstrip

pytest.importorskip("robosuite")

from warmprior.envs import RobosuiteEnv


def test_frames_are_of_the_evaluated_episode(monkeypatch):
    prior = PastPrior(4)
    make_env = partial(RobosuiteEnv, "lift", horizon=20)
    make_transforms = partial(policy_transforms, prior)
    torch.manual_seed(0)
    width = make_env().observation_spec["observation"].shape[-1]
    actor = WarmPriorActor(VelocityMLP(7, width, 4, hidden_dim=16), prior, clip=1.0)
    states = []

    def render(self, size):
        states.append(self.loop.state())
        return np.zeros((size, size, 3), dtype=np.uint8)

    monkeypatch.setattr(RobosuiteEnv, "render_frame", render)
    strips = {
        (seed, policy_seed): record_filmstrip(
            actor, make_env, make_transforms, seed=seed, nfe=2, policy_seed=policy_seed, frames=3
        )
        for seed, policy_seed in ((5, 0), (5, 1))
    }
    assert [strip.steps for strip in strips.values()] == [[0, 8, 20]] * 2
    env = TransformedEnv(make_env(), make_transforms())
    for (seed, policy_seed), strip in strips.items():
        episode = play_episode(actor, env, seed, nfe=2, policy_seed=policy_seed)
        assert (strip.success, strip.steps[-1]) == (episode.success, episode.steps)
        # The simulator ends where the evaluated one does, to the bit.
        assert np.array_equal(states[2 if policy_seed == 0 else 5], env.base_env.loop.state())
    assert not np.array_equal(states[2], states[5])  # another policy seed, another noise
    assert actor.sampler.generator is None
