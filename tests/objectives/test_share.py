"""Shares of a batch, each computed apart: their mean is the loss of the whole, and so are its gradients."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from warmprior import FlowMatchingLoss, PastPrior, VelocityMLP, WarmPriorActor, window_replay_buffer
from warmprior.modules import OTPrior


def batch_of(size, prior, padded=True):
    generator = torch.Generator().manual_seed(0)
    data = TensorDict(
        {
            "observation": torch.randn(60, 3, generator=generator),
            "action": torch.randn(60, 2, generator=generator),
            "episode": torch.arange(60) // 6,
        },
        [60],
    )
    data = data.apply(lambda value: value.double() if value.is_floating_point() else value)
    batch = window_replay_buffer(data, prior, batch_size=size, generator=generator).sample()
    return batch if padded else batch.exclude("action_is_pad")


def losses_of(batch, prior, share=(0, 1), **options):
    """Losses by name, and gradients."""
    torch.manual_seed(0)
    actor = WarmPriorActor(VelocityMLP(2, 3, 4, hidden_dim=8).double(), prior)
    generator = torch.Generator().manual_seed(1)
    loss = FlowMatchingLoss(actor, generator=generator, share=share, **options)
    found = loss(batch)
    sum(value.sum() for value in found.values()).backward()
    return found.detach(), [p.grad for p in actor.network.parameters()]


@pytest.mark.parametrize("prior", [PastPrior(4), OTPrior(4)])
@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize("number", [2, 3, 8])
def test_the_mean_of_the_shares_is_the_whole(prior, padded, reduction, number):
    """Three do not divide eight windows; eight are more than the two that are distilled."""
    batch = batch_of(8, prior, padded)
    options = {"reduction": reduction, "self_distillation": 0.5}
    whole, gradients = losses_of(batch, prior, **options)
    parts = [losses_of(batch, prior, (rank, number), **options) for rank in range(number)]
    assert len({float(part["loss_flow_matching"]) for part, _ in parts}) == number
    for name, value in whole.items():
        mean = torch.stack([part[name] for part, _ in parts]).mean(0)
        torch.testing.assert_close(mean, value, rtol=1e-12, atol=1e-12)
    for i, gradient in enumerate(gradients):
        mean = torch.stack([grads[i] for _, grads in parts]).mean(0)
        torch.testing.assert_close(mean, gradient, rtol=1e-10, atol=1e-12)


def test_unreduced_errors_are_those_of_the_share():
    prior = PastPrior(4)
    batch = batch_of(9, prior)
    whole, _ = losses_of(batch, prior, reduction="none")
    for rank in range(2):
        part, _ = losses_of(batch, prior, (rank, 2), reduction="none")
        expected = whole["loss_flow_matching"][rank::2]
        torch.testing.assert_close(part["loss_flow_matching"], expected)


@pytest.mark.parametrize("share", [(0, 0), (2, 2), (-1, 2)])
def test_what_is_no_share(share):
    actor = WarmPriorActor(VelocityMLP(2, 3, 4, hidden_dim=8), PastPrior(4))
    with pytest.raises(ValueError, match="share must be"):
        FlowMatchingLoss(actor, share=share)
