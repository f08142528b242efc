"""The error of the executed actions against sums by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from warmprior import GaussianPrior, PreviewPrior, WarmPriorActor
from warmprior.diagnostics import action_error
from warmprior.history import cold_history

H, D_A = 3, 2


class Towards(nn.Module):
    """One step ends at the observation's first entry, whatever the source."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, t, a, observation):
        return observation[:, -1, 0, None, None] - a + self.unused


def windows(prior, n=5):
    generator = torch.Generator().manual_seed(0)
    shape = (n, prior.prediction_length, D_A)
    pad = torch.zeros(shape[:2], dtype=torch.bool)
    pad[-1, 1:] = True
    return TensorDict(
        {
            "observation": torch.randn(n, 2, 4, generator=generator),
            "vla_action": {"chunk": torch.randn(shape, generator=generator)},
            "history": cold_history([n], H, *shape[1:]),
            "action_is_pad": pad,
        },
        [n],
    )


@pytest.mark.parametrize("prior", [GaussianPrior(H), PreviewPrior(H)], ids=str)
@pytest.mark.parametrize("split", [2, 4096])
def test_by_hand(prior, split):
    batch = windows(prior)
    total, count = 0.0, 0
    for row in batch:
        for position in range(H):  # not the second half of a preview
            if not row["action_is_pad"][position]:
                for value in row["vla_action", "chunk"][position]:
                    total += float(row["observation"][-1, 0] - value) ** 2
                    count += 1
    before = batch.clone()
    found = action_error(WarmPriorActor(Towards(), prior), batch, nfes=(1,), split=split)
    assert found == {1: pytest.approx(total / count, rel=1e-5)}
    assert (batch == before).all()


def test_clips_as_the_policy_does_and_skips_what_the_policy_refuses():
    prior = GaussianPrior(H)
    batch = windows(prior)
    batch["observation"][:] = 5.0
    batch["vla_action", "chunk"][:] = 1.0
    policy = WarmPriorActor(Towards(), prior, clip=2.0, max_nfe=1)
    assert action_error(policy, batch, nfes=(1, 9)) == {1: pytest.approx(1.0)}


def test_what_cannot_be_measured_is_refused():
    policy = WarmPriorActor(Towards(), GaussianPrior(H), max_nfe=1)
    with pytest.raises(ValueError, match="has none: add NFE 1"):
        action_error(policy, windows(GaussianPrior(H)), nfes=(9,))
    policy = WarmPriorActor(Towards(), GaussianPrior(H))
    with torch.no_grad():
        policy.network.unused.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="at NFE 1 a prediction is NaN"):
        action_error(policy, windows(GaussianPrior(H)), nfes=(1,))
