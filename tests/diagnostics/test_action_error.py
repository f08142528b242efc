"""The error of the executed actions against sums by hand."""

import pytest
import torch

from tests.diagnostics.fields import H, policy, targets
from tests.errors import raises, refuses
from warmprior import GaussianPrior, PreviewPrior
from warmprior.diagnostics import action_error, flow


def towards(t, a, observation):
    """One step ends at the observation's first entry, whatever the source."""
    return observation[:, -1, 0, None, None] - a


@pytest.mark.parametrize("prior", [GaussianPrior(H), PreviewPrior(H)], ids=str)
@pytest.mark.parametrize("split", [2, 4096])
def test_by_hand(prior, split, monkeypatch):
    monkeypatch.setattr(flow, "SPLIT", split)
    batch = targets(prior, 5)
    squares = [
        float(row["observation"][-1, 0] - value) ** 2
        for row in batch
        for position in range(H)  # not the second half of a preview
        if not row["action_is_pad"][position]
        for value in row["vla_action", "chunk"][position]
    ]
    before = batch.clone()
    found = action_error(policy(towards, prior), batch, nfes=(1,))
    assert found == {1: pytest.approx(sum(squares) / len(squares), rel=1e-5)}
    assert (batch == before).all()


def test_clips_as_the_policy_does_and_skips_what_the_policy_refuses():
    prior = GaussianPrior(H)
    batch = targets(prior, 5)
    batch["observation"][:] = 5.0
    batch["vla_action", "chunk"][:] = 1.0
    actor = policy(towards, prior, clip=2.0, max_nfe=1)
    assert action_error(actor, batch, nfes=(1, 9)) == {1: pytest.approx(1.0)}


def test_what_cannot_be_measured_is_refused():
    actor = policy(towards, max_nfe=1)
    refuses(lambda: action_error(actor, targets(GaussianPrior(H), 5), nfes=(9,)), ValueError, 1)
    actor = policy(lambda t, a, observation: torch.nan * a)
    with raises(FloatingPointError, "NaN", "NFE 1"):
        action_error(actor, targets(GaussianPrior(H), 5), nfes=(1,))
