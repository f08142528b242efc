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
from functools import cache, partial
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm
from training_figures import cloning, small_network

from warmprior import WarmPriorActor
from warmprior.envs.description import environment_of, environment_parts
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.machine import facts_of_machine
from warmprior.io.script import run_script
from warmprior.io.workers import available_cores, working
from warmprior.training import evaluate, load_policy
from warmprior.training.evaluation import parallel_env, play_episode

TRAINED = 400  # training steps that are timed


simulator = cache(environment_of)  # of the policy, one per process


def play(actor: WarmPriorActor, seed: int, nfe: int) -> int:
    """Play an episode; the number of its control steps."""
    return play_episode(actor, simulator(actor), seed, nfe=nfe).steps


def train(actor: WarmPriorActor) -> float:
    """Take training steps of the small preset, whatever the policy; the seconds of each."""
    with tempfile.TemporaryDirectory() as folder:
        training = cloning(small_network(), folder, batch=128)
        start = time.perf_counter()
        for _ in range(TRAINED):
            training.step()
        return (time.perf_counter() - start) / TRAINED


def measured(
    actor: WarmPriorActor, nfe: int, seeds: Sequence[int], processes: int, bar: tqdm
) -> dict[str, float]:
    """Seconds of the work with so many processes, once each has played an episode."""
    found: dict[str, float] = {}
    with working(processes, actor) as call:

        def pooled(jobs: Sequence[Callable[[WarmPriorActor], Any]]) -> tuple[float, list[Any]]:
            start = time.perf_counter()
            results = [future.result() for future in [call(job) for job in jobs]]
            return time.perf_counter() - start, results

        pooled([partial(play, seed=seed, nfe=nfe) for seed in range(2 * processes)])  # all have a simulator
        found["apart"], _ = pooled([partial(play, seed=seed, nfe=nfe) for seed in seeds])
        bar.update()
        _, each = pooled([train] * 2 * processes)
        found["training"] = statistics.median(each) / processes
        bar.update()
    env = parallel_env(*environment_parts(actor), processes)
    options = {"nfe": nfe, "first_seed": seeds[0]}
    evaluate(actor, env, episodes=processes, **options)
    start = time.perf_counter()
    evaluate(actor, env, episodes=len(seeds), **options)
    found["lockstep"] = time.perf_counter() - start
    env.close()
    bar.update()
    return found


def run(argv: Sequence[str] | None) -> None:
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
    actor = load_policy(options.policy)
    actor.ode.check_nfe(options.nfe)
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + options.episodes)
    total = 3 * options.repeats * len(options.processes)
    with tqdm(total=total, unit="part", dynamic_ncols=True) as bar:
        # In turn, so that the machine's drift meets all alike.
        rounds = [
            {n: measured(actor, options.nfe, seeds, n, bar) for n in options.processes}
            for _ in range(options.repeats)
        ]
    found = {n: pd.DataFrame([one[n] for one in rounds]).median().to_dict() for n in options.processes}
    results = {
        "policy": str(options.policy),
        "episodes": options.episodes,
        "measured": found,
        "meta": facts_of_machine(torch_threads=1),
    }
    (options.out / "scaling.json").write_text(json.dumps(results, indent=2) + "\n")
    rows = {
        f"{n} processes": {
            "episodes/min": f"{60 * options.episodes / row['apart']:.1f}",
            "times as fast": f"{found[1]['apart'] / row['apart']:.2f}",
            "lockstep": f"{found[1]['apart'] / row['lockstep']:.2f}",
            "training": f"{found[1]['training'] / row['training']:.2f}",
        }
        for n, row in found.items()
    }
    print(f"{options.episodes} episodes:", pd.DataFrame(rows).T.to_string(), sep="\n\n")
    print(f"\nwritten to {options.out}")


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "scaling.py")


if __name__ == "__main__":
    import scaling  # its processes find jobs in a module that they can import

    sys.exit(scaling.main())
