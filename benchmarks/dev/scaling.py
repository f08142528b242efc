"""How training and evaluation grow with cores: measured up to those of this machine, simulated beyond.

python benchmarks/dev/scaling.py runs/policies/square-ph-past-seed0-0123456789/policy_010000

The policy plays episodes; their decisions and control steps are timed. Two processes and more are then
measured side by side, playing as the benchmarks do and as rows of a vectorised environment in lockstep,
and the recorded durations are put together anew for as many cores as asked for.
"""

from __future__ import annotations

import argparse
import heapq
import json
import statistics
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from torchrl.envs import EnvBase
from tqdm import tqdm
from training_figures import PRIOR, TO, small_network, steps

from warmprior import WarmPriorActor
from warmprior.envs.description import environment_of, environment_parts
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.machine import facts_of_machine
from warmprior.io.processes import working
from warmprior.io.script import run_script
from warmprior.io.workers import available_cores
from warmprior.training import BehaviourCloning, TrainingConfig, evaluate, load_policy
from warmprior.training.evaluation import parallel_env, play_episode

TRAINED = 400  # training steps that are timed

Decide = Callable[[int], float]
"""Seconds in which a policy decides for as many episodes at once."""


@dataclass(frozen=True)
class Played:
    """An episode as it was recorded.

    Attributes:
        decisions: seconds that each decision took, alone.
        steps: seconds until the environment needed the next one, or had ended; with the reset first.
    """

    decisions: tuple[float, ...]
    steps: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """The whole episode, played by one process."""
        return sum(self.decisions) + sum(self.steps)


def apart(episodes: Sequence[Played], cores: int) -> float:
    """Each process plays whole episodes: whoever is free takes the next."""
    free = [0.0] * cores
    for episode in episodes:
        heapq.heapreplace(free, free[0] + episode.seconds)
    return max(free)


def lockstep(episodes: Sequence[Played], cores: int, decide: Decide) -> float:
    """All rows of a vectorised environment decide together, and the slowest one ends the step.

    Row ``i`` of ``n`` plays the episodes ``i, i + n, i + 2n, ...``.
    """
    rows = [deque(s for e in episodes[i::cores] for s in e.steps) for i in range(cores)]
    total = 0.0
    while any(rows):
        total += decide(cores) + max(row.popleft() for row in rows if row)
    return total


@dataclass
class State:
    """What the processes work with, each with a copy.

    Attributes:
        actor: the policy.
        nfe: its network evaluations per chunk.
    """

    actor: WarmPriorActor
    nfe: int
    _env: EnvBase | None = field(default=None, init=False)

    @property
    def env(self) -> EnvBase:
        """The policy's environment, made when it is needed first."""
        if self._env is None:
            self._env = environment_of(self.actor)
        return self._env


def play(state: State, seed: int) -> int:
    """Play an episode; the number of its control steps."""
    return play_episode(state.actor, state.env, seed, nfe=state.nfe).steps


def train(state: State, iterations: int) -> float:
    """Take training steps of the small preset; the seconds of each."""
    config = TrainingConfig(iterations=iterations, batch_size=128)
    with tempfile.TemporaryDirectory() as folder:
        actor = WarmPriorActor(small_network(), PRIOR)
        cloning = BehaviourCloning(actor, steps(100, 200), config, folder, observation_steps=TO)
        actor.train()
        start = time.perf_counter()
        for _ in range(iterations):
            cloning.step()
        return (time.perf_counter() - start) / iterations


def record(state: State, seed: int) -> Played:
    """Play an episode, and tell how long everything took."""
    marks = [time.perf_counter()]
    hooks = [
        state.actor.register_forward_pre_hook(lambda *_: marks.append(time.perf_counter())),
        state.actor.register_forward_hook(lambda *_: marks.append(time.perf_counter())),
    ]
    play(state, seed)
    for hook in hooks:
        hook.remove()
    seconds = np.diff([*marks, time.perf_counter()])  # reset, decision, step, ..., decision, step
    decisions, walks = seconds[1::2].tolist(), seconds[2::2].tolist()
    walks[0] += seconds[0]
    return Played(tuple(decisions), tuple(walks))


def decide(state: State, observation: TensorDict, repeats: int = 20) -> float:
    """Median seconds of a decision for all rows of an observation."""
    seconds = []
    with torch.no_grad():
        for _ in range(repeats + 1):
            start = time.perf_counter()
            state.actor(observation, nfe=state.nfe)
            seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def measured(
    state: State, seeds: Sequence[int], numbers: Sequence[int], repeats: int, bar: tqdm
) -> dict[int, dict[str, float]]:
    """Median seconds of the same work by number of processes, in turn, so that drift meets all alike."""
    rounds: dict[int, list[dict[str, float]]] = {n: [] for n in numbers}
    for _ in range(repeats):
        for n in numbers:
            rounds[n].append(measured_once(state, seeds, n, bar))
    return {
        n: {name: statistics.median(one[name] for one in ones) for name in ones[0]}
        for n, ones in rounds.items()
    }


def measured_once(state: State, seeds: Sequence[int], processes: int, bar: tqdm) -> dict[str, float]:
    """Seconds of the work with so many processes, once each has played an episode."""
    found: dict[str, float] = {}
    with working(processes, state) as call:

        def pooled(jobs: Sequence[Callable[[State], Any]]) -> tuple[float, list[Any]]:
            start = time.perf_counter()
            results = [future.result() for future in [call(job) for job in jobs]]
            return time.perf_counter() - start, results

        pooled([partial(play, seed=seed) for seed in range(2 * processes)])  # all have a simulator
        found["apart"], _ = pooled([partial(play, seed=seed) for seed in seeds])
        bar.update()
        _, each = pooled([partial(train, iterations=TRAINED)] * 2 * processes)
        found["training"] = statistics.median(each) / processes
        bar.update()
    env = parallel_env(*environment_parts(state.actor), processes)
    options = {"nfe": state.nfe, "first_seed": seeds[0]}
    evaluate(state.actor, env, episodes=processes, **options)
    start = time.perf_counter()
    evaluate(state.actor, env, episodes=len(seeds), **options)
    found["lockstep"] = time.perf_counter() - start
    env.close()
    bar.update()
    return found


def simulated(recorded: Sequence[Played], batches: dict[int, float], cores: int) -> dict[str, float]:
    """How many times as fast as one core the recorded episodes, several times over, are on so many."""

    def interpolated(n: int) -> float:
        return float(np.interp(n, list(batches), list(batches.values())))

    many = [*recorded] * -(-4 * cores // len(recorded))
    alone = apart(many, 1)
    return {"apart": alone / apart(many, cores), "lockstep": alone / lockstep(many, cores, interpolated)}


def draw(path: Path, results: dict[str, Any]) -> None:
    figure = Figure(figsize=(5, 3.8), layout="constrained")
    axis, cores = figure.subplots(), [int(n) for n in results["simulated"]]
    base = results["measured"]["1"]["apart"]
    for name, color in {"apart": "#1f77b4", "lockstep": "#d95f02"}.items():
        y = [row[name] for row in results["simulated"].values()]
        axis.plot(cores, y, "o-", ms=4, label=f"{name}, simulated", color=color)
        x = [int(n) for n in results["measured"]]
        y = [base / row[name] for row in results["measured"].values()]
        axis.plot(x, y, "x", ms=9, mew=2, color=color, label=f"{name}, measured")
    axis.plot(cores, cores, ":", color="0.6", label="ideal")
    axis.set(xscale="log", yscale="log", xlabel="cores", ylabel="times as fast as one core")
    axis.set_xticks(cores, [str(n) for n in cores])
    axis.set_yticks(cores, [str(n) for n in cores])
    axis.minorticks_off()
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def report(results: dict[str, Any]) -> str:
    base, episodes = results["measured"]["1"], results["episodes"]
    rows = {
        f"{n} processes": {
            "episodes/min": f"{60 * episodes / row['apart']:.1f}",
            "times as fast": f"{base['apart'] / row['apart']:.2f}",
            "lockstep": f"{base['apart'] / row['lockstep']:.2f}",
            "training": f"{base['training'] / row['training']:.2f}",
        }
        for n, row in results["measured"].items()
    }
    lines = [f"Measured, {episodes} episodes:", "", pd.DataFrame(rows).T.to_string(), ""]
    lines += ["Simulated from recorded durations, times as fast as one core:", ""]
    return "\n".join([*lines, pd.DataFrame(results["simulated"]).T.round(2).to_string()])


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("policy", type=Path, help="a saved policy, such as runs/policies/.../policy_010000")
    add("--processes", type=int, nargs="+", help="to measure with (default: 1 and one per core)")
    add("--cores", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32, 64], help="to simulate")
    add("--episodes", type=int, default=24, help="to play (%(default)s)")
    add("--repeats", type=int, default=3, help="of what is measured (%(default)s)")
    add("--nfe", type=int, default=1, help="network evaluations per chunk (%(default)s)")
    add("--out", type=Path, default=Path("runs/scaling"), help="output folder (%(default)s)")
    options = parser.parse_args(argv)
    options.processes = sorted({1, *(options.processes or [available_cores()])})
    if max(options.processes) > available_cores():
        parser.error(f"--processes can be measured up to the number of cores, {available_cores()}")
    if min([*options.processes, *options.cores, options.repeats]) < 1 or options.episodes < 2:
        parser.error("--processes, --cores and --repeats must be at least 1, --episodes at least 2")
    return options


def run(argv: Sequence[str] | None) -> None:
    options = parse(argv)
    actor = load_policy(options.policy)
    actor.ode.check_nfe(options.nfe)
    options.out.mkdir(parents=True, exist_ok=True)
    state = State(actor, options.nfe)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + options.episodes)
    results: dict[str, Any] = {"policy": str(options.policy), "episodes": options.episodes}
    total = options.episodes + 3 * options.repeats * len(options.processes)
    with tqdm(total=total, unit="part", dynamic_ncols=True) as bar:
        # Before this process has an environment of its own, which its workers would inherit.
        results["measured"] = measured(state, seeds, options.processes, options.repeats, bar)
        recorded = []
        for seed in seeds:
            recorded.append(record(state, seed))
            bar.update()
    observation = state.env.reset()
    # Up to as many rows as are simulated; in between it is interpolated.
    sizes = [2**i for i in range(max(options.cores).bit_length() + 1)]
    batches = {n: decide(state, torch.stack([observation] * n)) for n in sizes}
    state.env.close()
    results["decision_seconds"] = batches
    results["recorded"] = [{"decisions": p.decisions, "steps": p.steps} for p in recorded]
    results["simulated"] = {n: simulated(recorded, batches, n) for n in options.cores}
    results = json.loads(json.dumps(results))
    best = results["measured"][str(options.processes[-1])]
    results["evaluation_over_lockstep"] = best["lockstep"] / best["apart"]
    results["training_scaling"] = (
        results["measured"]["1"]["training"] / best["training"] / options.processes[-1]
    )
    results["meta"] = facts_of_machine(torch_threads=1)
    (options.out / "scaling.json").write_text(json.dumps(results, indent=2) + "\n")
    (options.out / "table.txt").write_text(report(results))
    draw(options.out / "scaling.png", results)
    print(report(results))
    for name in ("evaluation_over_lockstep", "training_scaling"):
        print(f"{name} with {options.processes[-1]} processes: {results[name]:.2f}")
    print(f"written to {options.out}")


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "scaling.py")


if __name__ == "__main__":
    sys.exit(main())
