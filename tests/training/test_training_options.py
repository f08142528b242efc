"""Training options that came later: what they do to the loop, and that nothing changes without them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.training.cloning_parts import CONFIG, actor_for, dataset, mlp, same, training, weights
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    RegressionPrior,
    WarmPriorActor,
    window_replay_buffer,
)
from warmprior.training import TrainingConfig, ema_of, make_optimizer

LATER = {"times": "u-shaped", "objective": "l1", "self_distillation": 0.5}
EARLIER = {
    "iterations": 40,
    "batch_size": 16,
    "learning_rate": 1e-2,
    "weight_decay": 1e-5,
    "betas": [0.9, 0.999],
    "eps": 1e-8,
    "warmup_ratio": 0.2,
    "ema_rate": 0.995,
    "checkpoints": 2,
    "save_every": 7,
    "log_every": 10,
    "seed": 0,
}
"""The identity of CONFIG from before there were others."""


def test_the_loop_by_hand_with_the_average_as_teacher(tmp_path):
    config = replace(CONFIG, iterations=6, checkpoints=1, warmup_ratio=0.0, ema_rate=0.8, **LATER)
    cloning = training(tmp_path, config, actor=actor_for(GaussianPrior(4), mlp()))
    cloning.run()
    actor = actor_for(GaussianPrior(4), mlp())
    teacher = ema_of(actor.network, 0.8)
    generator = torch.Generator().manual_seed(config.seed)
    buffer = window_replay_buffer(dataset(), actor.prior, batch_size=16, generator=generator)
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
    take = part.step

    def step():
        if part.iteration == 16:
            raise KeyboardInterrupt
        return take()

    part.step = step
    with pytest.raises(KeyboardInterrupt):
        part.run()
    again = training(tmp_path / "part", config)
    assert again.iteration == 14
    again.run()
    assert same(weights(again), weights(whole)) and again.losses == whole.losses
    plain = training(tmp_path / "plain", replace(config, self_distillation=0.0))
    plain.run()
    assert not same(weights(plain), weights(whole))


def test_the_identity_is_that_of_before_until_an_option_is_used(tmp_path):
    assert training(tmp_path / "plain").identity["config"] == EARLIER
    for name, value in LATER.items():
        config = replace(CONFIG, **{name: value})
        assert training(tmp_path / name, config).identity["config"] == EARLIER | {name: value}


@pytest.mark.parametrize("name", LATER)
def test_a_state_is_not_continued_with_another_option(tmp_path, name):
    config = replace(CONFIG, iterations=8, checkpoints=1)
    one, other = config, replace(config, **{name: LATER[name]})
    for i, (first, second) in enumerate([(one, other), (other, one)]):
        training(tmp_path / str(i), first).run()
        with pytest.raises(ValueError, match="belongs to another config"):
            training(tmp_path / str(i), second)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"times": "late"}, "times must be one of uniform, u-shaped, logit-normal, got 'late'"),
        ({"objective": "huber"}, "objective must be one of velocity, l1"),
        ({"self_distillation": -0.1}, "self_distillation must be a finite weight >= 0"),
        ({"self_distillation": float("inf")}, "self_distillation must be a finite weight >= 0"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        TrainingConfig(**options)


def test_a_prior_without_a_flow_is_refused_before_training(tmp_path):
    actor = WarmPriorActor(mlp(), RegressionPrior(4))
    with pytest.raises(ValueError, match="regression is trained at t = 0 alone"):
        training(tmp_path, replace(CONFIG, objective="l1"), actor=actor)
    assert not list(tmp_path.iterdir())
