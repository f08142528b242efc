"""Options of the training beside Algorithm 1's: what they do to the loop."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.training.cloning_parts import CONFIG, actor_for, dataset, mlp, run_until, same, training, weights
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    window_replay_buffer,
)
from warmprior.training import ema_of, make_optimizer

LATER = {"times": "u-shaped", "objective": "l1", "self_distillation": 0.5}


def test_the_loop_by_hand_with_the_average_as_teacher(tmp_path):
    config = replace(CONFIG, iterations=6, checkpoints=1, warmup_ratio=0.0, ema_rate=0.8, **LATER)
    cloning = training(tmp_path, config, actor=actor_for(GaussianPrior(4), mlp()))
    cloning.run()
    actor = actor_for(GaussianPrior(4), mlp())
    teacher = ema_of(actor.network, 0.8)
    generator = torch.Generator().manual_seed(config.seed)
    buffer = window_replay_buffer(dataset(), actor.prior, batch_size=16, withhold=0.25, generator=generator)
    loss = FlowMatchingLoss(actor, generator=generator, teacher=teacher.module, **LATER)
    optimizer = make_optimizer(actor.network, learning_rate=config.learning_rate)
    seen = []
    for step in range(6):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * 0.5 * (1 + torch.tensor(step * torch.pi / 6).cos())
        losses = loss(buffer.sample())
        total = losses["loss_flow_matching"] + losses["loss_self_distillation"]
        seen.append(total.item())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        teacher.update_parameters(actor.network)
    for name, value in actor.network.state_dict().items():
        torch.testing.assert_close(cloning.actor.network.state_dict()[name], value)
    ((_, logged),) = cloning.losses
    assert logged == pytest.approx(sum(seen) / 6, rel=1e-4)


def test_stopping_with_a_teacher_changes_nothing(tmp_path):
    """The averaged weights are restored, and go on to teach."""
    config = replace(CONFIG, iterations=20, checkpoints=1, **LATER)
    whole = training(tmp_path / "whole", config)
    whole.run()
    part = training(tmp_path / "part", config)
    run_until(part, 16)
    again = training(tmp_path / "part", config)
    assert again.iteration == 14
    again.run()
    assert same(weights(again), weights(whole)) and again.losses == whole.losses
    plain = training(tmp_path / "plain", replace(config, self_distillation=0.0))
    plain.run()
    assert not same(weights(plain), weights(whole))
