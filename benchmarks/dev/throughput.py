"""Speed and memory of the library as ratios to what it is built on, each measured in one run.

python benchmarks/dev/throughput.py                                  # everything, a few minutes
python benchmarks/dev/throughput.py --only windows_per_second actor_over_network
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import logging
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import training_figures as training
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from tqdm import tqdm
from training_figures import BATCH, D_A, D_O, PRIOR, TO, H, paper_network, small_network, step_of, steps

from warmprior import (
    Normalizer,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)
from warmprior.data import LeRobotExperienceReplay
from warmprior.data.scripted.episode import Episode, write_robomimic
from warmprior.envs import RobosuiteEnv
from warmprior.envs.simulator import task_env_args
from warmprior.history import window_history
from warmprior.io.files import read_json, write_atomic
from warmprior.io.machine import facts_of_machine
from warmprior.io.ray_cluster import ray_cluster
from warmprior.io.workers import fresh_processes
from warmprior.training import precondition


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


def windows_per_second(clock: Clock) -> float:
    buffer = window_replay_buffer(steps(400, 200), PRIOR, batch_size=BATCH, observation_steps=TO)
    (seconds,) = clock.times(buffer.sample, calls=50)
    return BATCH / statistics.median(seconds)


def bare_windows(data: TensorDict, batch: int, select: bool) -> Callable[[], list[torch.Tensor]]:
    """Windows as one would write them in bare torch: by indexing, or by the faster ``index_select``."""
    observation, action, episode = (data[key] for key in ("observation", "action", "episode"))
    length = int((episode == 0).sum())
    before, ahead = torch.arange(1 - TO, 1), torch.arange(-H, H)

    def rows(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        if not select:
            return values[index]
        return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])

    def sample() -> list[torch.Tensor]:
        frame = torch.randint(len(data), (batch, 1))
        start = frame - frame % length
        index = frame + ahead
        warm = index[:, :1] >= start
        actions = rows(action, index.clamp(start, start + length - 1))
        history, target = actions[:, :H], actions[:, H:]
        observations = rows(observation, (frame + before).clamp_min(start))
        is_pad = index[:, H:] >= start + length
        return [observations, target, is_pad, history * warm.unsqueeze(-1), warm]

    return sample


def windows_over_torch(clock: Clock) -> dict[str, float]:
    """Windows per second of the replay buffer over those of bare torch, by batch and way of gathering."""
    data, found = steps(400, 200), {}
    for batch in (BATCH, 1024):
        buffer = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO)
        for name, select in (("index", False), ("index_select", True)):
            bare = bare_windows(data, batch, select)
            found[f"{batch}, {name}"] = clock.ratio(bare, buffer.sample, calls=100)
    with tempfile.TemporaryDirectory() as folder:
        mapped = data.memmap(folder, copy_existing=True)
        buffers = [
            window_replay_buffer(source, PRIOR, batch_size=BATCH, observation_steps=TO)
            for source in (data, mapped)
        ]
        found["memory-mapped over memory"] = clock.ratio(*(b.sample for b in buffers), calls=100)
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
        for row in buffer.sample():
            item = theirs[int(row["frame"])]
            action, pad = item["action"], item["action_is_pad"]
            assert torch.equal(action[H:], row["vla_action", "chunk"])
            assert torch.equal(pad[H:], row["action_is_pad"])
            assert torch.equal(item["observation.state"], row["observation"])
            assert int(row["history", "steps"]) == int((~pad[:H]).sum())
            assert pad[:H].any() or torch.equal(action[:H], row["history", "actions"])
        ratio = clock.ratio(
            lambda: [theirs[i] for i in torch.randint(len(data), (64,)).tolist()],
            lambda: [buffer.sample() for _ in range(20)],
        )
    return ratio * 20 * BATCH / 64


def preconditioning_over_network(clock: Clock) -> float:
    network = precondition(small_network(), steps(400, 200), PRIOR, observation_steps=TO)
    return clock.ratio(step_of(network), step_of(small_network()), calls=20)


def actor_over_network(clock: Clock, compiled: bool = False) -> dict[str, float]:
    call = torch.compile(paper_network().eval()) if compiled else paper_network().eval()
    actor = WarmPriorActor(call, PRIOR).eval()
    t, a, o = torch.rand(1), torch.randn(1, H, D_A), torch.randn(1, TO, D_O)
    history = window_history(a, torch.full((1, 1), H), torch.zeros(1, H, D_A), H)
    data = TensorDict({"observation": o, "history": history}, [1])
    found = {}
    with torch.no_grad():
        for nfe in (1, 3, 9):
            found[str(nfe)] = clock.ratio(
                partial(actor, data, nfe=nfe),
                lambda nfe=nfe: [call(t, a, o) for _ in range(nfe)],
                calls=max(2, 18 // nfe),
            )
    return found


def env_over_robosuite(clock: Clock) -> float:
    envs = RobosuiteEnv("square"), RobosuiteEnv("square", control_loop="robosuite")
    lean, own = (env.loop for env in envs)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, D_A))

    def before() -> None:  # the same episode on both sides: contacts decide what a step costs
        lean.reset(0)
        own.reset(0)

    return clock.ratio(
        lambda: [own.env.step(action) for action in actions],
        lambda: [lean.step(action) for action in actions],
        before=before,
    )


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


def image_windows_over_h5py(clock: Clock) -> float:
    """Batches of windows with images, over decoding their frames from a rendered file."""
    import h5py

    length, episodes, size, batch = 100, 10, 84, 64
    camera, frames = "agentview_image", length * episodes
    smooth = np.add.outer(np.arange(size), np.arange(size))[..., None] + np.arange(3)
    noise = np.random.default_rng(0).integers(0, 8, (frames, size, size, 3))
    images = (smooth + noise).astype(np.uint8)  # compresses about as much as a rendered image
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "images.hdf5"
        with h5py.File(path, "w") as file:
            chunk = (1, size, size, 3)
            file.create_dataset(camera, data=images, chunks=chunk, compression="gzip")
        data = steps(episodes, length)
        vector = data["observation"]
        channels_first = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()
        data["observation"] = TensorDict({"state": vector, camera: channels_first}, [frames])
        data = data.memmap(Path(folder) / "memmap")
        buffer = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO)
        with h5py.File(path) as file:
            stored = file[camera]

            def decode() -> None:
                for i in torch.randint(frames, (batch,)).tolist():
                    first = i - i % length
                    for step in range(TO):
                        stored[max(first, i - step)]

            return clock.ratio(decode, buffer.sample)


LOAD = """
import sys
from warmprior.data import RobomimicExperienceReplay
def memory(name):
    with open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith(name)).split()[1])
RobomimicExperienceReplay(sys.argv[1])  # libraries and caches
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")  # forget the peak so far
before = memory("VmRSS")
data = RobomimicExperienceReplay(sys.argv[2]).data
print((memory("VmHWM") - before) / sum(v.numel() * v.element_size() for v in data.values(True, True)))
"""


def load_memory_over_data(clock: Clock) -> float:
    widths = {"object": 14, "robot0_eef_pos": 3, "robot0_eef_quat": 4, "robot0_gripper_qpos": 2}
    rng = np.random.default_rng(0)

    def episode(seed: int, length: int) -> Episode:
        observations = {k: rng.normal(size=(length + 1, w)) for k, w in widths.items()}
        actions, rewards = rng.uniform(-1, 1, (length, D_A)), np.eye(length)[-1]
        states = np.zeros((length, 1))
        return Episode(seed, 0, "better", True, actions, states, rewards, observations)

    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{size}.hdf5" for size in ("small", "large")]
        for path, count in zip(paths, (2, 2000), strict=True):
            episodes = (episode(i, 500) for i in range(count))
            write_robomimic(path, episodes, env_args=task_env_args("square"), model_file="")
        command = [sys.executable, "-c", LOAD, *map(str, paths)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    return float(done.stdout)


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


FIGURES: dict[str, tuple[Callable[[Clock], Any], str]] = {
    "windows_per_second": (windows_per_second, ">= 150000"),
    "windows_over_torch": (windows_over_torch, ">= 0.6"),
    "lerobot_windows_over_getitem": (lerobot_windows_over_getitem, ">= 500"),
    "train_step_over_network": (training.train_step_over_network, "<= 1.10"),
    "ddp_efficiency": (training.ddp_efficiency, ""),
    "cuda_train_step_over_network": (training.cuda_train_step_over_network, "<= 1.05"),
    "cuda_latency": (training.cuda_latency, ""),
    "preconditioning_over_network": (preconditioning_over_network, "<= 1.02"),
    "actor_over_network": (actor_over_network, "<= 1.10"),
    "actor_over_network_compiled": (partial(actor_over_network, compiled=True), ""),
    "env_over_robosuite": (env_over_robosuite, ">= 2"),
    "chunk_step_overhead": (chunk_step_overhead, "<= 0.10"),
    "load_memory_over_data": (load_memory_over_data, "<= 1.3"),
    "image_windows_over_h5py": (image_windows_over_h5py, ">= 5"),
    "job_overhead": (job_overhead, ""),
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
            measure, target = FIGURES[name]
            results[name] = value = measure(Clock(options.repeats, bar))
            shown = f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
            tqdm.write(f"{name:32} {shown} {f'(target {target})' if target else ''}")
    results["meta"] = facts_of_machine(
        cpu=platform.processor() or platform.machine(),
        torch_threads=torch.get_num_threads(),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    path.write_text(json.dumps(results, indent=2) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main()
