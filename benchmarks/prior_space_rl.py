"""The paper's Fig. 7: reinforcement learning in the source space of a frozen policy.

python benchmarks/prior_space_rl.py --preset unit            # the navigation toy, under two minutes
python benchmarks/prior_space_rl.py                          # lift from a weak policy, half an hour
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
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import _experiment as experiment
import torch
from _prior_space_budgets import BUDGETS, Budget, algorithms, make_config
from _prior_space_report import draw, make_table, summarize
from torchrl.envs import EnvBase, TransformedEnv

from warmprior import Prior, PriorAnchor, WarmPriorActor
from warmprior.diagnostics import write_results
from warmprior.envs import GoalNavigationEnv, get_task
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.files import check_writable, write_atomic
from warmprior.rl import PriorSpaceTraining
from warmprior.training import PRESETS, NavigationStudy, parallel_env
from warmprior.training.policies import Policies
from warmprior.training.threads import torch_threads
from warmprior.transforms import policy_transforms

PER_AGENT = ("algorithm", "backup_entropy", "delta", "seed")
TASKS = ("navigation", "lift", "can", "square", "transport")
Task = tuple[WarmPriorActor, Callable[[int], EnvBase]]


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    told = "; ".join(f"{name}: {budget.summary}" for name, budget in BUDGETS.items())
    add("--preset", default="quick", choices=BUDGETS, help=f"{told} (%(default)s)")
    add("--task", choices=TASKS, help="default: navigation, the toy, in unit; lift otherwise")
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--dataset", type=Path, help="a robomimic HDF5 file for the frozen policy")
    add("--download", action="store_true", help="fetch the official file from the hub instead")
    add(
        "--run", type=Path, help="take policies, task and data of this finished run of robomimic.py"
    )
    add(
        "--algorithm",
        nargs="+",
        choices=("dsrl-na", "dsrl-sac"),
        help="default: dsrl-na; for transport in paper dsrl-sac too, the official choice",
    )
    add("--prior", nargs="+", metavar="NAME", help="as for robomimic.py (default: the preset's)")
    add("--delta", type=float, help="half the agent's box (default: 0.5 around a mean, 1.5 else)")
    add("--horizon", type=int, help="time limit in control steps (default: the preset's or task's)")
    add("--alpha", type=float, help="initial temperature (default: the preset's)")
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
    if args.run is not None:
        return str(experiment.run_facts(args.run)["task"])
    return "navigation" if args.preset == "unit" else "lift"


def toy_task(args: argparse.Namespace, budget: Budget, prior: Prior, seed: int) -> Task:
    """A policy that knows both routes, and the toy that rewards one."""
    study = NavigationStudy(budget.pretraining, {prior.name: prior}, args.out / "policies")
    with torch_threads(budget.threads):
        actor = study.train(prior.name, seed).to(args.device)

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


def manipulation_tasks(
    args: argparse.Namespace, budget: Budget
) -> tuple[Callable[[Prior, int], Task], dict[str, Any]]:
    """Frozen policies and simulators, by prior and seed; and the facts about them."""
    stored = None
    if args.run is None:
        policies = experiment.find_policies(args, budget.pretraining)
    else:
        policies, stored = finished_policies(args)
        names = [Prior.find(name).name for name in budget.priors]
        missing = [name for name in names if name not in stored]
        if missing:
            raise ValueError(
                f"--run {args.run} has policies of {', '.join(stored)}, but none of {', '.join(missing)}"
            )

    def frozen(prior: Prior, seed: int) -> WarmPriorActor:
        if stored is None:
            return policies.policy(prior, seed)
        group = stored[prior.name]
        if seed >= len(group):
            print(f"--run has {len(group)} seeds of {prior.name}: agent {seed} shares a policy")
        return group[seed % len(group)]

    def task(prior: Prior, seed: int) -> Task:
        # A copy of its own: to continue, an agent must find the very policy it began with, even if
        # another version would train another by now.
        kept = args.out / "policies" / f"{prior.name}-seed{seed}"
        if not (args.resume and (kept / "config.json").exists()):
            frozen(prior, seed).save_pretrained(kept)
        actor = WarmPriorActor.from_pretrained(kept, device=args.device)
        transforms = partial(
            policy_transforms,
            actor.prior,
            normalizer=policies.normalizer,
            observation_steps=actor.network.observation_steps,
        )
        make_worker = partial(policies.make_env, horizon=budget.horizon)
        workers = partial(parallel_env, make_worker, transforms, budget.envs)
        return actor, partial(manipulation_env, workers, actor.prior)

    facts = policies.facts()
    horizon = budget.horizon or get_task(facts["task"]).horizon(facts["style"])
    return task, facts | {"horizon": horizon}


def finished_policies(
    args: argparse.Namespace,
) -> tuple[Policies, dict[str, list[WarmPriorActor]]]:
    """The data of a finished run, from which its simulators and normaliser follow, and its policies."""
    meta, actors = experiment.finished_run(args.run, args.device)
    if args.task != meta["task"]:
        raise ValueError(f"--run {args.run} is of {meta['task']}, not of {args.task}")
    options = meta["options"]
    data = {key: options[key] for key in ("data", "dataset", "download", "demonstrations")}
    data["dataset"] = data["dataset"] and Path(data["dataset"])
    theirs = argparse.Namespace(**vars(args) | data)
    policies = experiment.find_policies(theirs, PRESETS[options["preset"]])
    if policies.demonstrations.sha256 != meta["data"]["sha256"]:
        raise ValueError(
            f"{policies.demonstrations.path} is not the file that --run {args.run} was trained on: its "
            "policies would meet observations normalised in another way. Put the file back, or run "
            "robomimic.py again"
        )
    return policies, actors


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "rl-", default_task, changeable=())
        budget, config = make_config(args)
        experiment.check(args)
        check_writable(args.out)
        options = experiment.store_options(args)
        print(f"Output folder: {args.out}", flush=True)
        if args.preset == "unit":
            task, facts = partial(toy_task, args, budget), {"task": args.task}
        else:
            task, facts = manipulation_tasks(args, budget)
        packages = ("warmprior", "torch", "torchrl", "tensordict")
        meta: dict[str, Any] = {
            "versions": {package: version(package) for package in packages},
            "hardware": {
                "cores": os.cpu_count(),
                "torch_threads": budget.threads or torch.get_num_threads(),
            },
            "options": options,
            "config": {k: v for k, v in asdict(config).items() if k not in PER_AGENT},
            **facts,
        }
        rows: list[dict[str, Any]] = []
        curve: list[dict[str, Any]] = []
        diverged: list[str] = []
        started = time.monotonic()
        priors = [Prior.make(name, budget.chunk) for name in budget.priors]
        for seed, algorithm, prior in product(range(budget.seeds), algorithms(args), priors):
            agent = f"{algorithm} {prior.name}, seed {seed}"
            mine = budget.agent(config, algorithm, prior, seed)
            actor, make_env = task(prior, seed)
            training = PriorSpaceTraining(
                actor,
                make_env,
                mine,
                args.out / f"{algorithm}-{prior.name}-seed{seed}",
                evaluation_seed=EVALUATION_SEED,
                description=agent,
            )
            try:
                with torch_threads(budget.threads):
                    training.run()
                rows.append(summarize(seed, mine, training))
            except FloatingPointError as error:  # no reason to keep the other agents from learning
                diverged.append(f"{agent}: {error}")
            key = {"algorithm": algorithm, "prior": prior.name, "seed": seed}
            curve += [key | row for row in training.curve]
            meta["wall_time_s"] = time.monotonic() - started
            write_results(args.out / "results.json", meta, rows, curve=curve)
        table = make_table(rows)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        where = " ".join(facts[key] for key in ("task", "style") if key in facts)
        if rows:
            draw(rows, args.out, curve, f"{where}, NFE {config.nfe}", config.warmup_steps)
        if diverged:
            raise FloatingPointError("; ".join(diverged))
    except experiment.ERRORS as error:
        print(f"prior_space_rl.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
