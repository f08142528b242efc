"""What is measured of a policy beside its success."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("tyro")

from tests.diagnostics.fields import Field, seeing_network
from tests.experiments.comparison_parts import ACTION_DIM, OBSERVATION_DIM, H, drift_problem
from warmprior import GaussianPrior, HistoryObservation, WarmPriorActor, keys
from warmprior.diagnostics import SharedObservations, memory_gain
from warmprior.experiments.measures import measure


def test_the_memory_gain_of_a_network_that_sees_the_history_is_that_of_what_it_is_told():
    told = slice(OBSERVATION_DIM, OBSERVATION_DIM + H * ACTION_DIM)
    follows = Field(lambda t, a, o: 0.4 * o[:, -1, told].unflatten(-1, (H, ACTION_DIM)) - a)
    policy = WarmPriorActor(follows, GaussianPrior(H), observation_key=keys.CONDITIONED)
    found = measure(policy, drift_problem().data, (1,), chunk_length=H, observation_steps=2)
    assert found[1]["memory_gain"] == pytest.approx(0.4, rel=1e-4)


def test_images_that_stand_beside_the_history_are_encoded_with_it():
    prior, n = GaussianPrior(H), 20
    width = OBSERVATION_DIM + HistoryObservation.width(H, ACTION_DIM)
    network = seeing_network(ACTION_DIM, width, H)
    data = TensorDict(
        {
            "observation": {
                "state": torch.randn(n, OBSERVATION_DIM),
                "cam_image": torch.randint(0, 255, (n, 3, 16, 16), dtype=torch.uint8),
            },
            "action": torch.randn(n, ACTION_DIM),
            "episode": torch.arange(n) // 10,
        },
        [n],
    )
    policy = WarmPriorActor(network, prior, observation_key=keys.CONDITIONED)
    found = measure(policy, data, (1,), chunk_length=H, observation_steps=2)[1]["memory_gain"]
    shared = SharedObservations(data, H, observation_steps=2)
    gain = memory_gain(policy, shared.windows(prior, see_history=True))[1]
    assert found == pytest.approx(gain) and found != 0
