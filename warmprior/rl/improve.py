"""Improvement of a saved policy by reinforcement learning in its source space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior import keys
from warmprior.checks import check_keys, check_whole_numbers
from warmprior.evaluation.episodes import evaluate
from warmprior.evaluation.parallel import parallel_env
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import WarmPriorActor
from warmprior.options.agent import IMPROVE, NUM_ENVS, PriorSpaceConfig
from warmprior.rl.anchor import PriorAnchor
from warmprior.rl.improved import check_improvable
from warmprior.rl.training import PriorSpaceTraining

APART = 5_000
"""The distance between the seeds of episodes that are reported, that choose an agent, and that confirm it."""


@dataclass(frozen=True)
class Improvement:
    """The result of :func:`improve_policy`.

    Attributes:
        policy: the improved policy, or the frozen one if no agent was better.
        improved: True if an agent was better.
        before: solved episodes of the frozen policy.
        after: solved episodes of ``policy``.
        episodes: number of episodes of each, from the same starts, by which nothing was chosen.
        reach: how far the agent's box moves chunks, see :func:`~warmprior.rl.residual_reach`.
        curve: the evaluations by which the policy was chosen, see :meth:`PriorSpaceTraining.run`.

    Examples:
        >>> from warmprior import Improvement, PastPrior, VelocityMLP, WarmPriorActor
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
        >>> result = Improvement(actor, True, before=40, after=90, episodes=100, reach=0.1, curve=[])
        >>> result.after > result.before
        True
    """

    policy: WarmPriorActor
    improved: bool
    before: int
    after: int
    episodes: int
    reach: float
    curve: list[dict[str, Any]]


def improve_policy(
    policy: WarmPriorActor,
    directory: str | Path,
    *,
    make_env: Callable[[], EnvBase] | None = None,
    num_envs: int = NUM_ENVS,
    config: PriorSpaceConfig | None = None,
    episodes: int = 100,
    compile: bool = False,
    description: str | None = "improve",
) -> Improvement:
    """Improve a policy by reinforcement learning in its source space.

    The policy stays frozen, and an agent learns where its flow starts (:class:`PriorSpaceTraining`). Success
    is the reward, whatever the environment's own is: 1 for a control step at which the task is solved, else
    0, less the recipe's ``reward_offset``. The best agent of the evaluations is kept if it also solves more
    of other episodes, as the best of several is better by chance alone. The policies before and after then
    play a third set: that of ``python -m warmprior evaluate``.

    The updates use as many threads as PyTorch had before, while the workers wait. One seed repeats bit for
    bit with the same number of threads.

    Args:
        policy: the policy, such as one of :func:`~warmprior.saving.load_policy`. It must solve some
            episodes: where it solves none, there is no reward to learn from.
        directory: folder of the training, which continues where it was interrupted. It knows the policy and
            the recipe, and cannot tell one environment of yours from another: take another folder.

    Keyword Args:
        make_env: builds an environment in raw units that writes ``"success"`` and ends its episodes, such as
            :func:`~warmprior.envs.gym_env`'s; see :func:`~warmprior.evaluation.parallel_env`. By default the
            environment that the policy was made for.
        num_envs: environments in worker processes.
        config: the recipe; by default :data:`~warmprior.options.agent.IMPROVE`, at the policy's own number of
            network evaluations.
        episodes: episodes of the final comparison.
        compile: True compiles the agent's updates with :func:`torch.compile`, which needs a C++ compiler.
        description: label of the progress bars; none if ``None``.

    Raises:
        KeyError: if the environment writes no ``"success"``.
        ValueError: if the policy keeps no description of an environment and ``make_env`` is missing, the
            policy is guided, is trained at ``t = 0`` only or sees images, or the recipe does not fit it.
        FloatingPointError: if the training diverges; the last save stays.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior import PriorSpaceConfig, improve_policy
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1, hidden_dim=8), PastPrior(8))
        >>> config = PriorSpaceConfig(
        ...     environment_steps=40, warmup_steps=20, evaluate_every=40, evaluation_episodes=2,
        ...     batch_size=4, updates=1, noise_critic_steps=1, hidden_dim=8, num_layers=1)
        >>> with TemporaryDirectory() as folder:  # doctest: +SKIP
        ...     result = improve_policy(actor, folder, make_env=lambda: NavigationEnv((1, 1)), num_envs=2,
        ...                             config=config, episodes=4)
        >>> result.before, result.after  # doctest: +SKIP
        (0, 0)
    """
    # Only here, because the package is imported without its environments.
    from warmprior.envs.description import environment_parts, transforms_builder
    from warmprior.options.defaults import EVALUATION_SEED

    check_whole_numbers(num_envs=num_envs, episodes=episodes)
    check_improvable(policy)
    config = replace(IMPROVE, nfe=policy.sampling.evaluations()) if config is None else config
    if max(episodes, config.evaluation_episodes) > APART:
        raise ValueError(f"more than {APART} episodes would choose and report by the same ones")
    if make_env is None:
        make_env, make_transforms = environment_parts(policy)
    else:
        make_transforms = transforms_builder(policy)
    single = make_env()  # an error is better raised here than in a worker
    try:
        hint = ": success is the reward (gym_env(env, success=NAME) reads it from info)"
        check_keys(single.observation_spec, [keys.SUCCESS], "the environment of an agent", hint)
    finally:
        single.close()
    builders = make_env, partial(make_transforms, by_success=True)

    def environment(seed: int) -> EnvBase:
        # Outside of the workers one anchor draws for all environments.
        env = TransformedEnv(parallel_env(*builders, num_envs), PriorAnchor(policy))
        env.set_seed(seed, static_seed=True)
        return env

    # TorchRL resets the number of threads when workers end.
    with torch_threads(None), torch.random.fork_rng(devices=[]):
        training = PriorSpaceTraining(
            policy,
            environment,
            config,
            directory,
            evaluation_seed=EVALUATION_SEED + APART,
            description=description,
            compile=compile,
        )
        curve = training.run()
        frozen, best = policy.replace(nfe=config.nfe), training.policy()
        improved = best.start is not frozen.start
        env = parallel_env(*builders, num_envs)

        def solved(played: WarmPriorActor, first_seed: int, name: str) -> int:
            label = None if description is None else name
            options: dict[str, Any] = {"policy_seed": config.seed, "description": label}
            outcomes = evaluate(played, env, episodes=episodes, first_seed=first_seed, **options)
            return sum(outcome.success for outcome in outcomes)

        if improved:
            confirming = EVALUATION_SEED + 2 * APART
            counts = [solved(played, confirming, "confirm") for played in (frozen, best)]
            improved = counts[1] > counts[0]
        before = after = solved(frozen, EVALUATION_SEED, "before")
        if improved:
            after = solved(best, EVALUATION_SEED, "after")
        env.close(raise_if_closed=False)
    kept = best if improved else frozen
    return Improvement(kept, improved, before, after, episodes, training.reach(), curve)
