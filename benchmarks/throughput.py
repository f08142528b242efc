"""Speed of the library as ratios to the code that it is built on, both measured in the same run.

python benchmarks/throughput.py                                  # everything, a few minutes
python benchmarks/throughput.py --only windows_over_torch actor_over_network
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import socket
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from warmprior.io.script import read_command_line, start_pytorch

if __name__ == "__main__":
    start_pytorch()  # what is measured is imported before the options are read

# isort: split
import numpy as np
import torch
import torch.distributed
import torch.multiprocessing
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv
from tqdm import tqdm

from lab.io.machine import facts_of_machine
from lab.measures.timing import D_A, D_O, NFES, PRIOR, TO, Clock, H, one_decision, steps
from lab.options.command_line import script
from warmprior import (
    ChiTransformer,
    ChunkStep,
    Normalizer,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)
from warmprior.data import open_demonstrations
from warmprior.deploy import export_policy, load_exported
from warmprior.envs import RobosuiteEnv
from warmprior.io.distributed import joined, rank
from warmprior.options.training import PAPER
from warmprior.training import BehaviourCloning, TrainingConfig, precondition

BATCH = 256


# Networks, and their trainings


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


# Windows


def bare_windows(data: TensorDict, batch: int) -> Callable[[], list[torch.Tensor]]:
    """Return a function that samples windows in bare torch."""
    observation, action, episode = (data[key] for key in ("observation", "action", "episode"))
    length = int((episode == 0).sum())
    before, ahead = torch.arange(1 - TO, 1), torch.arange(-H, H)

    def sample() -> list[torch.Tensor]:
        frame = torch.randint(len(data), (batch, 1))
        start = frame - frame % length
        index = frame + ahead
        warm = index[:, :1] >= start
        actions = action[index.clamp(start, start + length - 1)]
        history, target = actions[:, :H], actions[:, H:]
        observations = observation[(frame + before).clamp_min(start)]
        is_pad = index[:, H:] >= start + length
        return [observations, target, is_pad, history * warm.unsqueeze(-1), warm]

    return sample


def bare_ranges(data: TensorDict, batch: int) -> Callable[[], list[torch.Tensor]]:
    """Return a function that samples windows in bare torch, each as a range of padded episodes."""
    observation, action, episode = (data[key] for key in ("observation", "action", "episode"))
    episodes, length = int(episode[-1]) + 1, int((episode == 0).sum())
    actions = action.view(episodes, length, -1)
    before, behind = torch.zeros_like(actions[:, :H]), actions[:, -1:].expand(-1, H - 1, -1)
    actions = torch.cat([before, actions, behind], 1).flatten(0, 1)
    seen = observation.view(episodes, length, -1)
    seen = torch.cat([seen[:, :1].expand(-1, TO - 1, -1), seen], 1).flatten(0, 1)
    is_pad = torch.zeros(episodes, length + 2 * H - 1, dtype=torch.bool)
    is_pad[:, H + length :] = True
    frame = torch.arange(len(data))
    steps_before = (frame % length).clamp_max(H).unsqueeze(-1)
    rows, seen_rows = frame + episode * (2 * H - 1), frame + episode * (TO - 1)
    ranges = actions.unfold(0, 2 * H, 1).mT, seen.unfold(0, TO, 1).mT, is_pad.flatten()[H:].unfold(0, H, 1)

    def sample() -> list[torch.Tensor]:
        frame = torch.randint(len(data), (batch,))
        row = rows.index_select(0, frame)
        moved = ranges[0].index_select(0, row)
        history, target = moved[:, :H], moved[:, H:]
        observations = ranges[1].index_select(0, seen_rows.index_select(0, frame))
        known = steps_before.index_select(0, frame)
        forecast, forecast_steps = torch.zeros_like(target), torch.zeros_like(known)
        padding = ranges[2].index_select(0, row)
        return [observations, target, padding, history, known, forecast, forecast_steps]

    return sample


def windows_over_torch(
    clock: Clock, bare: Callable[[TensorDict, int], Callable[[], object]] = bare_windows
) -> dict[str, float]:
    """Measure windows per second of the replay buffer over bare torch, by batch size."""
    data, ratio_by_batch = steps(400, 200), {}
    for batch in (BATCH, 1024):
        buffer = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO)
        ratio_by_batch[str(batch)] = clock.ratio(bare(data, batch), buffer.sample, calls=100)
    return ratio_by_batch


def lerobot_windows_over_getitem(clock: Clock) -> float | None:
    """Measure windows per second from a LeRobotDataset over its own ``__getitem__``."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    if not all(find_spec(name) for name in ("lerobot", "datasets", "pyarrow")):
        tqdm.write("lerobot_windows_over_getitem: skipped, because it needs warmprior[lerobot]")
        return None
    logging.disable(logging.WARNING)  # LeRobot warns of video decoders, which are not used here
    from lerobot.datasets import LeRobotDataset

    data, fps = steps(25, 200), 20
    kind = {"dtype": "float32", "names": None}
    features = {"observation.state": kind | {"shape": (D_O,)}, "action": kind | {"shape": (D_A,)}}
    with tempfile.TemporaryDirectory() as folder:
        root, name = Path(folder) / "data", "local/windows"
        options = {"fps": fps, "features": features, "root": root}
        written = LeRobotDataset.create(name, use_videos=False, **options)
        for episode in data.view(25, 200):
            for row in episode:
                state, action = row["observation"].numpy(), row["action"].numpy()
                written.add_frame({"observation.state": state, "action": action, "task": "none"})
            written.save_episode()
        written.finalize()
        offsets = {
            "action": [i / fps for i in range(-H, H)],
            "observation.state": [i / fps for i in range(1 - TO, 1)],
        }
        dataset = LeRobotDataset(name, root=root, delta_timestamps=offsets)
        demonstrations = open_demonstrations(f"lerobot:{root}").steps()
        buffer = window_replay_buffer(demonstrations, PRIOR, batch_size=BATCH, observation_steps=TO)
        ratio = clock.ratio(
            lambda: [dataset[i] for i in torch.randint(len(data), (64,)).tolist()],
            lambda: [buffer.sample() for _ in range(20)],
        )
    return ratio * 20 * BATCH / 64


# Training


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


# Decisions


@torch.no_grad()
def _passes(network: nn.Module, inputs: tuple[torch.Tensor, ...], nfe: int) -> None:
    for _ in range(nfe):
        network(*inputs)


@torch.no_grad()
def actor_over_network(clock: Clock, make: Callable[[], nn.Module] = paper_network) -> dict[str, float]:
    network = make().eval()
    actor = WarmPriorActor(network, PRIOR).eval()
    data, t, a = one_decision(), torch.rand(1), torch.randn(1, H, D_A)
    ratio_by_nfe = {}
    for nfe in NFES:
        ratio_by_nfe[str(nfe)] = clock.ratio(
            partial(actor, data, nfe=nfe),
            partial(_passes, network, (t, a, data["observation"]), nfe),
            calls=max(2, 18 // nfe),
        )
    return ratio_by_nfe


@torch.no_grad()
def exported_over_passes(clock: Clock) -> float:
    network = default_network().eval()
    with tempfile.TemporaryDirectory() as folder:
        path = export_policy(WarmPriorActor(network, PRIOR, nfe=3), Path(folder) / "policy.pt2")
        exported = load_exported(path)
    data, t, a = one_decision(), torch.rand(1), torch.randn(1, H, D_A)
    alone = data[0]  # an exported policy decides for one robot
    return clock.ratio(
        partial(exported.forward, alone), partial(_passes, network, (t, a, data["observation"]), 3), calls=20
    )


# Control steps


def env_over_robosuite(clock: Clock) -> float:
    envs = RobosuiteEnv("square"), RobosuiteEnv("square", control_loop="robosuite")
    lean, robosuite = (env.loop for env in envs)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, D_A))

    def before() -> None:  # both play the same episode, because contacts decide what a step costs
        lean.reset(0)
        robosuite.reset(0)

    return clock.ratio(
        lambda: [robosuite.env.step(action) for action in actions],
        lambda: [lean.step(action) for action in actions],
        before=before,
    )


class Particles(EnvBase):
    """A batched simulator of ``n`` chains of masses, with ten integration steps per control step."""

    def __init__(self, n: int, masses: int = 32) -> None:
        super().__init__(batch_size=[n])
        self.observation_spec = Composite(observation=Unbounded((n, D_O)), shape=[n])
        self.action_spec = Bounded(-1, 1, (n, D_A))
        self.reward_spec = Unbounded((n, 1))
        flags = {name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in ("done", "terminated")}
        self.done_spec = Composite(flags, shape=[n])
        self.state = torch.zeros(2, n, masses)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)

    def _observation(self) -> torch.Tensor:
        return self.state[0, :, :D_O].clone()

    def _reset(self, tensordict: TensorDict | None = None, **kwargs: Any) -> TensorDict:
        self.state.zero_()
        return TensorDict({"observation": self._observation()}, self.batch_size).update(self.done_spec.zero())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        position, velocity = self.state
        for _ in range(10):
            force = position.roll(1, -1) - 2 * position + position.roll(-1, -1) - position.pow(3)
            force[:, :D_A] += tensordict["action"]
            velocity += 0.01 * force
            position += 0.01 * velocity
        reward = position.square().sum(-1, keepdim=True)
        result = {"observation": self._observation(), "reward": reward}
        return TensorDict(result, self.batch_size).update(self.done_spec.zero())


def batched_chunk_step(clock: Clock) -> float:
    chunks = torch.rand(1024, 3, H, D_A, generator=torch.Generator().manual_seed(0)) * 2 - 1
    alone, env = Particles(1024), TransformedEnv(Particles(1024), policy_transforms(PRIOR))

    def decisions() -> None:
        data = env.reset()
        for i in range(3):
            data = env.step_mdp(env.step(data.set(("vla_action", "chunk"), chunks[:, i])))

    def control_steps() -> None:
        data = alone.reset()
        for action in chunks.flatten(1, 2).unbind(1):
            data = alone.step_mdp(alone.step(data.set("action", action)))

    return clock.ratio(decisions, control_steps)


def chunk_step_overhead(clock: Clock) -> dict[str, float]:
    # These statistics leave actions as they are, so that all sides simulate the same.
    high = {"observation": torch.ones(D_O), "action": torch.ones(D_A)}
    normalizer = Normalizer({key: -value for key, value in high.items()}, high)
    transforms: dict[str, Transform] = {
        "chunks": ChunkStep(H),
        "and history, last observations": policy_transforms(PRIOR),
        "and normaliser": policy_transforms(PRIOR, normalizer=normalizer),
    }
    alone = RobosuiteEnv("square")  # 40 of 400 steps are taken
    envs = [TransformedEnv(RobosuiteEnv("square"), transform) for transform in transforms.values()]
    chunks = torch.rand(5, H, D_A, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    starts: list[TensorDictBase] = []

    def before() -> None:
        for env in envs:
            env.set_seed(0, static_seed=True)
        starts[:] = [env.reset() for env in envs]
        alone.loop.reset(0)

    def decisions(i: int) -> None:
        data = starts[i]
        for chunk in chunks:
            data = envs[i].step_mdp(envs[i].step(data.set(("vla_action", "chunk"), chunk)))

    def control_steps() -> None:
        for action in chunks.flatten(0, 1).numpy():
            alone.loop.step(action)

    times = clock.times(control_steps, *(partial(decisions, i) for i in range(len(envs))), before=before)
    base, *others = times
    overheads = (statistics.median(a / b for a, b in zip(one, base, strict=True)) - 1 for one in others)
    return dict(zip(transforms, overheads, strict=True))


FIGURES: dict[str, tuple[Callable[[Clock], Any], str]] = {
    "windows_over_torch": (windows_over_torch, ">= 0.6"),
    "windows_over_ranges": (partial(windows_over_torch, bare=bare_ranges), ">= 0.45"),
    "lerobot_windows_over_getitem": (lerobot_windows_over_getitem, ">= 500"),
    "train_step_over_network": (train_step_over_network, "<= 1.10"),
    "cuda_train_step_over_network": (partial(train_step_over_network, device="cuda", calls=20), "<= 1.05"),
    "cuda_steps_per_second": (partial(steps_per_second, device="cuda"), ""),
    "preconditioning_over_network": (preconditioning_over_network, "<= 1.02"),
    "ddp_efficiency": (ddp_efficiency, ""),
    "actor_over_network": (actor_over_network, "<= 1.10"),
    "default_step_over_network": (default_step_over_network, "<= 1.25"),
    "default_actor_over_network": (partial(actor_over_network, make=default_network), "<= 1.5"),
    "exported_over_passes": (exported_over_passes, "<= 0.35"),
    "matrix_peak": (matrix_peak, ""),
    "env_over_robosuite": (env_over_robosuite, ">= 2"),
    "chunk_step_overhead": (chunk_step_overhead, "<= 0.12 with all"),
    "batched_chunk_step": (batched_chunk_step, "<= 1.15"),
}


@script("throughput.py", hint="")
def main(argv: list[str] | None) -> None:
    """Measure the figures and write them to `throughput.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    names, out = ", ".join(FIGURES), Path("runs/throughput")
    add("--only", nargs="+", choices=FIGURES, metavar="NAME", help=f"figures of {names} (default: all)")
    add("--out", type=Path, default=out, help="folder of throughput.json (default: %(default)s)")
    add("--repeats", type=int, default=11, help="rounds per figure (default: %(default)s)")
    options = read_command_line(lambda: parser.parse_args(argv))
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")
    path = options.out / "throughput.json"
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = dict.fromkeys(FIGURES)
    with tqdm(options.only or list(FIGURES), unit="figure", dynamic_ncols=True) as bar:
        for name in bar:
            bar.set_description(name)
            measure, target = FIGURES[name]
            results[name] = value = measure(Clock(options.repeats, bar))
            shown = f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
            tqdm.write(f"{name:32} {shown} {f'(target {target})' if target else ''}")
    date = datetime.now(UTC).isoformat(timespec="seconds")
    results["meta"] = facts_of_machine(torch_threads=torch.get_num_threads(), date=date)
    path.write_text(json.dumps(results, indent=2) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    sys.exit(main())
