"""What the runs of prior_space_rl.py spend, and how options change it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import _experiment as experiment

from warmprior import GaussianPrior, PastPrior, PreviewPrior, Prior
from warmprior.training import (
    NAVIGATION_PRESETS,
    PRESETS,
    NavigationPreset,
    Preset,
    PriorSpaceConfig,
)

PRIORS: dict[str, type[Prior]] = {"base": GaussianPrior, "past": PastPrior, "preview": PreviewPrior}
OFFICIAL: dict[str, dict[str, Any]] = {
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
    pretraining: Preset | NavigationPreset
    priors: tuple[str, ...]
    seeds: int
    envs: int
    chunk: int


TOY = NAVIGATION_PRESETS["quick"]

BUDGETS = {
    "unit": Budget(
        summary="the navigation toy with a goal, three seeds: under two minutes",
        config=PriorSpaceConfig(
            environment_steps=12_000,
            warmup_steps=3_000,
            nfe=2,
            updates=6,
            noise_critic_steps=2,
            learning_rate=1e-3,
            gamma=1.0,
            hidden_dim=128,
            num_layers=2,
            reward_offset=0.0,
            evaluate_every=6_000,
            evaluation_episodes=128,
        ),
        pretraining=replace(TOY, training=replace(TOY.training, iterations=800, save_every=800)),
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


def make_config(args: argparse.Namespace) -> tuple[Budget, PriorSpaceConfig]:
    """The chosen budget and recipe with the options that replace parts of them.

    Raises:
        ValueError: for an option that is out of range, or has no effect together with others.
    """
    _refuse_ignored(args)
    budget = BUDGETS[args.preset]
    if (args.preset, args.task) == ("paper", "transport"):
        budget = replace(budget, chunk=8)
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
    budget = experiment.with_counts(budget, args, ("seeds", "envs", "chunk"))
    if args.prior is not None:
        budget = replace(budget, priors=tuple(dict.fromkeys(args.prior)))
    if args.iterations is not None:
        training = budget.pretraining.training.with_iterations(args.iterations)
        budget = replace(budget, pretraining=replace(budget.pretraining, training=training))
    return budget, config


def algorithms(args: argparse.Namespace) -> list[str]:
    """What was asked for; DSRL's own choice for Transport is SAC."""
    if args.algorithm is not None:
        return list(dict.fromkeys(args.algorithm))
    official = args.preset == "paper" and args.task == "transport"
    return ["dsrl-na", "dsrl-sac"] if official else ["dsrl-na"]


def _refuse_ignored(args: argparse.Namespace) -> None:
    if (args.task == "navigation") != (args.preset == "unit"):
        raise ValueError("--task navigation and --preset unit belong together")
    data = {"data": "ph", "dataset": None, "download": False, "demonstrations": None}
    training = {"compile": False, "logger": "csv"}
    if args.preset == "unit":
        told, unused = "the toy has demonstrations of its own", data | training | {"run": None}
    elif args.run is not None:
        told = "--run brings its policies and their data"
        unused = data | training | {"chunk": None, "iterations": None}
    else:
        told, unused = "", {}
    given = [f"--{key}" for key, default in unused.items() if getattr(args, key) != default]
    if given:
        raise ValueError(f"{told}: leave out {', '.join(given)}")
    if args.preset == "paper" and args.task is None:
        raise ValueError(
            f"--preset paper has hyper-parameters per task: add the --task of --dataset {args.dataset}"
        )
