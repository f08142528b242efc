"""Off-policy reinforcement learning in the source space of a frozen policy, resumable at any moment."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators
from tqdm import tqdm

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.decoder import PriorDecoder
from warmprior.modules.prior_space import make_prior_space_actor, make_prior_space_critic
from warmprior.modules.residual import ResidualSampler
from warmprior.objectives import DSRLNALoss
from warmprior.objectives._prior_space import check_finite
from warmprior.training.checkpoint import (
    load_state,
    named,
    restore_optimizer,
    save_state,
    select,
    snapshot_optimizer,
)
from warmprior.training.evaluation import Episode, evaluate
from warmprior.training.prior_space_config import PriorSpaceConfig
from warmprior.training.replay_segments import ReplaySegments

__all__ = ["PriorSpaceTraining"]


class PriorSpaceTraining:
    """Trains an agent around a frozen policy, with TorchRL's environments, losses and replay buffer.

    The folder receives ``state.safetensors`` (replaced atomically at every evaluation) and the replay
    buffer in segments. Constructing the same training on it continues from the last save; simulators
    cannot be saved, so that the episodes under way at an interruption are lost and new ones started.

    Args:
        actor: the frozen policy; copied.
        make_env: ``make_env(seed) -> EnvBase``, a batched environment ``[n]`` with the policy's
            transforms and :class:`~warmprior.PriorAnchor`; called for training and evaluation.
        config: the recipe.
        directory: the folder.

    Keyword Args:
        evaluation_seed: simulator seed of the first evaluation episode.
        description: of the progress bar; no bar if ``None``.

    Raises:
        ValueError: if the environment does not fit the policy, or the folder's state belongs to another
            recipe or policy.
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
    ) -> None:
        self.actor, self.make_env, self.config = actor, make_env, config
        self.directory = Path(directory)
        self.evaluation_seed, self.description = evaluation_seed, description
        torch.manual_seed(config.seed)
        self.decoder = PriorDecoder(actor, delta=config.box(actor), nfe=config.nfe)
        self.warmup = TensorDictSequential(
            ResidualSampler(self.decoder, distribution="clipped"), self.decoder
        )
        self.device = next(actor.parameters()).device
        agent = self._network(make_prior_space_actor, delta=self.decoder.delta).to(self.device)
        self.policy = TensorDictSequential(agent, self.decoder)
        self.loss = self._make_loss(agent).to(self.device)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self.updater = SoftUpdate(self.loss, tau=config.tau)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.learning_rate)
        # No transition is ever dropped: at least one control step each.
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(config.environment_steps, device=self.device),
            batch_size=config.batch_size,
        )
        self.segments = ReplaySegments(self.directory / "buffer")
        self.steps = 0
        self.curve: list[dict[str, Any]] = []
        self.identity = {
            "config": asdict(config),
            "prior": actor.prior.config(),
            "policy": _digest(actor),
        }
        if self.state_path.exists():
            self._restore()

    @property
    def state_path(self) -> Path:
        """Where the training state lies."""
        return self.directory / "state.safetensors"

    def _network(self, make: Callable[..., Any], **options: Any) -> Any:
        network: Any = self.actor.network
        return make(
            network.action_dim,
            network.observation_dim - self.actor.prior.context_dim(network.action_dim),
            self.actor.prior.prediction_length,
            network.observation_steps,
            hidden_dim=self.config.hidden_dim,
            num_layers=self.config.num_layers,
            **options,
        )

    def _make_loss(self, agent: Any) -> Any:
        config, delta = self.config, self.decoder.delta
        noise_critic = self._network(make_prior_space_critic, delta=delta)
        if config.algorithm == "dsrl-na":
            chunk_keys = (keys.OBSERVATION, keys.CHUNK)
            return DSRLNALoss(
                agent,
                self._network(make_prior_space_critic, in_keys=chunk_keys),
                noise_critic,
                self.decoder,
                backup=config.backup,
                discount="decision",
                noise_critic_steps=config.noise_critic_steps,
                bootstrap_timeouts=config.bootstrap_timeouts,
                alpha_init=config.alpha_init,
                target_entropy=config.target_entropy,
            )
        size = (self.actor.prior.prediction_length, int(agent.spec[keys.DELTA].shape[-1]))
        box = Composite({keys.DELTA: Bounded(-delta, delta, size)})
        return SACLoss(
            agent,
            noise_critic,
            action_spec=box,
            alpha_init=config.alpha_init,
            # TorchRL's log-probabilities are those of the residual, not of units of the box.
            target_entropy=config.target_entropy + math.prod(size) * math.log(delta),
        )

    def run(self) -> list[dict[str, Any]]:
        """Collect, learn and evaluate to the end.

        Returns:
            The evaluations: ``environment_steps``, ``evaluation`` (``"base"``: the frozen policy itself;
            ``"greedy"``, ``"stochastic"``), ``episodes``, ``successes``, ``success_rate``.

        Raises:
            FloatingPointError: if a loss becomes NaN or infinite; the last save stays.
        """
        config = self.config
        evaluation_env = self.make_env(0)
        env = self.make_env(self._training_seed())
        bar = tqdm(
            total=config.environment_steps,
            initial=self.steps,
            desc=self.description,
            unit="step",
            disable=self.description is None,
        )
        try:
            if not self.curve:
                self._evaluate(evaluation_env, {"base": self.actor})
                self._save()
            data = env.reset()
            while self.steps < config.environment_steps:
                data, executed = self._collect(env, data)
                before, self.steps = self.steps, self.steps + executed
                bar.update(executed)
                if self.steps > config.warmup_steps:
                    self._learn(bar)
                due = self.steps // config.evaluate_every > before // config.evaluate_every
                if due or self.steps >= config.environment_steps:
                    agents = {"greedy": self.policy, "stochastic": self.policy}
                    self._evaluate(evaluation_env, agents)
                    self._save()
        finally:
            bar.close()
            for each in (env, evaluation_env):
                if not each.is_closed:
                    each.close()
        return self.curve

    def _training_seed(self) -> int:
        # Away from evaluation and demonstrations; a continued training plays new episodes.
        return 6_000_000 + 100_000 * (self.config.seed % 10) + self.steps % 100_000

    @torch.no_grad()
    def _collect(self, env: EnvBase, data: TensorDictBase) -> tuple[TensorDictBase, int]:
        policy = self.warmup if self.steps < self.config.warmup_steps else self.policy
        with set_exploration_type(ExplorationType.RANDOM):
            data = policy(data.to(self.device)).to("cpu")
        data, following = env.step_and_maybe_reset(data)
        transitions = self._transitions(data)
        self.buffer.extend(transitions)
        self.segments.append(transitions)
        return following, int(data["next", keys.EXECUTED].sum())

    def _transitions(self, data: TensorDictBase) -> TensorDictBase:
        states = [self.decoder.observation_key, keys.ANCHOR, *self.decoder.in_keys]
        states = [key for key in dict.fromkeys(states) if key != keys.DELTA]
        after = [*states, "reward", "done", "terminated", keys.EXECUTED]
        transitions = data.select(
            *states, keys.DELTA, keys.CHUNK, *(unravel_key(("next", key)) for key in after)
        )
        transitions = transitions.reshape(-1).contiguous().clone()
        following = transitions["next"]
        following["reward"] = (
            following["reward"] - self.config.reward_offset * following[keys.EXECUTED]
        )
        if not self.config.bootstrap_timeouts:
            following["terminated"] = following["done"].clone()
        return transitions

    def _schedule(self) -> Iterator[Callable[[TensorDictBase], TensorDict]]:
        if isinstance(self.loss, DSRLNALoss):
            return self.loss.schedule(self.config.updates)
        return iter([self.loss] * self.config.updates)

    def _learn(self, bar: Any) -> None:
        values: dict[str, Tensor] = {}
        for compute in self._schedule():
            result = compute(self.buffer.sample())
            losses = {k: v for k, v in result.items() if k.startswith("loss_")}
            check_finite(losses)
            self.optimizer.zero_grad()
            torch.stack(list(losses.values())).sum().backward()
            self.optimizer.step()
            if "loss_qvalue" in losses:
                self.updater.step()
            values |= {k: v.detach() for k, v in result.items()}
        bar.set_postfix(
            q=f"{float(values['loss_qvalue']):.3g}",
            alpha=f"{float(values['alpha']):.2g}",
            refresh=False,
        )

    def _evaluate(self, env: EnvBase, policies: dict[str, TensorDictModuleBase]) -> None:
        for name, policy in policies.items():
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
            self.curve.append(self._row(name, episodes))
        self.policy.train()

    def _row(self, name: str, episodes: list[Episode]) -> dict[str, Any]:
        successes = sum(episode.success for episode in episodes)
        return {
            "environment_steps": self.steps,
            "evaluation": name,
            "episodes": len(episodes),
            "successes": successes,
            "success_rate": successes / len(episodes),
        }

    def _parameters(self) -> dict[str, Tensor]:
        return dict(chain(self.loss.named_parameters(), self.loss.named_buffers()))

    def _save(self) -> None:
        self.segments.write()
        tensors = {
            **named("loss", self._parameters()),
            **named("optimizer", snapshot_optimizer(self.optimizer)),
            "rng": torch.get_rng_state(),
        }
        facts = {
            "identity": self.identity,
            "steps": self.steps,
            "curve": self.curve,
            "segments": self.segments.committed,
        }
        save_state(self.state_path, tensors, facts)

    def _restore(self) -> None:
        tensors, facts = load_state(self.state_path)
        for part, mine in self.identity.items():
            theirs = facts["identity"].get(part)
            if theirs != mine:
                raise ValueError(
                    f"{self.state_path} belongs to another {part}: it has {theirs}, this run has "
                    f"{mine}. Use the same options, or another output folder."
                )
        saved = select("loss", tensors)
        with torch.no_grad():
            for name, value in self._parameters().items():
                value.copy_(saved[name])
        restore_optimizer(self.optimizer, select("optimizer", tensors))
        self.steps, self.curve = facts["steps"], facts["curve"]
        self.segments = ReplaySegments(self.directory / "buffer", facts["segments"])
        transitions = self.segments.load()
        if transitions is not None:
            self.buffer.extend(transitions)
        torch.set_rng_state(tensors["rng"])


def _digest(actor: WarmPriorActor) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(actor.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
