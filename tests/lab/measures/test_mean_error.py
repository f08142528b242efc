import math

import pytest
import torch
from tensordict import TensorDict

from lab.measures.source_errors import error_by_position, mean_error, mean_revision
from lab.methods.learned_sources import ForecastPrior
from tests.diagnostics.fields import D_A, H, policy, remember, targets
from warmprior import CVAEPrior, PastPrior, PreviewPrior


def still(t, a, observation):
    """Predicts its source."""
    return torch.zeros_like(a)


def windows(prior, warm=True):
    return remember(targets(prior, 6), torch.randn(6, prior.prediction_length, D_A), warm)


@pytest.mark.parametrize("prior", [PastPrior(H, sigma=0.0), PreviewPrior(H, sigma=0.3)])
def test_only_warm_positions_inside_the_episode_count(prior):
    batch = windows(prior)
    found = mean_error(policy(still, prior), batch, nfe=1)
    difference = (batch["history", "forecast"] - batch["vla_action", "chunk"])[:, :H]
    squares = [float(difference[i, p].square().mean()) for i in range(6) for p in range(H) if i or not p]
    assert found.target == pytest.approx(math.sqrt(sum(squares) / len(squares)))
    # What does not move predicts mean and noise.
    assert found.revision == pytest.approx(prior.sigma, rel=0.3, abs=1e-7)


def test_errors_by_position_leave_out_what_lies_behind_the_episode():
    prior = PastPrior(H, sigma=0.0)
    batch = windows(prior)
    mean, chunk = error_by_position(policy(still, prior), batch, nfe=1)
    difference = (batch["history", "forecast"] - batch["vla_action", "chunk"])[:, :H]
    counted = ~batch["action_is_pad"][:, :H]
    for k in range(H):
        expected = float(difference[:, k][counted[:, k]].square().mean().sqrt())
        assert mean[k] == chunk[k] == pytest.approx(expected)  # what does not move predicts the mean


def test_the_mean_is_that_of_the_source():
    """Of a learned one wherever it is, and none where it is no Gaussian."""
    prior = ForecastPrior(H, widths=[D_A, 4, 1])
    batch = windows(prior, warm=False)
    mean = prior.distribution(batch["history"], batch["observation"]).loc
    counted = ~batch["action_is_pad"].unsqueeze(-1)
    squared = ((mean - batch["vla_action", "chunk"]).square() * counted).sum() / counted.sum() / D_A
    found = mean_error(policy(still, prior), batch, nfe=1)
    assert found.target == pytest.approx(float(squared.sqrt()))
    other = CVAEPrior(H, widths=[D_A, 4, 1])
    found = mean_error(policy(still, other), windows(other), nfe=1)
    assert math.isnan(found.target)


def test_a_revision_counts_warm_positions():
    chunk, loc = torch.randn(2, 5, 2 * H, D_A).unbind()
    warm = torch.zeros(5, 2 * H, 1, dtype=torch.bool)
    warm[1:, :H] = True
    decided = TensorDict({"vla_action": {"chunk": chunk}, "prior": {"loc": loc, "warm": warm}}, [5])
    expected = (chunk - loc)[1:, :H].square().mean().sqrt()
    assert mean_revision(decided) == pytest.approx(float(expected))
    decided["prior", "warm"][:] = False
    assert math.isnan(mean_revision(decided))
