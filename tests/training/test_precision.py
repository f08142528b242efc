"""Training whose matrix products are bfloat16, and everything else float32."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import nn

from tests.training.cloning_parts import CONFIG, actor_for, dataset, mlp, same, training, weights
from warmprior import FlowMatchingLoss, PastPrior, SelfDistillationLoss, window_replay_buffer
from warmprior.training import load_policy, precondition
from warmprior.training.checkpoint import load_state

BF16 = dataclasses.replace(CONFIG, precision="bf16")


def preconditioned():
    prior = PastPrior(4)
    return actor_for(prior, precondition(mlp(), dataset(), prior))


@pytest.mark.parametrize("make", [actor_for, preconditioned])
@pytest.mark.parametrize("loss_class", [FlowMatchingLoss, SelfDistillationLoss])
def test_products_are_bf16_and_the_loss_is_close(make, loss_class):
    losses, types = [], []
    for bf16 in (False, True):
        actor = make().eval()  # without dropout, which would draw other masks
        layers = [m for m in actor.network.modules() if isinstance(m, nn.Linear)]
        generator = torch.Generator().manual_seed(0)
        loss = loss_class(actor, generator=generator)
        seen = set()
        for layer in loss.actor_network.network.modules():
            if isinstance(layer, nn.Linear):
                layer.register_forward_hook(lambda m, i, out, seen=seen: seen.add(out.dtype))
        torch.manual_seed(0)
        batch = window_replay_buffer(
            dataset(), actor.prior, batch_size=64, generator=torch.Generator().manual_seed(1)
        ).sample()
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16, cache_enabled=False):
            value = sum(loss(batch).values())
        value.backward()
        assert value.dtype == torch.float32 and layers
        assert all(p.grad.dtype == torch.float32 for p in actor.network.parameters())
        assert any(p.grad.abs().max() > 0 for p in actor.network.parameters())
        losses.append(value.item())
        types.append(seen)
    assert types == [{torch.float32}, {torch.bfloat16}]
    assert losses[1] == pytest.approx(losses[0], rel=2e-2)


def test_states_and_policies_are_float32_and_resume_is_exact(tmp_path):
    whole = training(tmp_path / "whole", BF16)
    whole.run(None)
    part = training(tmp_path / "part", BF16)
    for _ in range(14):
        part.step()
    part._save()
    again = training(tmp_path / "part", BF16)
    assert again.iteration == 14
    again.run(None)
    assert same(weights(again), weights(whole))
    tensors, _ = load_state(whole.state_path)
    assert {v.dtype for n, v in tensors.items() if "trained" in n or "exp_avg" in n} == {torch.float32}
    policy = load_policy(whole.policy_path(40))
    assert {p.dtype for p in policy.parameters()} == {torch.float32}
    plain = training(tmp_path / "plain")
    plain.run(None)
    assert not same(weights(plain), weights(whole))
