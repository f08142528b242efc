"""Optimiser, schedule and averaging against their formulas."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from warmprior import ChiTransformer, VelocityMLP
from warmprior.training import ema_of, make_optimizer, warmup_cosine


def test_group_values_are_the_paper_s():
    network = ChiTransformer(2, 3, 4, embedding_dim=12, num_layers=1, num_heads=2)
    decay, rest = make_optimizer(network).param_groups
    for group in (decay, rest):
        assert group["lr"] == 1e-4 and group["betas"] == (0.9, 0.999) and group["eps"] == 1e-8
    assert decay["weight_decay"] == 1e-5 and rest["weight_decay"] == 0.0
    sizes = [sum(p.numel() for p in group["params"]) for group in (decay, rest)]
    assert sum(sizes) == sum(p.numel() for p in network.parameters())


def test_first_step_of_adamw_by_hand():
    """After one step: w - lr * decay * w - lr * g / (|g| + eps)."""
    network = VelocityMLP(1, 1, 1, 1, hidden_dim=4)
    optimizer = make_optimizer(network, learning_rate=0.1, weight_decay=0.5, eps=1e-8)
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    network(torch.rand(3), torch.randn(3, 1, 1), torch.randn(3, 1, 1)).square().sum().backward()
    optimizer.step()
    for name, p in network.named_parameters():
        decay = 0.5 if p.ndim == 2 else 0.0
        expected = before[name] * (1 - 0.1 * decay) - 0.1 * p.grad / (p.grad.abs() + 1e-8)
        torch.testing.assert_close(p.detach(), expected)


@pytest.mark.parametrize(("iterations", "ratio"), [(10, 0.2), (100, 0.0), (7, 0.5), (1, 0.2), (3, 0.1)])
def test_schedule_in_closed_form(iterations, ratio):
    parameter = torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.SGD([parameter], lr=2.0)
    schedule = warmup_cosine(optimizer, iterations, ratio)
    warmup = round(iterations * ratio)
    for step in range(iterations):
        if step < warmup:
            expected = 2.0 * (step + 1) / warmup
        else:
            progress = (step - warmup) / (iterations - warmup)
            expected = 2.0 * (1 + math.cos(math.pi * progress)) / 2
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected)
        optimizer.step()
        schedule.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("iterations", "ratio", "message"),
    [(0, 0.2, "iterations"), (10, 1.0, "warmup_ratio"), (10, -0.1, "warmup_ratio")],
)
def test_bad_schedule(iterations, ratio, message):
    with pytest.raises(ValueError, match=message):
        warmup_cosine(torch.optim.SGD([torch.zeros(1)], lr=1.0), iterations, ratio)


def test_average_is_the_recurrence():
    network = nn.Linear(2, 3)
    average = ema_of(network, 0.75)
    expected = None
    for i in range(6):
        with torch.no_grad():
            network.weight.fill_(float(i * i))
        average.update_parameters(network)
        value = float(i * i)
        expected = value if expected is None else 0.75 * expected + 0.25 * value
        torch.testing.assert_close(average.module.weight, torch.full((3, 2), expected))
    assert network.weight.requires_grad and not average.module.weight.requires_grad
    assert not average.module.training


def test_a_compiled_network_has_the_same_groups():
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    plain, compiled = (make_optimizer(part) for part in (network, torch.compile(network)))
    for one, two in zip(plain.param_groups, compiled.param_groups, strict=True):
        assert one["weight_decay"] == two["weight_decay"]
        assert [id(p) for p in one["params"]] == [id(p) for p in two["params"]]
