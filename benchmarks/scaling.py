"""How training and evaluation grow with cores: measured up to those of this machine, simulated beyond.

python benchmarks/scaling.py runs/policies/square-ph-past-seed0-0123456789/policy_010000

The policy plays episodes; their decisions and control steps are timed. Two processes and more are then
measured side by side, playing as the benchmarks do and as rows of a vectorised environment in lockstep,
and the recorded durations are put together anew for as many cores as asked for.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _scaling_simulation import Played, apart, comparison, lockstep, served
from _training_figures import PRIOR, TO, small_network, steps
from tensordict import TensorDict
from torchrl.envs import EnvBase
from tqdm import tqdm

from warmprior import WarmPriorActor
from warmprior.envs.description import environment_of, environment_parts
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments import table
from warmprior.experiments.condition import AT_ONCE
from warmprior.experiments.contestant import Cell
from warmprior.experiments.figures import new_figure
from warmprior.experiments.results import Row, facts_of_machine
from warmprior.experiments.worker import Job, Play
from warmprior.io.script import run_script
from warmprior.io.workers import WorkerPool, available_cores
from warmprior.training import BehaviourCloning, TrainingConfig, evaluate, load_policy
from warmprior.training.evaluation import parallel_env, play_episode

CPU_PRESET = {"policies": 3 * 3 * 8, "iterations": 10_000, "cells": 3, "episodes": 50}
"""Sources times seeds times task-styles, and what is done with each policy."""


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


def pooled(pool: WorkerPool[State], jobs: Sequence[Callable[[State], Any]]) -> tuple[float, list]:
    """Seconds that the jobs take in a pool, and what they give."""
    start, found = time.perf_counter(), []
    for job in jobs:
        pool.submit(job)
    while pool.running:
        found += [result for _, result in pool.wait()]
    return time.perf_counter() - start, found


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


def measured_once(
    state: State, seeds: Sequence[int], processes: int, bar: tqdm
) -> dict[str, float]:
    """Seconds of the work with so many processes, once each has played an episode."""
    found, plays = {}, [partial(play, seed=seed) for seed in seeds]
    iterations = 400
    with WorkerPool(processes, state) as pool:
        pooled(pool, [partial(play, seed=seed) for seed in range(processes)])
        found["apart"], _ = pooled(pool, plays)
        bar.update()
        _, each = pooled(pool, [partial(train, iterations=iterations)] * 2 * processes)
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


def whole_comparison(recorded: Sequence[Played], step: float, cores: int) -> float:
    """Hours of the ``cpu`` preset on all task-styles, if all were like these episodes, at any NFE."""
    cells = [Cell(CPU_PRESET["iterations"], nfe, AT_ONCE) for nfe in range(CPU_PRESET["cells"])]

    def following(number: int) -> dict[Job, float]:
        return {
            Play(number, cell, seed): recorded[seed % len(recorded)].seconds
            for cell in cells
            for seed in range(CPU_PRESET["episodes"])
        }

    seconds = comparison(CPU_PRESET["policies"], CPU_PRESET["iterations"] * step, following, cores)
    return seconds / 3600


def simulated(
    recorded: Sequence[Played], batches: dict[int, float], step: float, cores: int
) -> dict[str, float]:
    """Seconds of the recorded episodes, several times over, on so many cores."""

    def interpolated(n: int) -> float:
        return float(np.interp(n, list(batches), list(batches.values())))

    many = [*recorded] * -(-4 * cores // len(recorded))
    alone = apart(many, 1)
    return {
        "apart": alone / apart(many, cores),
        "lockstep": alone / lockstep(many, cores, interpolated),
        "served": alone / served(many, cores, interpolated),
        "comparison": whole_comparison(recorded, step, 1) / whole_comparison(recorded, step, cores),
    }


def draw(path: Path, results: dict[str, Any]) -> None:
    figure, axes = new_figure(9, 3.8, 1, 2)
    rows = results["simulated"]
    cores = [int(n) for n in rows]
    names = {
        "apart": "episodes apart (as here)",
        "served": "one process decides for all",
        "lockstep": "lockstep",
    }
    colors = {"apart": "#1f77b4", "served": "#2ca02c", "lockstep": "#d95f02"}
    for name, label in names.items():
        y = [row[name] for row in rows.values()]
        axes[0].plot(cores, y, "o-", ms=4, label=label, color=colors[name])
    axes[0].set_title("evaluation")
    y = [row["comparison"] for row in rows.values()]
    axes[1].plot(cores, y, "o-", ms=4, label="simulated", color="#1f77b4")
    axes[1].set_title("a whole comparison")
    base = results["measured"]["1"]
    for axis, key, name in ((axes[0], "apart", "apart"), (axes[0], "lockstep", "lockstep")):
        x = [int(n) for n in results["measured"]]
        y = [base["apart"] / row[key] for row in results["measured"].values()]
        axis.plot(x, y, "x", ms=9, mew=2, color=colors[name], label=f"{name}, measured")
    for axis in axes:
        axis.plot(cores, cores, ":", color="0.6", label="ideal")
        axis.set(xscale="log", yscale="log", xlabel="cores", ylabel="times as fast as one core")
        axis.set_xticks(cores, [str(n) for n in cores])
        axis.set_yticks(cores, [str(n) for n in cores])
        axis.minorticks_off()
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def report(results: dict[str, Any]) -> str:
    base = results["measured"]["1"]
    lines = ["# Scaling", "", f"Measured, {results['episodes']} episodes:", ""]
    rows = [Row({"processes": int(n)}, values) for n, values in results["measured"].items()]
    columns: dict[str, Callable[[list[Row]], str]] = {
        "episodes/min": lambda g: f"{60 * results['episodes'] / g[0]['apart']:.1f}",
        "times as fast": lambda g: f"{base['apart'] / g[0]['apart']:.2f}",
        "lockstep": lambda g: f"{base['apart'] / g[0]['lockstep']:.2f}",
        "training": lambda g: f"{base['training'] / g[0]['training']:.2f}",
    }
    lines += [table(rows, lambda row: f"{row['processes']} processes", None, columns), ""]
    lines += ["Simulated from recorded durations, times as fast as one core:", ""]
    simulated_rows = [Row({"cores": int(n)}, v) for n, v in results["simulated"].items()]
    names = ("apart", "served", "lockstep", "comparison")
    columns = {name: (lambda g, name=name: f"{g[0][name]:.2f}") for name in names}
    lines.append(table(simulated_rows, lambda row: f"{row['cores']} cores", None, columns))
    return "\n".join(lines)


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
    step = results["measured"][1]["training"]
    results["decision_seconds"] = batches
    results["recorded"] = [{"decisions": p.decisions, "steps": p.steps} for p in recorded]
    results["simulated"] = {n: simulated(recorded, batches, step, n) for n in options.cores}
    results["hours_of_cpu_preset"] = {n: whole_comparison(recorded, step, n) for n in options.cores}
    results = json.loads(json.dumps(results))
    best = results["measured"][str(options.processes[-1])]
    results["evaluation_over_lockstep"] = best["lockstep"] / best["apart"]
    results["training_scaling"] = (
        results["measured"]["1"]["training"] / best["training"] / options.processes[-1]
    )
    results["meta"] = facts_of_machine(torch_threads=1)
    (options.out / "scaling.json").write_text(json.dumps(results, indent=2) + "\n")
    (options.out / "table.md").write_text(report(results))
    draw(options.out / "scaling.png", results)
    print(report(results))
    for name in ("evaluation_over_lockstep", "training_scaling"):
        print(f"{name} with {options.processes[-1]} processes: {results[name]:.2f}")
    print(f"written to {options.out}")


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "scaling.py")


if __name__ == "__main__":
    sys.exit(main())
