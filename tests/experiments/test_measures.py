"""What is measured of a policy beside its success."""

from __future__ import annotations

import pytest

pytest.importorskip("tyro")

from tests.diagnostics.fields import Field
from tests.experiments.comparison_parts import ACTION_DIM, OBSERVATION_DIM, H, drift_problem
from warmprior import HistoryPrior, WarmPriorActor
from warmprior.experiments.measures import measure


def test_the_memory_gain_of_a_network_that_sees_the_mean_is_that_of_what_it_is_told():
    told = slice(OBSERVATION_DIM, OBSERVATION_DIM + H * ACTION_DIM)
    follows = Field(lambda t, a, o: 0.4 * o[:, -1, told].unflatten(-1, (H, ACTION_DIM)) - a)
    policy = WarmPriorActor(follows, HistoryPrior(H))
    found = measure(policy, drift_problem().data, (1,), chunk_length=H, observation_steps=2)
    assert found[1]["memory_gain"] == pytest.approx(0.4, rel=1e-4)
