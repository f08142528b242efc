"""How training and evaluation grow with processes, measured with one and with one per core.

python benchmarks/dev/scaling.py runs/policies/square-ph-past-seed0-0123456789/policy_010000

The policy plays episodes as the benchmarks do, whole ones in each process, and as rows of a vectorised
environment in lockstep. Then every process trains.
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

import pandas as pd
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


def report(results: dict[str, Any]) -> str:
    base, episodes = results["measured"][1], results["episodes"]
    rows = {
        f"{n} processes": {
            "episodes/min": f"{60 * episodes / row['apart']:.1f}",
            "times as fast": f"{base['apart'] / row['apart']:.2f}",
            "lockstep": f"{base['apart'] / row['lockstep']:.2f}",
            "training": f"{base['training'] / row['training']:.2f}",
        }
        for n, row in results["measured"].items()
    }
    return f"{episodes} episodes:\n\n{pd.DataFrame(rows).T.to_string()}\n"


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("policy", type=Path, help="a saved policy, such as runs/policies/.../policy_010000")
    add("--processes", type=int, nargs="+", help="to measure with (default: 1 and one per core)")
    add("--episodes", type=int, default=24, help="to play (%(default)s)")
    add("--repeats", type=int, default=3, help="of what is measured (%(default)s)")
    add("--nfe", type=int, default=1, help="network evaluations per chunk (%(default)s)")
    add("--out", type=Path, default=Path("runs/scaling"), help="output folder (%(default)s)")
    options = parser.parse_args(argv)
    options.processes = sorted({1, *(options.processes or [available_cores()])})
    if max(options.processes) > available_cores():
        parser.error(f"--processes can be measured up to the number of cores, {available_cores()}")
    if min([*options.processes, options.repeats, options.episodes]) < 1:
        parser.error("--processes, --repeats and --episodes must be at least 1")
    return options


def run(argv: Sequence[str] | None) -> None:
    options = parse(argv)
    actor = load_policy(options.policy)
    actor.ode.check_nfe(options.nfe)
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + options.episodes)
    total = 3 * options.repeats * len(options.processes)
    with tqdm(total=total, unit="part", dynamic_ncols=True) as bar:
        found = measured(State(actor, options.nfe), seeds, options.processes, options.repeats, bar)
    results = {
        "policy": str(options.policy),
        "episodes": options.episodes,
        "measured": found,
        "meta": facts_of_machine(torch_threads=1),
    }
    (options.out / "scaling.json").write_text(json.dumps(results, indent=2) + "\n")
    (options.out / "table.txt").write_text(report(results))
    print(report(results), f"written to {options.out}", sep="\n")


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "scaling.py")


if __name__ == "__main__":
    import scaling  # its processes find jobs in a module that they can import

    sys.exit(scaling.main())
