"""Training: the loop by hand, and the same result however often it is killed."""

import copy
import dataclasses
import multiprocessing
import signal
import threading
import time

import pytest
import torch
from torch import nn

from tests.errors import raises
from tests.states import same
from tests.training.cloning_parts import (
    CONFIG,
    actor_for,
    dataset,
    finished,
    mlp,
    run_until,
    training,
    weights,
)
from warmprior import FlowMatchingLoss, VelocityMLP, window_replay_buffer
from warmprior.options.training import PAPER
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state
from warmprior.training import TrainingConfig
from warmprior.training.optim import make_optimizer

LATER = {"times": "u-shaped", "objective": "l1"}
"""Options beside Algorithm 1's; the average is the teacher."""

PUBLIC = {"max_grad_norm": 1.2, "count_padding": True, "warmup_ratio": 0.0}
"""The kinds of options in which the preset `much-ado` differs from `paper`."""


@pytest.mark.parametrize("options", [{}, LATER, PUBLIC], ids=["algorithm 1", "later", "public code"])
def test_the_loop_by_hand(tmp_path, options):
    """Sample, loss, AdamW at the scheduled rate, EMA: written out with PyTorch's own parts."""
    changes = {"iterations": 12, "checkpoints": 1, "warmup_ratio": 0.25, "ema_rate": 0.9}
    config = dataclasses.replace(CONFIG, **changes | options)
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    other, average = copy.deepcopy(network), copy.deepcopy(network)
    cloning = finished(tmp_path, config, actor=actor_for(network=network))

    actor = actor_for(network=other)
    generator = torch.Generator().manual_seed(config.seed)
    buffer = window_replay_buffer(dataset(), actor.prior, batch_size=16, withhold=0.25, generator=generator)
    recipe = dict(options)
    clipped, padding = recipe.pop("max_grad_norm", None), recipe.pop("count_padding", False)
    warmup = round(12 * recipe.pop("warmup_ratio", 0.25))
    loss = FlowMatchingLoss(actor, generator=generator, **recipe)
    optimizer = make_optimizer(other, learning_rate=config.learning_rate)
    losses, lengths, padded = [], [], 0
    for step in range(12):
        progress = (step - warmup) / (12 - warmup)
        factor = (step + 1) / 3 if step < warmup else 0.5 * (1 + torch.tensor(progress * torch.pi).cos())
        for group in optimizer.param_groups:
            group["lr"] = float(config.learning_rate * factor)
        batch = buffer.sample()
        padded += batch["action_is_pad"].sum().item()
        if padding:
            batch["action_is_pad"] = torch.zeros_like(batch["action_is_pad"])
        value = loss(batch)["loss_flow_matching"]
        losses.append(value.item())
        optimizer.zero_grad()
        if clipped is None:
            value.backward()
        else:  # as in that code: a tenth of the loss, whose gradient is clipped to a tenth of the norm
            (0.1 * value).backward()
            lengths.append(sum(p.grad.square().sum() for p in other.parameters()).sqrt().item())
            for p in other.parameters():
                p.grad *= min(1.0, 0.1 * clipped / lengths[-1])
            for group in optimizer.param_groups:
                group["eps"] = 1e-9  # AdamW sees the tenth here alone
        optimizer.step()
        with torch.no_grad():
            for mean, now in zip(average.parameters(), other.parameters(), strict=True):
                mean.copy_(now if step == 0 else 0.9 * mean + 0.1 * now)
    torch.testing.assert_close(cloning.actor.network.state_dict(), other.state_dict())
    kept = load_policy(cloning.policy_path(12)).network
    torch.testing.assert_close(kept.state_dict(), average.state_dict())
    assert padded > 0
    if clipped is not None:
        assert min(lengths) < 0.1 * clipped < max(lengths)
    assert [i for i, _ in cloning.losses] == [10, 12]
    assert cloning.losses[0][1] == pytest.approx(sum(losses[:10]) / 10, rel=1e-4)
    assert cloning.losses[1][1] == pytest.approx(sum(losses[10:]) / 2, rel=1e-4)


@pytest.mark.parametrize(
    ("stop", "recipe", "options"),
    [
        *((6, {}, {}), (7, {}, {}), (23, {}, {}), (23, {}, {"prefetch": True})),
        (16, LATER | PUBLIC | {"precision": "bf16"}, {}),
    ],
)
def test_stopping_anywhere_changes_nothing(tmp_path, stop, recipe, options):
    """Without a kill: an exception in the middle of the loop, then a new object."""
    config = dataclasses.replace(CONFIG, **recipe)
    whole = finished(tmp_path / "whole", config, **options)
    run_until(training(tmp_path / "part", config, **options), stop)
    torch.rand(100)  # whatever else uses the global generator in between
    again = training(tmp_path / "part", config, **options)
    assert again.iteration == max(i for i in (0, 7, 14, 20, 21, 28, 35) if i <= stop)
    again.run()
    assert same(weights(again), weights(whole))
    assert again.losses == whole.losses
    states = [load_state(tmp_path / name / "state.safetensors")[0] for name in ("whole", "part")]
    assert same(*states) and ("rng/windows" in states[0]) == ("prefetch" in options)
    assert not [t for t in threading.enumerate() if t.name.startswith("prefetch")]
    for i in (20, 40):
        one, two = whole.policy_path(i), again.policy_path(i)
        for name in ("config.json", "model.safetensors"):
            assert (one / name).read_bytes() == (two / name).read_bytes()


SLOWLY = pytest.param("bf16", "inductor", marks=pytest.mark.slow)  # it calls a compiler of C++


@pytest.mark.parametrize(
    ("precision", "backend"), [("float32", None), ("bf16", None), ("bf16", "eager"), SLOWLY]
)
def test_a_gradient_is_shortened_to_the_norm_and_keeps_its_direction(
    tmp_path, monkeypatch, precision, backend
):
    compiled, compile_ = backend is not None, nn.Module.compile
    monkeypatch.setattr(nn.Module, "compile", lambda module, **options: compile_(module, backend=backend))
    gradients = {}
    for norm in (None, 1e-2, 1e9):
        config = dataclasses.replace(CONFIG, max_grad_norm=norm, precision=precision)
        cloning = training(tmp_path / str(norm), config, actor=actor_for(network=mlp()), compile=compiled)
        cloning.step()
        gradients[norm] = torch.cat([p.grad.flatten() for p in cloning.actor.network.parameters()])
    whole = gradients[None]
    torch.testing.assert_close(gradients[1e-2], 1e-2 * whole / whole.norm(), rtol=1e-4, atol=1e-8)
    assert torch.equal(gradients[1e9], whole)  # bit by bit


def test_a_network_that_cannot_be_compiled_is_refused_in_one_sentence(tmp_path, monkeypatch):
    def backend(graph, inputs):
        raise OSError("no g++\nand so on")

    compile_ = nn.Module.compile
    monkeypatch.setattr(nn.Module, "compile", lambda module, **options: compile_(module, backend=backend))
    cloning = training(tmp_path, CONFIG, actor=actor_for(network=mlp()), compile=True)
    with pytest.raises(ValueError, match=r"^the network cannot be compiled \(no g\+\+\): install .*$"):
        cloning.step()


def killed_training(folder, iterations):
    config = dataclasses.replace(CONFIG, iterations=iterations, save_every=3, checkpoints=5)
    return training(folder, config)


@pytest.mark.parametrize(
    ("iterations", "moments"),
    [(80, (0.1,)), pytest.param(2000, (0.0, 0.31, 1.13, 2.2), marks=pytest.mark.slow)],
)
def test_killed_and_resumed_is_bitwise_the_same(tmp_path, iterations, moments):
    """SIGKILL that long after the first save; saves are so frequent that many hit one."""
    whole = killed_training(tmp_path / "whole", iterations)
    whole.run()
    folder, context = tmp_path / "killed", multiprocessing.get_context("fork")
    reached = 0
    for moment in moments:
        process = context.Process(target=lambda: killed_training(folder, iterations).run(None))
        process.start()
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.is_alive() and _iteration(folder) <= reached:
            time.sleep(0.02)
        time.sleep(moment)
        process.kill()
        process.join(30)
        assert process.exitcode == -signal.SIGKILL, "finished before it was killed"
        reached = _iteration(folder)
    assert 0 < reached < iterations
    again = killed_training(folder, iterations)
    assert again.iteration == reached
    again.run()
    assert same(weights(again), weights(whole))
    assert again.losses == whole.losses


def _iteration(folder):
    path = folder / "state.safetensors"
    return load_state(path)[1]["iteration"] if path.exists() else 0


def test_recipes_that_cannot_be():
    wrong = {"iterations": [3.5], "save_every": [0], "seed": [-1], "learning_rate": ["fast"]}
    wrong["max_grad_norm"] = [0.0, -1.0, float("inf"), float("nan")]
    for name, values in wrong.items():
        for value in values:
            with raises(ValueError, name, value):
                TrainingConfig(**{name: value})


def test_checkpoints_are_evenly_spaced():
    assert PAPER.checkpoint_iterations == [20_000 * i for i in range(1, 11)]
    # No more than there are iterations.
    assert TrainingConfig(iterations=3, checkpoints=4).checkpoint_iterations == [1, 2, 3]
