"""Training steps of the library over those of bare torch."""

from __future__ import annotations

import os
import socket
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed
import torch.multiprocessing
from torch import nn
from tqdm import tqdm

from lab.speed.timing import BATCH, D_A, D_O, PRIOR, TO, Clock, H, steps
from warmprior import ChiTransformer, VelocityMLP, WarmPriorActor
from warmprior.io.distributed import joined, rank
from warmprior.options.training import PAPER
from warmprior.training import BehaviourCloning, TrainingConfig, precondition


def paper_network() -> ChiTransformer:
    torch.manual_seed(0)
    return ChiTransformer(D_A, D_O, PRIOR.prediction_length, TO)


def small_network() -> VelocityMLP:
    """Return the network of the quick preset."""
    torch.manual_seed(0)
    return VelocityMLP(D_A, D_O, PRIOR.prediction_length, TO, hidden_dim=384)


def cloning(
    network: nn.Module, folder: str | Path, device: str = "cpu", *, graphs: bool = False, batch: int = BATCH
) -> BehaviourCloning:
    """Return a training of the network, ready to step, optionally with CUDA graphs."""
    actor, config = WarmPriorActor(network.to(device), PRIOR), TrainingConfig(batch_size=batch)
    training = BehaviourCloning(actor, steps(400, 200).to(device), config, folder, compile=graphs)
    actor.train()
    return training


def step_of(
    network: nn.Module, device: str = "cpu", *, graphs: bool = False, batch: int = BATCH
) -> Callable[[], None]:
    """Return a training step of a network alone on random numbers, optionally with CUDA graphs."""
    network.to(device)
    if graphs:
        network.compile(mode="reduce-overhead")
    optimizer = torch.optim.AdamW(network.parameters(), fused=True)
    shapes = (batch,), (batch, H, D_A), (batch, TO, D_O)
    t, a, o = (torch.rand(shape, device=device) for shape in shapes)

    def step() -> None:
        if graphs:
            torch.compiler.cudagraph_mark_step_begin()
        loss = network(t, a, o).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def lacks(device: str) -> bool:
    """Return True, and print a line, if a figure needs a GPU and there is none."""
    if device == "cpu" or torch.cuda.is_available():
        return False
    tqdm.write(f"a figure on {device}: skipped, because it needs a GPU")
    return True


def train_step_over_network(clock: Clock, device: str = "cpu", calls: int = 1) -> float | None:
    if lacks(device):
        return None
    graphs = device != "cpu"
    with tempfile.TemporaryDirectory() as folder:
        ours = cloning(paper_network(), folder, device, graphs=graphs).step
        return clock.ratio(ours, step_of(paper_network(), device, graphs=graphs), calls=calls)


def steps_per_second(
    clock: Clock,
    device: str = "cpu",
    network: Callable[[], nn.Module] = paper_network,
    batch: int = PAPER.batch_size,
    calls: int = 20,
) -> dict[str, float] | None:
    """Measure training steps per second of the library and of bare torch; on a GPU also with CUDA graphs."""
    if lacks(device):
        return None
    with tempfile.TemporaryDirectory() as folder:
        step_by_name: dict[str, Callable[[], object]] = {}
        for graphs in (False, True) if device != "cpu" else (False,):
            name = " as graphs" if graphs else ""
            options: dict[str, Any] = {"graphs": graphs, "batch": batch}
            training = cloning(network(), f"{folder}/{graphs}", device, **options)
            step_by_name[f"warmprior{name}"] = training.step
            step_by_name[f"torch{name}"] = step_of(network(), device, **options)
        # Synchronised after several steps, so that asynchronous launches overlap as in a training.
        times = clock.times(*(partial(_round, step, calls) for step in step_by_name.values()))
    rounds = zip(step_by_name, times, strict=True)
    return {name: calls / statistics.median(seconds) for name, seconds in rounds}


cuda_train_step_over_network = partial(train_step_over_network, device="cuda", calls=20)
cuda_steps_per_second = partial(steps_per_second, device="cuda")


def averaging_step_of(network: nn.Module, batch: int, *, compiled: bool) -> Callable[[], None]:
    """Return a training step on random numbers that averages the weights, if compiled in bfloat16."""
    if compiled:
        network.compile()
    optimizer = torch.optim.AdamW(network.parameters(), fused=True)
    weights: list[torch.Tensor] = list(network.parameters())
    averages = [weight.detach().clone() for weight in weights]
    shapes = (batch,), (batch, H, D_A), (batch, TO, D_O)
    t, a, o = (torch.rand(shape) for shape in shapes)

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=compiled, cache_enabled=False):
            loss = network(t, a, o).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(averages, weights, 0.005)

    return step


def default_network() -> nn.Module:
    """Return the network that `train_policy` trains by default."""
    return precondition(small_network(), steps(100, 150), PRIOR)


def default_step_over_network(clock: Clock) -> dict[str, float]:
    """Measure a training step of the default network over a bare one that averages its weights too."""
    ratio_by_kind, data = {}, steps(100, 150)
    for batch, compiled in ((128, False), (256, False), (128, True)):
        actor = WarmPriorActor(default_network(), PRIOR)
        config = TrainingConfig(batch_size=batch, precision="bf16" if compiled else "float32")
        with tempfile.TemporaryDirectory() as folder:
            ours = BehaviourCloning(actor, data, config, folder, compile=compiled)
            actor.train()
            bare = averaging_step_of(default_network(), batch, compiled=compiled)
            name = f"{batch}, bf16 and compiled" if compiled else str(batch)
            ratio_by_kind[name] = clock.ratio(ours.step, bare, calls=10)
    return ratio_by_kind


def matrix_peak(clock: Clock, size: int = 1024) -> float:
    """Measure how many 10^9 operations per second products of large float32 matrices take."""
    one, two = torch.rand(2, size, size)
    (seconds,) = clock.times(partial(torch.mm, one, two), calls=5)
    return 2 * size**3 / min(seconds) / 1e9


def preconditioning_over_network(clock: Clock) -> float:
    network = precondition(small_network(), steps(400, 200), PRIOR)
    return clock.ratio(step_of(network), step_of(small_network()), calls=20)


SCALED = {"paper": (paper_network, 1), "small": (small_network, 10)}
"""By name: a network, and the number of training steps per round."""


def _round(step: Callable[[], object], calls: int) -> torch.Tensor:
    """Run some steps, and return their time and processor time in seconds."""
    start = time.perf_counter(), time.process_time()
    for _ in range(calls):
        step()
    return torch.tensor([time.perf_counter() - start[0], time.process_time() - start[1]])


def _scale(number: int, port: int, repeats: int, folder: str) -> None:
    """Time both in turn: the first process trains alone while the other waits, then both train together."""
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(number), "LOCAL_RANK": str(number), "WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    alone = {name: cloning(make(), Path(folder) / name) for name, (make, _) in SCALED.items()}
    with joined():
        for name, (make, calls) in SCALED.items():
            both, ratios = cloning(make(), Path(folder) / f"{name} {number}"), []
            for repeat in range(repeats + 1):
                torch.distributed.barrier()
                one = _round(alone[name].step, calls) if not rank() else torch.zeros(2)
                torch.distributed.barrier()
                two = _round(both.step, calls)
                torch.distributed.all_reduce(two)
                if repeat:  # the first round warms up
                    ratios.append(one / two)
            if not rank():
                torch.save(torch.stack(ratios).median(0).values, Path(folder) / f"{name}.pt")


def ddp_efficiency(clock: Clock) -> dict[str, dict[str, float]]:
    """Measure windows per second of two processes over twice those of one, for the same total batch.

    The processor time tells the cost of sharing a batch even if other programs use the cores.
    """
    with socket.socket() as free, tempfile.TemporaryDirectory() as folder:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        torch.multiprocessing.spawn(_scale, (port, clock.repeats, folder), nprocs=2)
        medians = {name: torch.load(Path(folder) / f"{name}.pt").tolist() for name in SCALED}
    return {name: dict(zip(("time", "processor"), pair, strict=True)) for name, pair in medians.items()}
