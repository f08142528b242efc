"""The pictures are of the very episode that was evaluated."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from warmprior import PastPrior, VelocityMLP, WarmPriorActor
from warmprior.training import play_episode, record_filmstrip

pytest.importorskip("robosuite")

from warmprior.envs import RobosuiteEnv
from warmprior.envs.description import environment_description, environment_of
from warmprior.envs.simulator import task_env_args


def test_frames_are_of_the_evaluated_episode(monkeypatch):
    torch.manual_seed(0)
    environment = environment_description(task_env_args("lift"), "ph", 2)
    network = VelocityMLP(7, 19, 4, hidden_dim=16)
    actor = WarmPriorActor(network, PastPrior(4), clip=1.0, environment=environment)
    states = []

    def render(self, size, state):
        states.append(state)
        return np.zeros((size, size, 3), dtype=np.uint8)

    monkeypatch.setattr(RobosuiteEnv, "render_frame", render)
    monkeypatch.setattr("warmprior.envs.rendering.require_rendering", lambda: None)
    strips = {
        (seed, policy_seed): record_filmstrip(
            actor, seed=seed, nfe=2, policy_seed=policy_seed, frames=3, horizon=20
        )
        for seed, policy_seed in ((5, 0), (5, 1))
    }
    assert [strip.steps for strip in strips.values()] == [[0, 10, 20]] * 2
    env = environment_of(actor, horizon=20)
    for (seed, policy_seed), strip in strips.items():
        episode = play_episode(actor, env, seed, nfe=2, policy_seed=policy_seed)
        assert (strip.success, strip.steps[-1]) == (episode.success, episode.steps)
        # The simulator ends where the evaluated one does, to the bit.
        assert np.array_equal(states[2 if policy_seed == 0 else 5], env.base_env.loop.state())
    assert not np.array_equal(states[2], states[5])  # another policy seed, another noise
    assert actor.sampler.generator is None
