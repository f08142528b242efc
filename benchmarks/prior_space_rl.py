"""The paper's Fig. 7: reinforcement learning in the source space of a frozen policy.

python benchmarks/prior_space_rl.py --preset unit            # the navigation toy, under two minutes
python benchmarks/prior_space_rl.py                          # can from a weak policy, half an hour
python benchmarks/prior_space_rl.py --preset paper --task square --run runs/square-ph-paper
python benchmarks/prior_space_rl.py --resume                 # after an interruption

A frozen policy per prior and seed comes from --run (a finished run of robomimic.py) or is trained first.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import _experiment as experiment
import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior import GaussianPrior, PastPrior, PreviewPrior, Prior, PriorAnchor, WarmPriorActor
from warmprior._files import check_writable, write_atomic
from warmprior.data.tasks import EVALUATION_SEED
from warmprior.diagnostics import (
    Row,
    plot_reinforcement,
    plot_success,
    summarize_seeds,
    write_results,
)
from warmprior.diagnostics.results import PRIOR_LABELS
from warmprior.envs import GoalNavigationEnv
from warmprior.training import (
    NAVIGATION_PRESETS,
    PRESETS,
    NavigationStudy,
    Preset,
    PriorSpaceConfig,
    PriorSpaceTraining,
    parallel_env,
)
from warmprior.transforms import policy_transforms

PRIORS: dict[str, type[Prior]] = {"base": GaussianPrior, "past": PastPrior, "preview": PreviewPrior}
TASKS = ("navigation", "lift", "can", "square", "transport")
OFFICIAL = {
    "lift": {"gamma": 0.99, "updates": 30, "warmup_steps": 24_000},
    "can": {"gamma": 0.99, "updates": 20, "warmup_steps": 24_000},
    "square": {"gamma": 0.999, "updates": 20, "warmup_steps": 32_000},
    "transport": {"gamma": 0.99, "updates": 20, "warmup_steps": 640_000, "hidden_dim": 128},
}
"""DSRL's hyper-parameters per task, where they differ from :class:`PriorSpaceConfig`'s."""


@dataclass(frozen=True)
class Budget:
    """What a preset spends; options of the command line replace its parts."""

    summary: str
    config: PriorSpaceConfig
    pretraining: Preset
    priors: tuple[str, ...]
    seeds: int
    envs: int
    chunk: int


BUDGETS = {
    "unit": Budget(
        summary="the navigation toy with a goal, three seeds: under two minutes",
        config=PriorSpaceConfig(
            environment_steps=14_000,
            warmup_steps=3_000,
            nfe=2,
            updates=6,
            noise_critic_steps=3,
            learning_rate=1e-3,
            gamma=1.0,
            hidden_dim=128,
            num_layers=2,
            reward_offset=0.0,
            evaluate_every=7_000,
            evaluation_episodes=128,
        ),
        pretraining=PRESETS["quick"],  # not used: the toy has a recipe of its own
        priors=("past",),
        seeds=3,
        envs=32,
        chunk=4,
    ),
    "quick": Budget(
        summary="can from a weak policy, WP-Past against the base, two seeds: half an hour",
        config=PriorSpaceConfig(
            environment_steps=24_000,
            warmup_steps=4_000,
            nfe=1,
            updates=4,
            noise_critic_steps=2,
            batch_size=128,
            hidden_dim=128,
            evaluate_every=8_000,
            evaluation_episodes=25,
        ),
        pretraining=replace(
            PRESETS["quick"], training=replace(PRESETS["quick"].training, iterations=500)
        ),
        priors=("base", "past"),
        seeds=2,
        envs=2,
        chunk=8,
    ),
    "paper": Budget(
        summary="DSRL's hyper-parameters per task, three seeds: needs a GPU",
        config=PriorSpaceConfig(environment_steps=1_000_000),
        pretraining=PRESETS["paper"],
        priors=("base", "past", "preview"),
        seeds=3,
        envs=4,
        chunk=4,
    ),
}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    told = "; ".join(f"{name}: {budget.summary}" for name, budget in BUDGETS.items())
    add("--preset", default="quick", choices=BUDGETS, help=f"{told} (%(default)s)")
    add("--task", choices=TASKS, help="default: navigation, the toy, in unit; can otherwise")
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--dataset", type=Path, help="a robomimic HDF5 file for the frozen policy")
    add("--download", action="store_true", help="fetch the official file from the hub instead")
    add("--run", type=Path, help="take the frozen policies of this finished run of robomimic.py")
    add(
        "--algorithm",
        nargs="+",
        choices=("dsrl-na", "dsrl-sac"),
        help="default: dsrl-na; for transport in paper dsrl-sac too, the official choice",
    )
    add("--prior", nargs="+", choices=PRIORS, help="default: the preset's")
    add("--delta", type=float, help="half the agent's box (default: 0.5 around a mean, 1.5 else)")
    add("--nfe", type=int, help="network evaluations per chunk (default: the preset's)")
    add(
        "--chunk", type=int, help="chunk length H of a newly trained policy (default: the preset's)"
    )
    add("--steps", type=int, help="control steps, warm-up included (default: the preset's)")
    add("--warmup", type=int, help="control steps of the warm-up (default: the preset's)")
    add("--updates", type=int, help="updates per vector step (default: the preset's)")
    add("--evaluate-every", type=int, help="control steps (default: the preset's)")
    add("--episodes", type=int, help="per evaluation (default: the preset's)")
    add(
        "--iterations", type=int, help="gradient steps of the frozen policy (default: the preset's)"
    )
    add("--demonstrations", type=int, help="of the frozen policy (default: the preset's)")
    add("--seeds", type=int, help="number of seeds (default: the preset's)")
    add("--envs", type=int, help="parallel environments (default: the preset's)")
    add("--out", type=Path, help="output folder (default: a numbered one under runs/)")
    add("--resume", action="store_true", help="continue in --out, or in the latest default folder")
    add("--device", default="cpu", help="of the networks (%(default)s)")
    add("--compile", action="store_true", help="torch.compile the network in the first training")
    add("--logger", default="csv", choices=("csv", "none"), help="of the first training")
    return parser


def default_task(args: argparse.Namespace) -> str:
    return "navigation" if args.preset == "unit" else "can"


def make_config(args: argparse.Namespace) -> tuple[Budget, PriorSpaceConfig]:
    budget = BUDGETS[args.preset]
    values: dict[str, Any] = dict(OFFICIAL[args.task]) if args.preset == "paper" else {}
    values |= {
        name: value
        for name, value in {
            "delta": args.delta,
            "nfe": args.nfe,
            "environment_steps": args.steps,
            "warmup_steps": args.warmup,
            "updates": args.updates,
            "evaluate_every": args.evaluate_every,
            "evaluation_episodes": args.episodes,
        }.items()
        if value is not None
    }
    config = replace(budget.config, **values)
    for name in ("seeds", "envs", "chunk"):
        value = getattr(args, name)
        if value is not None:
            if value < 1:
                raise ValueError(f"--{name} must be at least 1, got {value}")
            budget = replace(budget, **{name: value})
    if args.prior is not None:
        budget = replace(budget, priors=tuple(dict.fromkeys(args.prior)))
    if args.iterations is not None:
        training = replace(budget.pretraining.training, iterations=args.iterations)
        budget = replace(budget, pretraining=replace(budget.pretraining, training=training))
    return budget, config


Task = tuple[WarmPriorActor, Callable[[int], EnvBase]]


def toy_task(budget: Budget, folder: Path, name: str, seed: int) -> Task:
    """A policy that knows both routes, and the toy that rewards one."""
    quick = NAVIGATION_PRESETS["quick"]
    preset = replace(quick, training=replace(quick.training, iterations=1_000, save_every=1_000))
    study = NavigationStudy(preset, {name: PRIORS[name](budget.chunk)}, folder)
    actor = study.train(name, seed)

    def make_env(env_seed: int) -> EnvBase:
        transforms = policy_transforms(actor.prior, observation_steps=1)
        transforms.append(PriorAnchor(actor.prior, seed=env_seed))
        return TransformedEnv(GoalNavigationEnv(batch_size=[budget.envs]), transforms)

    return actor, make_env


def manipulation_env(make_workers: Callable[[], EnvBase], prior: Prior, env_seed: int) -> EnvBase:
    # The anchor outside of the workers: one transform draws for all of them.
    env = TransformedEnv(make_workers(), PriorAnchor(prior, seed=env_seed))
    env.set_seed(env_seed, static_seed=True)
    return env


def manipulation_tasks(args: argparse.Namespace, budget: Budget) -> Callable[[str, int], Task]:
    """Frozen policies and simulators, by prior and seed."""
    policies = experiment.find_policies(args, budget.pretraining)
    stored = experiment.finished_run(args.run, args.device)[1] if args.run else None

    def task(name: str, seed: int) -> Task:
        if stored is None:
            actor = policies.policy(PRIORS[name](budget.chunk), seed)
        else:
            group = stored.get(PRIORS[name].name, [])
            if not group:
                raise ValueError(f"--run {args.run} has no policy of the prior {name}")
            actor = group[seed % len(group)]
        transforms = partial(
            policy_transforms,
            actor.prior,
            normalizer=policies.normalizer,
            observation_steps=actor.network.observation_steps,
        )
        workers = partial(parallel_env, policies.make_env, transforms, budget.envs)
        return actor, partial(manipulation_env, workers, actor.prior)

    return task


def summarize(name: str, seed: int, config: PriorSpaceConfig, training: Any) -> dict[str, Any]:
    """One row per agent: from where to where."""
    last = {row["evaluation"]: row for row in training.curve}
    return {
        "algorithm": config.algorithm,
        "prior": PRIORS[name].name,
        "delta": training.decoder.delta,
        "nfe": config.nfe,
        "chunk": training.actor.prior.chunk_length,
        "seed": seed,
        "environment_steps": training.steps,
        "episodes": config.evaluation_episodes,
        "base_success": last["base"]["success_rate"],
        "final_success": last["greedy"]["success_rate"],
        "final_success_stochastic": last["stochastic"]["success_rate"],
    }


def make_table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| agent | delta | control steps | frozen policy (%) | greedy agent (%) | stochastic agent (%) |",
        "|" + "---|" * 6,
    ]
    for algorithm, prior in dict.fromkeys((row["algorithm"], row["prior"]) for row in rows):
        group = [row for row in rows if (row["algorithm"], row["prior"]) == (algorithm, prior)]
        cells = []
        for key in ("base_success", "final_success", "final_success_stochastic"):
            summary = summarize_seeds([row[key] for row in group])
            spread = f" ± {100 * summary.std:.1f}" if summary.seeds > 1 else ""
            cells.append(f"{100 * summary.mean:.1f}{spread}")
        label = f"{algorithm.upper()}, {PRIOR_LABELS[prior]} ({len(group)} seeds)"
        steps = max(row["environment_steps"] for row in group)
        lines.append(f"| {label} | {group[0]['delta']:g} | {steps} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(rows: list[dict[str, Any]], out: Path, curve: Any, title: str, warmup: int) -> None:
    plot_reinforcement(curve, out / "curves.png", title=title, warmup_steps=warmup)
    for algorithm in dict.fromkeys(row["algorithm"] for row in rows):
        cells = [
            Row(
                task="",
                data="",
                prior=row["prior"],
                sigma=0.0,
                chunk=row["chunk"],
                nfe=row["nfe"],
                seed=row["seed"],
                checkpoint=0,
                episodes=row["episodes"],
                successes=round(row["final_success"] * row["episodes"]),
                mean_steps=0.0,
            )
            for row in rows
            if row["algorithm"] == algorithm
        ]
        plot_success(
            cells,
            out / f"success_{algorithm}.png",
            priors=list(dict.fromkeys(cell.prior for cell in cells)),
            nfes=[cells[0].nfe],
            title=f"{title}: greedy {algorithm.upper()} agents",
        )


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "rl-", default_task)
        unit = args.task == "navigation"
        if unit != (args.preset == "unit"):
            raise ValueError("--task navigation and --preset unit belong together")
        budget, config = make_config(args)
        experiment.check(args)
        check_writable(args.out)
        options = experiment.store_options(args)
        print(f"Output folder: {args.out}", flush=True)
        task = (
            partial(toy_task, budget, args.out / "policies")
            if unit
            else manipulation_tasks(args, budget)
        )
        if unit:
            torch.set_num_threads(1)  # more of them only wait for each other
        packages = ("warmprior", "torch", "torchrl", "tensordict")
        meta: dict[str, Any] = {
            "versions": {package: version(package) for package in packages},
            "hardware": {"cores": os.cpu_count(), "torch_threads": torch.get_num_threads()},
            "options": options,
        }
        rows: list[dict[str, Any]] = []
        curve: list[dict[str, Any]] = []
        started = time.monotonic()
        for seed in range(budget.seeds):
            for algorithm in args.algorithm or ["dsrl-na"]:
                for name in budget.priors:
                    mine = replace(config, algorithm=algorithm, seed=seed)
                    actor, make_env = task(name, seed)
                    training = PriorSpaceTraining(
                        actor,
                        make_env,
                        mine,
                        args.out / f"{algorithm}-{name}-seed{seed}",
                        evaluation_seed=EVALUATION_SEED,
                        description=f"{algorithm} {name}, seed {seed}",
                    )
                    training.run()
                    rows.append(summarize(name, seed, mine, training))
                    key = {"algorithm": algorithm, "prior": PRIORS[name].name, "seed": seed}
                    curve += [key | row for row in training.curve]
                    meta["wall_time_s"] = time.monotonic() - started
                    write_results(args.out / "results.json", meta, rows, curve=curve)
        table = make_table(rows)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        where = "navigation to a goal" if unit else f"{args.task} {args.data}"
        draw(rows, args.out, curve, f"{where}, NFE {config.nfe}", config.warmup_steps)
    except experiment.ERRORS as error:
        print(f"prior_space_rl.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
