import math

import pytest
import torch
from torch import nn

from warmprior import VelocityMLP
from warmprior.modules.learning_rate import warmup_cosine
from warmprior.training.optim import ema_of, make_optimizer


@pytest.mark.parametrize(
    ("iterations", "ratio"), [(10, 0.2), (100, 0.0), (7, 0.5), (1, 0.2), (3, 0.1), (9, 0.99)]
)
def test_schedule_in_closed_form(iterations, ratio):
    parameter = torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.SGD([parameter], lr=2.0)
    schedule = warmup_cosine(optimizer, iterations, ratio)
    warmup = min(round(iterations * ratio), iterations - 1)  # one step at least is no warm-up
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


def test_a_compiled_network_has_the_same_groups():
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    plain, compiled = (make_optimizer(part) for part in (network, torch.compile(network)))
    for one, two in zip(plain.param_groups, compiled.param_groups, strict=True):
        assert one["weight_decay"] == two["weight_decay"]
        assert [id(p) for p in one["params"]] == [id(p) for p in two["params"]]


def test_an_average_follows_a_buffer_that_a_network_replaces():
    network = nn.Linear(1, 1)
    network.register_buffer("running", torch.zeros(1))
    average = ema_of(network, 0.5)
    update = average.update_from(network)
    for value in (1.0, 2.0):
        network.running = network.running + value
        update()
    assert average.module.running.item() == 3.0
    assert network.weight.requires_grad and not average.module.weight.requires_grad
    assert not average.module.training


def test_an_average_of_a_norm_without_running_statistics():
    """Its buffers are there, and None."""
    network = nn.InstanceNorm2d(2, affine=True)
    average = ema_of(network, 0.5)
    for value in (1.0, 2.0):
        nn.init.constant_(network.weight, value)
        average.update_parameters(network)
    assert average.module.weight.tolist() == [1.5, 1.5]
