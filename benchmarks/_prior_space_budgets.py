"""What the runs of prior_space_rl.py spend, and how options change it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import _experiment as experiment

from warmprior import Prior
from warmprior.rl import PriorSpaceConfig
from warmprior.training import NAVIGATION_PRESETS, PRESETS, NavigationPreset, Preset


@dataclass(frozen=True)
class TaskBudget:
    """What a preset does differently on one task.

    Attributes:
        config: parts of the recipe.
        horizon: time limit in control steps, if not that of the task.
        demonstrations: of the frozen policy.
        iterations: of the frozen policy.
        chunk: chunk length ``H`` of the frozen policy.
        base_delta: half the side of the box around zero, if not 1.5.
    """

    config: Mapping[str, Any] = field(default_factory=dict)
    horizon: int | None = None
    demonstrations: int | None = None
    iterations: int | None = None
    chunk: int | None = None
    base_delta: float | None = None


@dataclass(frozen=True)
class Budget:
    """What a preset spends; ``tasks`` and options of the command line replace parts of it."""

    summary: str
    config: PriorSpaceConfig
    pretraining: Preset | NavigationPreset
    priors: tuple[str, ...]
    seeds: int
    envs: int
    chunk: int
    tasks: Mapping[str, TaskBudget] = field(default_factory=dict)
    horizon: int | None = None
    base_delta: float | None = None
    threads: int | None = None
    """Of the agents' training: more than one only wait for each other in small networks."""

    def agent(
        self, config: PriorSpaceConfig, algorithm: Any, prior: Prior, seed: int
    ) -> PriorSpaceConfig:
        """The recipe of one agent."""
        return replace(
            config,
            algorithm=algorithm,
            backup_entropy=config.backup_entropy or algorithm == "dsrl-sac",
            delta=config.delta or (None if prior.moves_source else self.base_delta),
            seed=seed,
        )


TOY = NAVIGATION_PRESETS["quick"]

BUDGETS = {
    "unit": Budget(
        summary="the navigation toy with a goal, three seeds: under two minutes",
        config=PriorSpaceConfig(
            environment_steps=12_000,
            warmup_steps=3_000,
            nfe=2,
            updates=12,
            noise_critic_steps=4,
            learning_rate=1e-3,
            tau=0.05,
            gamma=1.0,
            hidden_dim=128,
            num_layers=2,
            # Failure ends the episode: entropy in the targets would pay for not failing, whatever the reward.
            backup_entropy=False,
            alpha_init=0.02,
            reward_offset=0.0,
            evaluate_every=6_000,
            evaluation_episodes=128,
        ),
        pretraining=replace(TOY, training=replace(TOY.training, iterations=800, save_every=800)),
        priors=("past",),
        seeds=3,
        envs=32,
        chunk=8,
        threads=1,
    ),
    "quick": Budget(
        summary="lift from a weak policy, WP-Past against the base, two seeds: half an hour",
        config=PriorSpaceConfig(
            environment_steps=24_000,
            warmup_steps=3_000,
            nfe=1,
            updates=4,
            noise_critic_steps=2,
            learning_rate=1e-3,
            gamma=0.97,
            hidden_dim=128,
            # At 1, the entropy of 56 coordinates outweighs the 8 control steps of a decision: the agent
            # would be paid for not solving the task, until the temperature has fallen.
            alpha_init=0.05,
            evaluate_every=6_000,
            evaluation_episodes=40,
        ),
        pretraining=PRESETS["quick"],
        priors=experiment.COMPARED[:2],
        seeds=2,
        envs=4,
        chunk=8,
        threads=1,
        tasks={
            # Weak policies: solved in 0.3 to 0.8 of the episodes.
            "lift": TaskBudget(demonstrations=5, iterations=300, horizon=90),
            "can": TaskBudget(iterations=500),
        },
    ),
    "paper": Budget(
        summary="DSRL's hyper-parameters per task, three seeds: needs a GPU",
        # Success ends the episode here, unlike in DSRL: entropy in the targets would pay for not solving it.
        config=PriorSpaceConfig(
            environment_steps=1_000_000, backup_entropy=False, evaluate_every=50_000
        ),
        pretraining=PRESETS["paper"],
        priors=experiment.COMPARED,
        seeds=3,
        envs=4,
        chunk=4,
        tasks={
            "lift": TaskBudget({"updates": 30}, horizon=300),
            "can": TaskBudget(horizon=300),
            "square": TaskBudget({"gamma": 0.999, "warmup_steps": 32_000}, horizon=400),
            "transport": TaskBudget(
                {"hidden_dim": 128, "warmup_steps": 640_000},
                horizon=800,
                chunk=8,
                base_delta=1.0,
            ),
        },
    ),
}


def make_config(args: argparse.Namespace) -> tuple[Budget, PriorSpaceConfig]:
    """The chosen budget and recipe with the options that replace parts of them.

    Raises:
        ValueError: for an option that is out of range, or has no effect together with others.
    """
    _refuse_ignored(args)
    budget = BUDGETS[args.preset]
    task = budget.tasks.get(args.task, TaskBudget())
    values = dict(task.config) | {
        name: value
        for name, value in {
            "delta": args.delta,
            "alpha_init": args.alpha,
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
    budget = replace(
        budget,
        pretraining=_pretraining(args, budget.pretraining, task),
        chunk=task.chunk or budget.chunk,
        horizon=task.horizon,
        base_delta=task.base_delta,
    )
    budget = experiment.with_counts(budget, args, ("seeds", "envs", "chunk", "horizon"))
    if args.prior is not None:
        budget = replace(budget, priors=tuple(dict.fromkeys(args.prior)))
    for name in budget.priors:
        if not Prior.find(name).is_flow:
            raise ValueError(f"--prior {name} is no flow: there is no source space to act in")
    return budget, config


def _pretraining(args: argparse.Namespace, preset: Any, task: TaskBudget) -> Any:
    iterations = task.iterations if args.iterations is None else args.iterations
    if iterations is not None:
        preset = replace(preset, training=preset.training.with_iterations(iterations))
    if task.demonstrations is not None:
        preset = replace(preset, demonstrations={args.data: task.demonstrations})
    return preset


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
        told = "the toy has demonstrations and a time limit of its own"
        unused = data | training | {"run": None, "horizon": None}
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
