"""Speed of the library as ratios to what it is built on, each measured in one run.

python benchmarks/dev/throughput.py                                  # everything, a few minutes
python benchmarks/dev/throughput.py --only windows_over_torch job_overhead
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import logging
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import training_figures as training
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from tqdm import tqdm
from training_figures import BATCH, D_A, D_O, PRIOR, TO, H, steps

from warmprior import Normalizer, policy_transforms, window_replay_buffer
from warmprior.data import LeRobotExperienceReplay
from warmprior.envs import RobosuiteEnv
from warmprior.io.files import read_json, write_atomic
from warmprior.io.machine import facts_of_machine
from warmprior.io.processes import fresh_processes
from warmprior.io.ray_cluster import ray_cluster


class Clock:
    """Times several things in turn, so that the machine's drift meets all of them alike."""

    def __init__(self, repeats: int, bar: tqdm) -> None:
        self.repeats, self.bar = repeats, bar

    def times(
        self, *things: Callable[[], object], calls: int = 1, before: Callable[[], object] = int
    ) -> list[list[float]]:
        """Seconds per call, ``[thing][repeat]``; ``before`` runs untimed ahead of each round."""
        found: list[list[float]] = [[] for _ in things]
        for repeat in range(self.repeats + 1):
            before()
            # Every other round runs backwards: neither is always the one after the other.
            for i in range(len(things)) if repeat % 2 else reversed(range(len(things))):
                start = time.perf_counter()
                for _ in range(calls):
                    things[i]()
                    if torch.cuda.is_initialized():
                        torch.cuda.synchronize()
                if repeat:  # the first round warms up
                    found[i].append((time.perf_counter() - start) / calls)
            self.bar.set_postfix(repeat=f"{repeat}/{self.repeats}")
        return found

    def ratio(self, thing: Callable[[], object], base: Callable[[], object], **options: Any) -> float:
        """Median of the rounds' time of ``thing`` over that of ``base``."""
        one, two = self.times(thing, base, **options)
        return statistics.median(a / b for a, b in zip(one, two, strict=True))


def bare_windows(data: TensorDict, batch: int) -> Callable[[], list[torch.Tensor]]:
    """Windows as one would write them in bare torch."""
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


def windows_over_torch(clock: Clock) -> dict[str, float]:
    """Windows per second of the replay buffer over those of bare torch, by batch."""
    data, found = steps(400, 200), {}
    for batch in (BATCH, 1024):
        buffer = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO)
        found[str(batch)] = clock.ratio(bare_windows(data, batch), buffer.sample, calls=100)
    return found


def lerobot_windows_over_getitem(clock: Clock) -> float | None:
    """Windows of a LeRobotDataset, over those that its own ``__getitem__`` gives."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    if not all(importlib.util.find_spec(name) for name in ("lerobot", "datasets", "pyarrow")):
        tqdm.write("lerobot_windows_over_getitem: skipped, needs warmprior[lerobot]")
        return None
    logging.disable(logging.WARNING)  # about video decoders, which are not used here
    from lerobot.datasets import LeRobotDataset

    data, fps = steps(25, 200), 20
    kind = {"dtype": "float32", "names": None}
    features = {"observation.state": kind | {"shape": (D_O,)}, "action": kind | {"shape": (D_A,)}}
    with tempfile.TemporaryDirectory() as folder:
        root, name = Path(folder) / "data", "local/windows"
        options = {"fps": fps, "features": features, "root": root}
        written = LeRobotDataset.create(name, use_videos=False, **options)
        for i, row in enumerate(data):
            state, action = row["observation"].numpy(), row["action"].numpy()
            written.add_frame({"observation.state": state, "action": action, "task": "none"})
            if i == len(data) - 1 or data["episode"][i + 1] != data["episode"][i]:
                written.save_episode()
        written.finalize()
        offsets = {
            "action": [i / fps for i in range(-H, H)],
            "observation.state": [i / fps for i in range(1 - TO, 1)],
        }
        theirs = LeRobotDataset(name, root=root, delta_timestamps=offsets)
        read = LeRobotExperienceReplay(root).data
        buffer = window_replay_buffer(read, PRIOR, batch_size=BATCH, observation_steps=TO)
        ratio = clock.ratio(
            lambda: [theirs[i] for i in torch.randint(len(data), (64,)).tolist()],
            lambda: [buffer.sample() for _ in range(20)],
        )
    return ratio * 20 * BATCH / 64


def chunk_step_overhead(clock: Clock) -> float:
    # Statistics that leave actions as they are, so that both sides simulate the same.
    high = {"observation": torch.ones(D_O), "action": torch.ones(D_A)}
    normalizer = Normalizer({key: -value for key, value in high.items()}, high)
    alone, wrapped = RobosuiteEnv("square"), RobosuiteEnv("square")  # of 400 steps; 40 are taken
    env = TransformedEnv(wrapped, policy_transforms(PRIOR, normalizer=normalizer))
    chunks = torch.rand(5, H, D_A, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    data = None

    def before() -> None:
        nonlocal data
        env.set_seed(0, static_seed=True)
        data = env.reset()
        alone.loop.reset(0)

    def decisions() -> None:
        nonlocal data
        for chunk in chunks:
            data = env.step_mdp(env.step(data.set(("vla_action", "chunk"), chunk)))

    actions = chunks.flatten(0, 1).numpy()
    return clock.ratio(decisions, lambda: [alone.loop.step(a) for a in actions], before=before) - 1


def empty_cell(number: int, folder: Path) -> int:
    """What a cell costs beside its episodes: a job, and the file that tells its result."""
    path = folder / f"{number}.json"
    write_atomic(path, lambda temporary: temporary.write_text("{}"))
    return len(read_json(path))


def job_overhead(clock: Clock) -> dict[str, float]:
    """Seconds per job that does nothing and writes its result, one after another, on each engine."""
    with tempfile.TemporaryDirectory() as name, fresh_processes(1) as local:
        folder = Path(name)

        def locally() -> None:
            for number in range(100):
                local.submit(empty_cell, number, folder).result()

        engines = {"local": locally}
        with contextlib.ExitStack() as stack:
            if importlib.util.find_spec("ray"):
                ray = stack.enter_context(ray_cluster(num_cpus=1))
                task = ray.remote(empty_cell)
                engines["ray"] = lambda: [ray.get(task.remote(n, folder)) for n in range(100)]
            rounds = clock.times(*engines.values())
    return {name: statistics.median(r) / 100 for name, r in zip(engines, rounds, strict=True)}


FIGURES: dict[str, Callable[[Clock], Any]] = {
    measure.__name__: measure
    for measure in (
        windows_over_torch,
        lerobot_windows_over_getitem,
        training.ddp_efficiency,
        training.cuda_train_step_over_network,
        training.cuda_latency,
        chunk_step_overhead,
        job_overhead,
    )
}


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--only", nargs="+", choices=FIGURES, metavar="NAME", help=f"of {', '.join(FIGURES)}")
    add("--out", type=Path, default=Path("runs/throughput"), help="folder of throughput.json")
    add("--repeats", type=int, default=11, help="rounds per figure (default: 11)")
    options = parser.parse_args(argv)
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")
    torch.set_num_threads(1)
    path = options.out / "throughput.json"
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = dict.fromkeys(FIGURES)
    with tqdm(options.only or list(FIGURES), unit="figure", dynamic_ncols=True) as bar:
        for name in bar:
            bar.set_description(name)
            results[name] = FIGURES[name](Clock(options.repeats, bar))
            tqdm.write(f"{name:32} {json.dumps(results[name])}")
    results["meta"] = facts_of_machine(torch_threads=1)
    path.write_text(json.dumps(results, indent=2) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main()
