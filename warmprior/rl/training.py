"""Resumable off-policy reinforcement learning in the source space of a frozen policy."""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from warmprior import keys
from warmprior.checks import check_finite, check_keys
from warmprior.evaluation.episodes import evaluate
from warmprior.evaluation.parallel import transforms_of, watched
from warmprior.io.files import check_writable, exclusive
from warmprior.io.progress import progress_bar
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import WarmPriorActor
from warmprior.options.agent import PriorSpaceConfig
from warmprior.rl.agent import PriorSpaceAgent, WarmUpSwitch
from warmprior.rl.anchor import has_anchor
from warmprior.rl.decoder import residual_reach
from warmprior.rl.improved import improved_policy
from warmprior.saving.training_state import (
    STATE_FORMAT,
    RunState,
    as_key,
    digest_of_state,
    named,
    select,
)
from warmprior.transforms.chunk import ChunkStep


class PriorSpaceTraining:
    """A training of an agent around a frozen policy, with TorchRL's environments, losses and replay buffer.

    The folder receives ``state.safetensors``, with the replay buffer, which every evaluation replaces
    atomically. Constructing the same training on it continues from the last save. Simulators cannot be
    saved, so unfinished episodes are lost at an interruption.

    Args:
        actor: the frozen policy; it is set to evaluation mode.
        make_env: ``make_env(seed) -> EnvBase``, a batched environment ``[n]`` with the policy's transforms
            and :class:`~warmprior.PriorAnchor`; called for training and evaluation.
        config: the recipe.
        directory: the folder.
        evaluation_seed: simulator seed of the first evaluation episode.
        description: label of the progress bar; no bar if ``None``.
        collect: a context manager that collects in other processes, called as ``collect(policy, make_env,
            num_envs=n, seed=seed)``; it yields rounds of decisions, a TensorDict ``[..., n, 1]`` each. By
            default this process collects.
        compile: True compiles the updates with :func:`torch.compile`, which needs a C++ compiler.

    Attributes:
        agent (PriorSpaceAgent): the agent; its ``policy`` is the agent followed by the decoder.
        decoder (PriorDecoder): the frozen policy as a decoder.
        steps (int): control steps so far, including the warm-up.
        curve (list[dict[str, Any]]): the evaluations so far, see :meth:`run`.

    Raises:
        TypeError: if the policy's network does not tell its sizes, as a :class:`VelocityNetwork` does.
        ValueError: if the recipe does not fit the policy, or the folder's state belongs to another recipe,
            policy or wiring.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import PastPrior, PriorAnchor, VelocityMLP, WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining
        >>> network = VelocityMLP(1, 9, prediction_length=8, observation_steps=1, hidden_dim=8)
        >>> actor = WarmPriorActor(network, PastPrior(8))
        >>> def make_env(seed):
        ...     transforms = policy_transforms(actor.prior, observation_steps=1)
        ...     transforms.append(PriorAnchor(actor))
        ...     return TransformedEnv(NavigationEnv((1, 1), batch_size=[2]), transforms)
        >>> config = PriorSpaceConfig(
        ...     environment_steps=40, warmup_steps=20, evaluate_every=40, evaluation_episodes=2,
        ...     batch_size=4, updates=1, noise_critic_steps=1, hidden_dim=8, num_layers=1)
        >>> with TemporaryDirectory() as folder:
        ...     training = PriorSpaceTraining(actor, make_env, config, folder, evaluation_seed=100)
        ...     [row["evaluation"] for row in training.run()]
        ['base', 'greedy']
    """

    def __init__(
        self,
        actor: WarmPriorActor,
        make_env: Callable[[int], EnvBase],
        config: PriorSpaceConfig,
        directory: str | Path,
        *,
        evaluation_seed: int,
        description: str | None = None,
        collect: Callable[..., AbstractContextManager[Iterator[TensorDictBase]]] | None = None,
        compile: bool = False,
    ) -> None:
        self.actor, self.make_env, self.config = actor, make_env, config
        self.directory, self.collect = Path(directory), collect
        self.evaluation_seed, self.description = evaluation_seed, description
        torch.manual_seed(config.seed)
        self.agent = PriorSpaceAgent(actor, config)
        self.decoder, self.device = self.agent.decoder, self.agent.device
        self._switch = WarmUpSwitch(self.agent.warmup, self.agent.policy)
        # All transitions fit, because each takes at least one control step.
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(config.environment_steps, device=self.device),
            batch_size=config.batch_size,
        )
        self.steps = 0
        self.curve: list[dict[str, Any]] = []
        self._best: dict[str, torch.Tensor] = {}
        self._warned = False
        self._solved: torch.Tensor | None = None  # which of the running episodes are
        self.identity = {
            "config": asdict(config),
            "prior": actor.prior.config(),
            "sampling": asdict(actor.sampling),
            "start": None if actor.start is None else actor.start.config(),
            "environment": actor.environment,
            "evaluation_seed": evaluation_seed,
            "policy": digest_of_state(None, {n: v.detach().cpu() for n, v in actor.state_dict().items()}),
            "transitions": self._transition_keys,
            "format": STATE_FORMAT,
        }
        self._state = RunState(self.directory, self.identity)
        #: The path of the training state.
        self.state_path = self._state.path
        self._restore()
        self._compiles = compile
        if compile:
            self.agent.compile()

    def run(self) -> list[dict[str, Any]]:
        """Collect, learn and evaluate to the end.

        Returns:
            The evaluations, each with ``environment_steps``, ``evaluation`` (``"base"`` for the frozen policy
            itself, or ``"greedy"``), ``episodes``, ``successes`` and ``success_rate``.

        Raises:
            KeyError: if the environment has no anchor.
            ValueError: if the environment does not fit the policy, executes fewer than ``H`` actions of a
                chunk, discounts inside chunks, or has an observation of several entries.
            FloatingPointError: if a loss, a parameter or a value of the environment becomes NaN or infinite;
                the last save stays.
            WorkerError: if a worker process of an environment, or a collector, dies, a ``RuntimeError``.
            BlockingIOError: if another process is training in the folder.
            OSError: if the folder cannot be written to.
        """
        if self.steps < self.config.environment_steps:
            check_writable(self.directory)
            with exclusive(self.directory):
                self._restore()  # another process may have trained since this object was built
                self._run()
        return self.curve

    def _run(self) -> None:
        config = self.config
        threads = torch.get_num_threads()  # TorchRL takes those of workers off, which wait during updates
        reach = 0.0
        with (
            self._environment(0) as evaluation_env,
            self._rounds(evaluation_env.batch_size.numel()) as rounds,
            progress_bar(
                self.description, total=config.environment_steps, initial=self.steps, unit="step"
            ) as bar,
        ):
            self.decoder.check_env(evaluation_env)
            observations = evaluation_env.observation_spec
            check_keys(observations, [keys.ANCHOR], "an agent", ": append PriorAnchor")
            key = self.decoder.observation_key
            if isinstance(observations.get(key), Composite):
                raise ValueError(
                    f"agents read vectors, and {key!r} has several entries: append EncodeObservation(actor), "
                    "and train around actor.replace(observation_key=keys.FEATURES)"
                )
            if any(isinstance(part, ChunkStep) and part.gamma != 1 for part in transforms_of(evaluation_env)):
                raise ValueError(
                    "rewards are discounted inside chunks, but here once per decision, after reward_offset: "
                    "leave gamma out of policy_transforms"
                )
            if not self.curve:
                self._evaluate(evaluation_env, "base", self.actor)
                self._save()
                if not self.curve[0]["successes"]:
                    warnings.warn(
                        f"the policy solves none of {config.evaluation_episodes} episodes: an agent learns "
                        "from successes, so train the policy on more demonstrations, or for longer (if the "
                        "environment writes success at all)",
                        stacklevel=3,
                    )
            while self.steps < config.environment_steps:
                self._switch.learning.fill_(self.steps >= config.warmup_steps)
                executed = self._store(next(rounds))
                before, self.steps = self.steps, self.steps + executed
                bar.update(executed)
                if self.steps > config.warmup_steps:
                    if self._compiles:
                        bar.set_postfix_str("compiling the updates")
                        self._compiles = False
                    reach = reach or self.reach()
                    with torch_threads(threads):
                        metrics = self.agent.learn(self.buffer)
                    last = {row["evaluation"]: row["success_rate"] for row in self.curve}
                    bar.set_postfix(metrics | {"reach": reach} | last, refresh=False)
                due = self.steps // config.evaluate_every > before // config.evaluate_every
                if due or self.steps >= config.environment_steps:
                    self.agent.state()  # Raises if the agent's state is not finite.
                    self._evaluate(evaluation_env, "greedy", self.agent.policy)
                    self._save()

    def reach(self, states: int = 256) -> float:
        """Return how far the box moves chunks at the first states, see :func:`residual_reach`."""
        generator = torch.Generator(self.device).manual_seed(self.config.seed)
        return residual_reach(self.decoder, self.buffer[:states], generator=generator)

    @contextmanager
    def _environment(self, seed: int) -> Iterator[EnvBase]:
        """Yield an environment, and close it at the end; raise an error if a worker dies."""
        env = self.make_env(seed)
        with watched(env):
            yield env
        env.close(raise_if_closed=False)

    @contextmanager
    def _rounds(self, num_envs: int) -> Iterator[Iterator[TensorDictBase]]:
        """Yield rounds of decisions, each of all environments."""
        seed = self._collection_seed()
        if self.collect is not None:
            with self.collect(self._switch, self.make_env, num_envs=num_envs, seed=seed) as rounds:
                yield rounds
            return
        with self._environment(seed) as env:
            yield self._decisions(env)

    def _decisions(self, env: EnvBase) -> Iterator[TensorDictBase]:
        data = env.reset()
        while True:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                data = self._switch(data.to(self.device)).to(env.device or torch.device("cpu"))
            # Checked before a simulator executes them.
            self._check_finite(data.select(keys.DELTA, keys.CHUNK))
            with torch.no_grad():
                decided, data = env.step_and_maybe_reset(data)
            yield decided

    def _collection_seed(self) -> int:
        # Not among the seeds of evaluation and demonstrations; a resumed training plays new episodes.
        if self.steps:
            return 1_000_000_000 + 10_000_000 * (self.config.seed % 100) + self.steps % 10_000_000
        return 6_000_000 + 100_000 * (self.config.seed % 10)

    def _store(self, data: TensorDictBase) -> int:
        """Add decisions to the replay buffer; return the number of their control steps."""
        transitions = data.select(*self._transition_keys).reshape(-1).contiguous().clone()
        following = transitions["next"]
        reward = following["reward"].to(torch.get_default_dtype())  # that of the critics
        following["reward"] = reward - self.config.reward_offset * following[keys.EXECUTED]
        self._check_failures(data["next"])
        following["terminated"] = following["done"].clone()  # DSRL treats time-outs as terminations
        # Checked before saving, since a saved NaN would end every later training.
        self._check_finite(transitions)
        self._check_executed(following)
        self.buffer.extend(transitions)
        return int(data["next", keys.EXECUTED].sum())

    def _check_finite(self, data: TensorDictBase) -> None:
        cause = "the policy or the training has diverged, or the environment is at fault"
        check_finite(dict(data.items(True, True)), cause)

    def _check_failures(self, after: TensorDictBase) -> None:
        """Warn once if episodes end in failure while every control step costs something."""
        flag = after.get(keys.SUCCESS, None)
        if self._warned or self.config.reward_offset <= 0 or flag is None or self.collect is not None:
            return
        done = after["done"]
        solved = flag.bool().view_as(done)
        solved = solved if self._solved is None else solved | self._solved
        self._solved = solved & ~done
        if (after["terminated"] & ~solved).any():
            self._warned = True
            warnings.warn(
                f"episodes end in failure, and reward_offset={self.config.reward_offset:g} is the cost of a "
                "control step: an early failure costs less than a late success. Take reward_offset=0 with a "
                "small alpha_init",
                stacklevel=2,
            )

    def _check_executed(self, after: TensorDictBase) -> None:
        """Raise ValueError for partly executed chunks, because critics judge whole chunks only."""
        decoder, prior = self.decoder, self.decoder.prior
        short = (after[keys.EXECUTED] < prior.chunk_length) & ~after["done"]
        remembers = decoder.observation_key == keys.CONDITIONED or has_anchor(decoder)
        if short.any() and remembers:
            raise ValueError(
                f"the environment executes {int(after[keys.EXECUTED][short].max())} of H = "
                f"{prior.chunk_length} actions per decision, but the agent's critics judge whole chunks: "
                "leave execute out of policy_transforms"
            )

    @property
    def _transition_keys(self) -> list[NestedKey]:
        """Return the stored keys of a transition."""
        states = [self.decoder.observation_key, keys.ANCHOR, *self.decoder.in_keys]
        states = [key for key in dict.fromkeys(states) if key != keys.DELTA]
        after = [*states, "reward", "done", "terminated", keys.EXECUTED]
        return [*states, keys.DELTA, keys.CHUNK, *(unravel_key(("next", key)) for key in after)]

    def _evaluate(self, env: EnvBase, name: str, policy: TensorDictModuleBase) -> None:
        kind = ExplorationType.DETERMINISTIC if name == "greedy" else ExplorationType.RANDOM
        with set_exploration_type(kind):
            episodes = evaluate(
                policy,
                env,
                episodes=self.config.evaluation_episodes,
                first_seed=self.evaluation_seed,
                nfe=self.config.nfe if name == "base" else None,
                policy_seed=self.config.seed,
            )
        successes = sum(episode.success for episode in episodes)
        rate = successes / len(episodes)
        if self.curve and rate > max(row["success_rate"] for row in self.curve):
            self._best = {n: v.detach().clone() for n, v in self.agent.network.state_dict().items()}
        row = {"environment_steps": self.steps, "evaluation": name, "episodes": len(episodes)}
        self.curve.append(row | {"successes": successes, "success_rate": rate})
        self.agent.policy.train()

    def policy(self) -> WarmPriorActor:
        """Return the best policy of the evaluations so far, with a greedy agent.

        It is the frozen policy, at the agent's number of network evaluations, if no agent was better.
        """
        if not self._best:
            return self.actor.replace(nfe=self.config.nfe)
        agent = copy.deepcopy(self.agent.network)
        agent.load_state_dict(self._best)
        return improved_policy(self.actor, agent, nfe=self.config.nfe)

    def _save(self) -> None:
        tensors = {**self.agent.state(), **named("best", self._best), "rng": torch.get_rng_state()}
        if self.device.type == "cuda":
            tensors["rng_cuda"] = torch.cuda.get_rng_state(self.device)
        if len(self.buffer):
            transitions = self.buffer[:].items(True, True)
            tensors |= named("buffer", {json.dumps(key): value for key, value in transitions})
        self._state.save(tensors, steps=self.steps, curve=self.curve)

    def _restore(self) -> None:
        """Continue from the folder's state, if it has one that is not restored already."""
        self._state.restore(self._load)

    def _load(self, tensors: dict[str, torch.Tensor], facts: dict[str, Any]) -> None:
        self.buffer.empty()
        if stored := select("buffer", tensors):
            transitions = {as_key(json.loads(name)): value for name, value in stored.items()}
            self.buffer.extend(TensorDict(transitions, [len(transitions[keys.DELTA])]))
        self.agent.load(tensors)
        self._best = {name: value.to(self.device) for name, value in select("best", tensors).items()}
        self.steps, self.curve = facts["steps"], facts["curve"]
        torch.set_rng_state(tensors["rng"])
        if "rng_cuda" in tensors:
            torch.cuda.set_rng_state(tensors["rng_cuda"], self.device)
