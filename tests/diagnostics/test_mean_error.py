"""Errors of the mean, against sums written out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from warmprior import (
    CVAEPrior,
    ForecastPrior,
    GaussianPrior,
    HistoryPrior,
    PastPrior,
    PreviewPrior,
    StepPrior,
    WarmPriorActor,
)
from warmprior.diagnostics import mean_error, mean_revision

H, D_A = 2, 3


class Still(nn.Module):
    """Predicts its source."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, t, a, observation):
        return torch.zeros_like(a)


def windows(prior, n=6, warm=True):
    g = torch.Generator().manual_seed(0)
    p = prior.prediction_length
    mask = torch.zeros(n, p, 1, dtype=torch.bool)
    mask[:, :H] = warm
    pad = torch.zeros(n, p, dtype=torch.bool)
    pad[0, 1:] = True
    values = [torch.randn(n, p, D_A, generator=g) for _ in range(2)]
    return TensorDict(
        {
            "observation": torch.zeros(n, 1, 1),
            "vla_action": {"chunk": values[0]},
            "action_is_pad": pad,
            "prior": {"loc": values[1], "warm": mask},
        },
        [n],
    )


@pytest.mark.parametrize("prior", [PastPrior(H, sigma=0.0), PreviewPrior(H, sigma=0.3)])
def test_only_warm_positions_inside_the_episode_count(prior):
    batch = windows(prior)
    found = mean_error(WarmPriorActor(Still(), prior), batch, nfe=1)
    difference = (batch["prior", "loc"] - batch["vla_action", "chunk"])[:, :H]
    squares = [
        float(difference[i, p].square().mean()) for i in range(6) for p in range(H) if i or not p
    ]
    assert found.target == pytest.approx(math.sqrt(sum(squares) / len(squares)))
    # What does not move predicts mean and noise.
    assert found.revision == pytest.approx(prior.sigma, rel=0.3, abs=1e-7)


def test_without_a_mean_there_is_no_error():
    found = mean_error(
        WarmPriorActor(Still(), GaussianPrior(H)), windows(GaussianPrior(H), warm=False)
    )
    assert math.isnan(found.target) and math.isnan(found.revision)
    rollout = TensorDict({"vla_action": {"chunk": torch.zeros(3, H, 1)}}, [3])
    rollout["next"] = TensorDict({"executed_steps": torch.full((3, 1), H)}, [3])
    assert math.isnan(mean_revision(rollout, GaussianPrior(H)))


def test_the_mean_is_that_of_the_source():
    """Of a learned one wherever it is, and none where the mean only conditions or enters later."""
    prior = ForecastPrior(H).sized(D_A, 1, 1)
    batch = windows(prior, warm=False)
    mean, _ = prior.distribution(
        batch["prior", "loc"], batch["prior", "warm"], batch["observation"]
    )
    counted = ~batch["action_is_pad"].unsqueeze(-1)
    squared = ((mean - batch["vla_action", "chunk"]).square() * counted).sum() / counted.sum() / D_A
    found = mean_error(WarmPriorActor(Still(), prior), batch, nfe=1)
    assert found.target == pytest.approx(float(squared.sqrt()))
    for other in (HistoryPrior(H), *(k(H).sized(D_A, 1, 1) for k in (CVAEPrior, StepPrior))):
        actor = WarmPriorActor(Still(), other, observation_key="observation")
        assert math.isnan(mean_error(actor, windows(other), nfe=1).target)
    chunks = [[1.0, 2.0], [4.0, 8.0]]
    decided = rollout(chunks, [2, 2], [False, False])
    for other in (ForecastPrior(H).sized(1, 1, 1), HistoryPrior(H)):
        assert math.isnan(mean_revision(decided, other))


def rollout(chunks, executed, done):
    return TensorDict(
        {
            "vla_action": {"chunk": torch.tensor(chunks)[..., None]},
            "next": {
                "executed_steps": torch.tensor(executed)[:, None],
                "done": torch.tensor(done)[:, None],
            },
        },
        [len(chunks)],
    )


def test_a_revision_is_that_of_the_mean_carried_on():
    """WP-Past over two episodes, the second of which begins without a mean."""
    chunks = [[1.0, 2.0], [4.0, 8.0], [0.0, 0.0], [5.0, 5.0], [5.0, 6.0]]
    decided = rollout(chunks, [2, 1, 2, 2, 2], [False, False, True, False, False])
    # Means: -, (1, 2), (2, 4), - (reset), (5, 5).
    squares = [9.0, 36.0, 4.0, 16.0, 0.0, 1.0]
    assert mean_revision(decided, PastPrior(H)) == pytest.approx(math.sqrt(sum(squares) / 6))


def test_a_preview_is_compared_where_it_was_executed():
    chunks = [[0.0, 1.0, 2.0, 3.0], [2.0, 3.0, 4.0, 7.0], [9.0, 9.0, 0.0, 0.0]]
    decided = rollout(chunks, [2, 1, 2], [False] * 3)
    # Means: -, (2, 3), and after one executed action (3, 4).
    squares = [0.0, 0.0, 36.0, 25.0]
    assert mean_revision(decided, PreviewPrior(H)) == pytest.approx(math.sqrt(sum(squares) / 4))


def test_bad_input_is_named():
    decided = rollout([[0.0, 1.0]], [2], [False])
    with pytest.raises(ValueError, match="of one environment"):
        mean_revision(decided.expand(2, 1), PastPrior(H))
    with pytest.raises(KeyError, match="executed_steps"):
        mean_revision(decided.exclude("next"), PastPrior(H))
    with pytest.raises(KeyError, match="chunk"):
        batch = windows(PastPrior(H)).exclude(("vla_action", "chunk"))
        mean_error(WarmPriorActor(Still(), PastPrior(H)), batch)
