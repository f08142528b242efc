"""What a training step of the library costs, beside that of its network alone, and on several processes."""

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
from tensordict import TensorDict
from torch import nn
from tqdm import tqdm

from warmprior import ChiTransformer, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.history import window_history
from warmprior.io.distributed import joined, rank
from warmprior.training import BehaviourCloning, TrainingConfig

D_O, D_A, H, TO, BATCH = 23, 7, 8, 2, 256
PRIOR = PastPrior(H)


def steps(episodes: int, length: int) -> TensorDict:
    n = episodes * length
    both = torch.rand(n, D_O + D_A, generator=torch.Generator().manual_seed(0)) * 2 - 1
    observation, action = both.split((D_O, D_A), dim=-1)
    episode = torch.arange(n) // length
    data = TensorDict({"observation": observation, "action": action, "episode": episode}, [n])
    return data.contiguous()


def paper_network() -> ChiTransformer:
    torch.manual_seed(0)
    return ChiTransformer(D_A, D_O, PRIOR.prediction_length, TO)


def small_network() -> VelocityMLP:
    """That of the quick preset."""
    torch.manual_seed(0)
    return VelocityMLP(D_A, D_O, PRIOR.prediction_length, TO, hidden_dim=384)


def cloning(
    network: nn.Module, folder: str | Path, batch: int = BATCH, device: str = "cpu", **options: Any
) -> BehaviourCloning:
    """A training of the network, ready to step."""
    actor, config = WarmPriorActor(network, PRIOR).to(device), TrainingConfig(batch_size=batch)
    data = steps(400, 200).to(device)
    training = BehaviourCloning(actor, data, config, folder, observation_steps=TO, **options)
    actor.train()
    return training


SCALED = {"paper": (paper_network, 1), "small": (small_network, 10)}
"""Networks, and training steps per round."""


def _round(step: Callable[[], object], calls: int) -> torch.Tensor:
    """Seconds, and seconds of processor time."""
    start = time.perf_counter(), time.process_time()
    for _ in range(calls):
        step()
    return torch.tensor([time.perf_counter() - start[0], time.process_time() - start[1]])


def _scale(number: int, port: int, repeats: int, folder: str) -> None:
    """In turn: the first process trains alone while the other waits, and both train together."""
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(number), "LOCAL_RANK": str(number), "WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    alone = {name: cloning(make(), Path(folder) / name) for name, (make, _) in SCALED.items()}
    with joined():
        for name, (make, calls) in SCALED.items():
            both, found = cloning(make(), Path(folder) / f"{name} {number}"), []
            for repeat in range(repeats + 1):
                torch.distributed.barrier()
                one = _round(alone[name].step, calls) if not rank() else torch.zeros(2)
                torch.distributed.barrier()
                two = _round(both.step, calls)
                torch.distributed.all_reduce(two)
                if repeat:  # the first round warms up
                    found.append(one / two)
            if not rank():
                torch.save(torch.stack(found).median(0).values, Path(folder) / f"{name}.pt")


def ddp_efficiency(clock: Any) -> dict[str, dict[str, float]]:
    """Windows per second of two processes of a thread, over twice those of one, at the same whole batch.

    By time, and by processor time, which tells what sharing a batch costs where other work takes the cores.
    """
    with socket.socket() as free, tempfile.TemporaryDirectory() as folder:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        torch.multiprocessing.spawn(_scale, (port, clock.repeats, folder), nprocs=2)
        found = {name: torch.load(Path(folder) / f"{name}.pt").tolist() for name in SCALED}
    return {name: dict(zip(("time", "processor"), both, strict=True)) for name, both in found.items()}


def _gpu(name: str) -> bool:
    if not torch.cuda.is_available():
        tqdm.write(f"{name}: skipped, needs a GPU")
    return torch.cuda.is_available()


def cuda_train_step_over_network(clock: Any) -> float | None:
    """Of the paper's preset, both as CUDA graphs."""
    if not _gpu("cuda_train_step_over_network"):
        return None
    batch, bare = TrainingConfig().batch_size, paper_network().to("cuda")
    bare.compile(mode="reduce-overhead")
    optimizer = torch.optim.AdamW(bare.parameters(), fused=True)
    t, a = torch.rand(batch, device="cuda"), torch.randn(batch, H, D_A, device="cuda")
    o = torch.randn(batch, TO, D_O, device="cuda")

    def bare_step() -> None:
        loss = bare(t, a, o).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def twenty(step: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(20):
                torch.compiler.cudagraph_mark_step_begin()
                step()

        return run

    with tempfile.TemporaryDirectory() as folder:
        ours = cloning(paper_network(), folder, batch, "cuda", compile=True)
        return clock.ratio(twenty(ours.step), twenty(bare_step))


def cuda_latency(clock: Any) -> dict[str, float] | None:
    """Milliseconds per chunk of a single decision, by number of network evaluations."""
    if not _gpu("cuda_latency"):
        return None
    actor = WarmPriorActor(paper_network().eval(), PRIOR).eval().to("cuda")
    actor.network.compile(mode="reduce-overhead")
    history = window_history(torch.randn(1, H, D_A), torch.full((1, 1), H), torch.zeros(1, H, D_A), H)
    data = TensorDict({"observation": torch.randn(1, TO, D_O), "history": history}, [1]).to("cuda")
    found = {}
    with torch.no_grad():
        for nfe in (1, 3, 9):
            (seconds,) = clock.times(partial(actor, data, nfe=nfe), calls=50)
            found[str(nfe)] = 1e3 * statistics.median(seconds)
    return found
