"""Agents in source space: frozen policies and environments."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose

from lab.methods.methods import Method
from lab.options.agents import AgentsOptions
from lab.running.comparison import train_all
from lab.running.policies import facts_of, finished_policies, policies_of, trained_actors
from warmprior import PriorAnchor, WarmPriorActor, policy_transforms
from warmprior.envs import NavigationEnv
from warmprior.envs.description import environment_parts
from warmprior.evaluation import parallel_env
from warmprior.transforms import EncodeObservation


def frozen_policies(options: AgentsOptions) -> tuple[dict[str, Any], dict[Method, dict[int, WarmPriorActor]]]:
    """Return the task, and the frozen policies by method and seed, from --run or trained first."""
    run = options.policies
    policies = policies_of(options) if run is None else finished_policies(run, options)
    if not options.is_toy:
        policies[0].task().check_environment(**options.evaluation.environment)
    if run is None:
        train_all(options, policies)
    actors = trained_actors(policies, options.run.device)
    for method, group in actors.items():
        if missing := sorted(set(options.seeds) - group.keys()):
            print(f"--run has {len(group)} seeds of {method.text}: agents {missing} share policies")
        several = list(group.values())
        actors[method] = {s: group.get(s, several[s % len(several)]) for s in options.seeds}
    return facts_of(policies[0].task()), actors


def environment(
    actor: WarmPriorActor, is_toy: bool, num_envs: int, options: Mapping[str, Any], seed: int
) -> EnvBase:
    """Make the environment of agents around a frozen policy; simulators run in worker processes."""
    if is_toy:  # only the anchor is random
        transforms = policy_transforms(actor.prior, observation_steps=1, see_history=actor.sees_history)
        transforms.append(PriorAnchor(actor))
        return TransformedEnv(NavigationEnv((1, 1), batch_size=[num_envs]), transforms)
    make_env, make_transforms = environment_parts(actor)
    rewarded = partial(make_transforms, by_success=True)
    workers = parallel_env(partial(make_env, **options), rewarded, num_envs)
    # Outside of the workers, one anchor draws for all environments, and one encoder serves all.
    env = TransformedEnv(workers, Compose(*encoding(actor), PriorAnchor(actor)))
    env.set_seed(seed, static_seed=True)
    return env


def encoding(actor: WarmPriorActor) -> list[EncodeObservation]:
    """Return the transforms that turn images into features, for policies that see images."""
    return [EncodeObservation(actor)] if getattr(actor.network, "encodes", False) else []
