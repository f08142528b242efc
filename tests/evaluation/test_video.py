from typing import ClassVar

import pytest
import torch

pytest.importorskip("robosuite")

import gymnasium
import numpy as np

from tests.envs.test_gymnasium import Dial
from tests.errors import raises
from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.envs import RobosuiteEnv
from warmprior.envs.description import environment_description, environment_of, registered_description
from warmprior.envs.simulator import task_env_args
from warmprior.evaluation import play_episode, record_filmstrip


def test_frames_are_of_the_evaluated_episode(monkeypatch):
    torch.manual_seed(0)
    environment = environment_description(task_env_args("lift"), "ph")
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


class DrawnDial(Dial):
    """It draws pictures as bright as the steps that it took, always into the same memory."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": np.float32(2.5)}

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode, self.picture = render_mode, np.empty((8, 8, 3), np.uint8)

    def render(self):
        self.picture.fill(self.turns)
        return self.picture


def test_a_policy_of_gymnasium_is_recorded_by_its_environment(tmp_path, monkeypatch):
    av = pytest.importorskip("av")
    gymnasium.register("DrawnDial-v0", DrawnDial, max_episode_steps=4)
    monkeypatch.setitem(gymnasium.registry, "DrawnDial-v0", gymnasium.registry.pop("DrawnDial-v0"))
    recorded = {"id": "DrawnDial-v0", "kwargs": {"render_mode": "human"}, "max_episode_steps": 4}
    described = registered_description({**recorded, "success": "solved", "observation_keys": []})
    network = VelocityMLP(1, 2, 2, observation_steps=1, hidden_dim=16)
    actor = WarmPriorActor(network, GaussianPrior(2), clip=1.0, environment=described)
    video = tmp_path / "video.mp4"
    strip = record_filmstrip(actor, seed=0, frames=9, size=16, video=video, terminate_on_success=False)
    assert [int(frame[0, 0, 0]) for frame in strip.frames] == strip.steps == [0, 1, 2, 3, 4]
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.frames) == (2.5, 5)
    for mode, picture in ((None, 0), ("rgb_array", [np.zeros((8, 8, 3), np.uint8)]), ("rgb_array", 0.5)):
        monkeypatch.setattr(DrawnDial, "render", lambda self, picture=picture: picture)
        with raises(ValueError, "render_mode"):
            record_filmstrip(actor, seed=0, frames=2, env=environment_of(actor, render_mode=mode))
