"""Evaluation episodes and their outcomes; every policy plays the same episodes."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv
from torchrl.envs.transforms import ActionScaling, ObservationNorm

from warmprior import keys
from warmprior.checks import check_whole_numbers, is_true
from warmprior.evaluation.parallel import base_of, row_seeding, transforms_of, watched
from warmprior.io.progress import progress_bar
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import check_usual_keys
from warmprior.modules.network import device_of, uncompiled
from warmprior.tasks.task import Task
from warmprior.transforms.chunk import ChunkStep, Measures, check_measures, check_outside
from warmprior.transforms.normalize import FollowsNormalizer

Act = Callable[[TensorDictBase], TensorDictBase]
"""A function that writes the next chunk."""


@dataclass(frozen=True)
class Episode:
    """The outcome of one evaluation episode.

    Attributes:
        seed: simulator seed of the reset.
        success: True if the task was solved at any step.
        steps: number of executed control steps.
        measures: values of further keys, see :func:`play_episode`.
        decisions: the policy's decisions, ``[D]``, with ``("vla_action", "chunk")`` (for an agent, the
            decoded chunk), ``("next", "executed_steps")`` and ``("next", "done")``; the source's ``loc`` and
            ``warm``, if the policy has a source; and the delay and the history's forecast, if chunks took
            effect late. Episodes concatenated along ``D`` are a rollout for
            :func:`~warmprior.diagnostics.smoothness`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from warmprior.evaluation import Episode
        >>> solved = Episode(7, True, 90, decisions=TensorDict({}, [12]))
        >>> solved.success, len(solved.decisions)
        (True, 12)
    """

    seed: int
    success: bool
    steps: int
    decisions: TensorDictBase = field(compare=False, repr=False)
    measures: Mapping[str, float] = field(default_factory=dict)


class _Tally:
    """The results so far of an episode that is being played."""

    def __init__(self, success: NestedKey, measures: Measures) -> None:
        self._success_key, self._how = success, measures
        self._solved, self._steps, self._values = False, 0, dict[str, float]()
        self._decisions: list[TensorDictBase] = []

    def add(self, after: TensorDictBase, decision: TensorDictBase) -> None:
        """Add a decision and the environment's output after it."""
        self._decisions.append(decision)
        self._solved |= is_true(self._success_key, after[self._success_key])
        self._steps += int(after[keys.EXECUTED])
        for key, how in self._how.items():
            value = float(after[key])
            before = self._values.get(key, value if how == "max" else 0.0)
            self._values[key] = {"max": max(before, value), "sum": before + value, "last": value}[how]

    def episode(self, seed: int) -> Episode:
        """Return the finished episode."""
        done = torch.zeros(len(self._decisions), 1, dtype=torch.bool)
        done[-1] = True
        rollout = TensorDictBase.stack(self._decisions).set(("next", "done"), done)
        return Episode(seed, self._solved, self._steps, rollout, self._values)


@contextmanager
def _acting(policy: TensorDictModuleBase, env: EnvBase, seed: int, nfe: int | None) -> Iterator[Act]:
    """Yield the call of a policy whose draws follow from a seed; generators are restored afterwards."""
    policy.eval()
    options: dict[str, Any] = {} if nfe is None else {"nfe": nfe}
    # A policy without an agent, such as random residuals for a decoder, may have no parameters.
    home, device = env.device or torch.device("cpu"), device_of(policy)
    if "generator" in inspect.signature(uncompiled(policy).forward).parameters:
        options["generator"] = torch.Generator(device).manual_seed(seed)
        seed ^= 1  # another seed for the environments
    # One thread: the simulators need the cores, and idle threads of a small policy would spin.
    with torch_threads(1), torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield lambda data: policy(data.to(device), **options).to(home)


@torch.no_grad()
def play_episode(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seed: int,
    *,
    nfe: int | None = None,
    policy_seed: int = 0,
    success: NestedKey = keys.SUCCESS,
    measures: Measures | None = None,
) -> Episode:
    """Play the episode that starts from a seed.

    Every episode has its own noise: the policy's generator is seeded by
    ``numpy.random.SeedSequence((policy_seed, seed)).generate_state(1, "uint64")``. The policy decides one
    step at a time on one thread, so the outcome depends only on the arguments.

    Args:
        policy: see :func:`evaluate`.
        env: an environment without batch dimensions, with the policy's transforms; it must start the same
            episode after every ``set_seed(seed)``.
        seed: seed of the environment, at least 0.

    Keyword Args:
        nfe: see :func:`evaluate`.
        policy_seed: seed of the policy's random draws, at least 0.
        success: the environment's key of a flag for success; an episode succeeds if it is True at any step.
            A key of Gymnasium's ``info`` works too, if the environment reads it
            (``GymEnv(...).auto_register_info_dict()``).
        measures: further keys, each with one number per step, and the value that an episode reports: the
            ``"max"``, ``"sum"`` or ``"last"``. Pass ``success`` and ``measures`` to
            :func:`~warmprior.policy_transforms` too.

    Raises:
        ValueError: if the environment has batch dimensions, its chunks combine the values of their steps in
            another way, or a seed is negative.
        KeyError: if the environment lacks ``success``, one of ``measures``, or the policy's transforms.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior.evaluation import play_episode
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1, hidden_dim=8), PastPrior(8))
        >>> transforms = policy_transforms(actor.prior, observation_steps=1)
        >>> env = TransformedEnv(NavigationEnv((1, 1)), transforms)
        >>> one, again = (play_episode(actor, env, seed=7, nfe=1) for _ in range(2))
        >>> bool((one.decisions == again.decisions).all())
        True
    """
    if env.batch_size:
        raise ValueError(f"play_episode needs a single environment, got {env.batch_size}")
    check_whole_numbers(0, seed=seed, policy_seed=policy_seed)
    _check_fit(policy, env, success, measures or {})
    tally = _Tally(success, measures or {})
    noise_seed = np.random.SeedSequence((policy_seed, seed)).generate_state(1, np.uint64)
    with _acting(policy, env, int(noise_seed[0]), nfe) as act:
        env.set_seed(seed)
        data = env.reset()
        while True:
            data = env.step(act(data))
            tally.add(data["next"], _decision(data))
            if data["next", "done"].all():
                return tally.episode(seed)
            data = env.step_mdp(data)


def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase | Task,
    *,
    episodes: int,
    first_seed: int,
    nfe: int | None = None,
    policy_seed: int = 0,
    success: NestedKey = keys.SUCCESS,
    measures: Measures | None = None,
    description: str | None = None,
) -> list[Episode]:
    """Play episodes and return their outcomes in the order of their seeds.

    The same arguments and number of environments give the same result.

    Args:
        policy: a :class:`~warmprior.WarmPriorActor`, or any module that writes chunks, such as an agent
            followed by a :class:`~warmprior.PriorDecoder`; it is set to evaluation mode.
        env: a :class:`Task`, or an environment with the policy's transforms that ends every episode
            (``StepCounter`` sets a time limit). A single environment plays one episode after another, see
            :func:`play_episode`. A batched environment ``[n]`` plays ``n`` at a time, and the noise of an
            episode depends on ``n``. Batched environments are those of :func:`parallel_env`, any
            ``SerialEnv`` or ``ParallelEnv`` (each environment is seeded separately, and must start the same
            episode after every ``set_seed(seed)``), and those of a class with ``strided_seeds = True``. After
            ``set_seed(seed, static_seed=True)``, row ``i`` of the last kind plays the episodes ``seed + i``,
            ``seed + i + n``, ...

    Keyword Args:
        episodes: number of episodes; episode ``e`` starts from simulator seed ``first_seed + e``.
        first_seed: the first simulator seed; choose seeds that the demonstrations do not use.
        nfe: network evaluations per chunk of a :class:`~warmprior.WarmPriorActor`; its own by default.
        policy_seed: seed of all draws in this process, from the ``generator`` of a policy that takes one and
            from PyTorch's global generator, whose state is restored afterwards.
        success: see :func:`play_episode`; a :class:`Task` has its own.
        measures: see :func:`play_episode`; a :class:`Task` has its own.
        description: label of the progress bar; no bar if ``None``.

    Raises:
        ValueError: if ``episodes < 1``; if the environment has several batch dimensions, or cannot play given
            seeds in its rows; if it lacks the policy's normaliser, or the policy has keys of its own; or if
            ``success`` or ``measures`` are given with a :class:`Task`.
        KeyError: see :func:`play_episode`.
        RuntimeError: if a transform around workers repeats or skips chunks (:class:`~warmprior.ChunkStep`).
        WorkerError: a ``RuntimeError``, if a worker process dies.

    See Also:
        :func:`~warmprior.diagnostics.success_posterior`: the success rate's posterior distribution.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior.evaluation import evaluate
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1, hidden_dim=8), PastPrior(8))
        >>> transforms = policy_transforms(actor.prior, observation_steps=1)
        >>> env = TransformedEnv(NavigationEnv((1, 1), batch_size=[4]), transforms)
        >>> played = evaluate(actor, env, episodes=6, first_seed=100)
        >>> [episode.seed for episode in played]
        [100, 101, 102, 103, 104, 105]
    """
    if isinstance(env, Task):
        if success != keys.SUCCESS or measures is not None:
            raise ValueError("a Task has its own success and measures: give them to its Play instead")
        success, measures = env.play.success, env.play.measures
        env = env.env(policy)  # type: ignore[arg-type]
    check_whole_numbers(episodes=episodes)
    if len(env.batch_size) > 1:
        raise ValueError(f"evaluate needs a batch size [] or [n], got {list(env.batch_size)}")
    options: Any = {"nfe": nfe, "policy_seed": policy_seed, "success": success, "measures": measures or {}}
    seeds = range(first_seed, first_seed + episodes)
    played = (play_episode(policy, env, seed, **options) for seed in seeds)
    if env.batch_size:
        played = _play_batched(policy, env, seeds, **options)
    outcomes: list[Episode] = []
    with progress_bar(description, played, total=episodes, unit="ep") as bar:
        for outcome in bar:
            outcomes.append(outcome)
            wins = sum(outcome.success for outcome in outcomes)
            bar.set_postfix(success=f"{wins / len(outcomes):.2f}", refresh=False)
    return sorted(outcomes, key=lambda outcome: outcome.seed)


@torch.no_grad()
def _play_batched(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seeds: range,
    nfe: int | None,
    policy_seed: int,
    success: NestedKey,
    measures: Measures,
) -> Generator[Episode]:
    num_envs = env.batch_size[0]
    _check_fit(policy, env, success, measures)
    home = env.device or torch.device("cpu")
    played = [0] * num_envs
    tallies = [_Tally(success, measures) for _ in played]
    with watched(env), _acting(policy, env, policy_seed, nfe) as act:
        env.set_seed(seeds.start, static_seed=True)
        seed_row = row_seeding(env)
        for i in range(min(num_envs, len(seeds))):
            seed_row(i, seeds[i])
        data = env.reset()
        while sum(played) < len(seeds):
            # Worker i plays the episodes i + n * played, and rests once it has played all of them.
            active = torch.tensor([i + num_envs * played[i] < len(seeds) for i in range(num_envs)])
            if not active.all():
                data.set("_step", active.to(home))
            data = env.step(act(data))
            after = data["next"].select("done", success, keys.EXECUTED, *measures).cpu()
            done = after["done"].flatten() & active
            decided = _decision(data)
            for i in active.nonzero().flatten().tolist():
                tallies[i].add(after[i], decided[i])
            for i in done.nonzero().flatten().tolist():
                episode = i + num_envs * played[i]
                yield tallies[i].episode(seeds[episode])
                tallies[i] = _Tally(success, measures)
                played[i] += 1
                if episode + num_envs < len(seeds):
                    seed_row(i, seeds[episode + num_envs])
            data = env.step_mdp(data)
            if done.any() and sum(played) < len(seeds):
                data = env.reset(data.set("_reset", done.to(home).unsqueeze(-1)))


def _check_fit(policy: TensorDictModuleBase, env: EnvBase, success: NestedKey, measures: Measures) -> None:
    """Raise an error if a policy cannot act in an environment, or if it lacks what is asked for."""
    check_usual_keys(policy, "evaluate")
    check_measures(measures)
    asked, rewards = {success: "max", **measures}, env.reward_keys
    present = env.observation_spec.keys(True, True)
    for key in asked:
        if key not in present and key not in rewards:
            raise KeyError(
                f"the environment does not write {key!r}, it writes {sorted(map(str, present))}: name the "
                "key with success= or measures="
            )
    if keys.EXECUTED not in present or keys.ACTIONS not in present:
        raise KeyError(f"the environment lacks {keys.EXECUTED!r} or {keys.HISTORY!r}: see policy_transforms")
    check_outside(env)
    parts = list(transforms_of(env))
    for part in parts:
        if isinstance(part, ChunkStep) and part.execute > 1:
            combined = dict.fromkeys(rewards, "sum" if part.gamma == 1 else "discounted sum")
            combined |= {part.success: "max", **part.measures}
            # What is written after chunks is of whole decisions; inside workers there is no parent to ask.
            below = {*rewards, *(part.parent or env).observation_spec.keys(True, True)}
            for key in asked.keys() & below - {keys.EXECUTED}:
                if (has := combined.get(key, "last")) != (how := asked[key]):
                    raise ValueError(
                        f"a chunk keeps the {has!r} of {key!r}, but the evaluation asks for {how!r}: ask for "
                        "what it keeps, or give policy_transforms the same success and measures, and gamma=1"
                    )
    _check_units(policy, env, parts)


def _check_units(policy: TensorDictModuleBase, env: EnvBase, parts: list[Any]) -> None:
    """Raise ValueError if the transforms of an environment are seen to lack the policy's normaliser."""
    normalizer = getattr(policy, "normalizer", None)
    if normalizer is None:
        return
    batched = isinstance(base_of(env), SerialEnv | ParallelEnv)
    kinds: Any = FollowsNormalizer if batched else ActionScaling | ObservationNorm
    scalers = [part for part in parts if isinstance(part, kinds)]
    for part in scalers:
        if isinstance(part, FollowsNormalizer):
            part.follow()  # as the next reset does
    scalings: dict[NestedKey, Any] = {(part.in_keys_inv or part.in_keys)[0]: part for part in scalers}
    for key in normalizer.keys:
        if batched and key not in scalings:
            continue  # it may be inside the workers, which cannot be seen
        for name in ("loc", "scale"):
            value = getattr(normalizer, name)(key)
            if key not in scalings or not torch.equal(getattr(scalings[key], name).to(value), value):
                raise ValueError(
                    f"the policy was trained in the units of its normaliser, but the environment has "
                    f"{'another' if key in scalings else 'none'} for {key!r}: give policy_transforms(..., "
                    "normalizer=policy.normalizer), close workers that have started with another, or play "
                    "policy.replace(normalizer=None) if the environment is in these units already"
                )


def _decision(data: TensorDictBase) -> TensorDictBase:
    """Return the entries of a step that :attr:`Episode.decisions` keeps, on the CPU."""
    late = [keys.DELAY, keys.FORECAST] if data.get(keys.DELAY, None) is not None else []
    kept = data.select(keys.CHUNK, keys.LOC, keys.WARM, *late, ("next", keys.EXECUTED), strict=False)
    decoded = data.get(("next", *keys.DECODED_CHUNK), None)
    if decoded is not None:  # an agent acts, and the environment decodes
        kept[keys.CHUNK] = decoded
    return kept.cpu()
