import dataclasses

import pytest
import torch
from torch import nn

from tests.states import same
from tests.training.cloning_parts import CONFIG, actor_for, dataset, finished, mlp, weights
from warmprior import FlowMatchingLoss, PastPrior, window_replay_buffer
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state
from warmprior.training import precondition

BF16 = dataclasses.replace(CONFIG, precision="bf16")


def preconditioned():
    prior = PastPrior(4)
    return actor_for(prior, precondition(mlp(), dataset(), prior))


@pytest.mark.parametrize("make", [actor_for, preconditioned])
def test_products_are_bf16_and_the_loss_is_close(make):
    losses, types = [], []
    for bf16 in (False, True):
        actor = make().eval()  # without dropout, which would draw other masks
        layers = [m for m in actor.network.modules() if isinstance(m, nn.Linear)]
        generator = torch.Generator().manual_seed(0)
        loss = FlowMatchingLoss(actor, generator=generator)
        seen = set()
        for layer in loss.actor_network.network.modules():
            if isinstance(layer, nn.Linear):
                layer.register_forward_hook(lambda m, i, out, seen=seen: seen.add(out.dtype))
        torch.manual_seed(0)
        draws = {"batch_size": 64, "generator": torch.Generator().manual_seed(1)}
        batch = window_replay_buffer(dataset(), actor.prior, **draws).sample()
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


def test_states_and_policies_are_float32(tmp_path):
    whole = finished(tmp_path / "whole", BF16)
    tensors, _ = load_state(whole.state_path)
    assert {v.dtype for n, v in tensors.items() if "trained" in n or "exp_avg" in n} == {torch.float32}
    policy = load_policy(whole.policy_path(40))
    assert {p.dtype for p in policy.parameters()} == {torch.float32}
    assert not same(weights(finished(tmp_path / "plain")), weights(whole))
