"""The agent of prior-space reinforcement learning: recipe, networks, loss and optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, SACLoss, SoftUpdate, ValueEstimators

from warmprior import keys
from warmprior.checks import (
    check_between,
    check_choice,
    check_finite,
    check_finite_numbers,
    check_positive,
    check_whole_numbers,
    given,
)
from warmprior.modules.actor import WarmPriorActor
from warmprior.rl.anchor import has_anchor
from warmprior.rl.decoder import PriorDecoder, ResidualSampler
from warmprior.rl.dsrl import DSRLNALoss
from warmprior.rl.networks import make_prior_space_actor, make_prior_space_critic
from warmprior.saving.checkpoint import named, restore_optimizer, select, snapshot_optimizer


@dataclass(frozen=True)
class PriorSpaceConfig:
    """The recipe of prior-space reinforcement learning.

    The defaults are DSRL's for Lift, Can and Square, around a WarmPrior mean.

    Attributes:
        algorithm: ``"dsrl-na"`` or ``"dsrl-sac"``.
        environment_steps: control steps to collect, including the warm-up.
        warmup_steps: control steps before any update, with residuals drawn from the prior and clipped to the
            box.
        delta: half the side of the agent's box; ``None`` for 0.5 around a mean and 1.5 around zero.
        nfe: network evaluations per decoded chunk.
        updates: updates per vector step (one decision of every parallel environment).
        noise_critic_steps: distillation updates per vector step, DSRL-NA only.
        batch_size: transitions per update.
        learning_rate: learning rate of actor, critics and temperature.
        tau: rate of the target critics' averaging.
        gamma: discount per decision.
        hidden_dim: width of actor and critics.
        num_layers: number of hidden layers of actor and critics.
        backup_entropy: include the entropy in the targets of DSRL-NA's critic; those of SAC always do.
        alpha_init: initial temperature, 1 in DSRL. If success ends the episode, choose less than
            ``reward_offset * H / (P * d_a * log 2)``: otherwise the entropy of further decisions is worth
            more than success until the temperature has fallen.
        target_entropy: target of the entropy, in units of the box.
        reward_offset: number subtracted from every control step's reward; DSRL turns 0/1 into -1/0.
        evaluate_every: control steps between evaluations (and saves).
        evaluation_episodes: episodes per evaluation of the greedy agent.
        seed: seed of all random draws.

    Raises:
        ValueError: if an option is unknown or out of range.

    Examples:
        >>> from warmprior.rl import PriorSpaceConfig
        >>> config = PriorSpaceConfig(algorithm="dsrl-sac", delta=1.5, hidden_dim=128)
        >>> config.environment_steps, config.gamma
        (1000000, 0.99)
    """

    algorithm: Literal["dsrl-na", "dsrl-sac"] = "dsrl-na"
    environment_steps: int = 1_000_000
    warmup_steps: int = 24_000
    delta: float | None = None
    nfe: int = 1
    updates: int = 20
    noise_critic_steps: int = 10
    batch_size: int = 256
    learning_rate: float = 3e-4
    tau: float = 0.005
    gamma: float = 0.99
    hidden_dim: int = 2048
    num_layers: int = 3
    backup_entropy: bool = True
    alpha_init: float = 1.0
    target_entropy: float = 0.0
    reward_offset: float = 1.0
    evaluate_every: int = 20_000
    evaluation_episodes: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("algorithm", self.algorithm, ("dsrl-na", "dsrl-sac"))
        if self.algorithm == "dsrl-sac" and not self.backup_entropy:
            raise ValueError("dsrl-sac has backup_entropy=True; leave it out")
        check_finite_numbers(target_entropy=self.target_entropy, reward_offset=self.reward_offset)
        check_positive(learning_rate=self.learning_rate, alpha_init=self.alpha_init)
        check_positive(gamma=self.gamma, tau=self.tau, **given(delta=self.delta))
        check_between(0, 1, gamma=self.gamma, tau=self.tau)
        names = ["environment_steps", "warmup_steps", "nfe", "updates", "noise_critic_steps", "batch_size"]
        names += ["hidden_dim", "num_layers", "evaluate_every", "evaluation_episodes"]
        check_whole_numbers(**{name: getattr(self, name) for name in names})
        if self.warmup_steps > self.environment_steps:
            raise ValueError(
                f"warmup_steps ({self.warmup_steps}) exceed environment_steps ({self.environment_steps})"
            )

    def delta_for(self, actor: WarmPriorActor) -> float:
        """Return ``delta``, or its default for a policy: the paper's 0.5 around a mean, 1.5 around zero."""
        return self.delta or (0.5 if has_anchor(actor) else 1.5)


class WarmUpSwitch(TensorDictModuleBase):
    """A policy that acts by ``warmup``, and by ``policy`` once ``learning`` is True.

    The flag ``learning`` is a buffer, bool ``[]``, which collectors receive with the weights.
    """

    def __init__(self, warmup: TensorDictModuleBase, policy: TensorDictModuleBase) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, [keys.DELTA, keys.CHUNK]
        self.warmup, self.policy = warmup, policy
        self.learning = nn.Buffer(torch.zeros((), dtype=torch.bool))

    def forward(self, data: TensorDictBase) -> TensorDictBase:
        """Write a residual and its chunk."""
        decided = (self.policy if self.learning else self.warmup)(data.copy())
        return data.update(decided.select(*self.out_keys))


class PriorSpaceAgent:
    """An agent around a copy of a frozen policy, its critics, and one update of them.

    PyTorch's global generator draws the initial weights. Raises ValueError if the recipe does not fit the
    policy. ``policy`` is the agent followed by the decoder; in ``warmup`` residuals from the prior replace
    the agent.
    """

    def __init__(self, actor: WarmPriorActor, config: PriorSpaceConfig) -> None:
        self.config = config
        self.device = next(actor.parameters()).device
        self.decoder = PriorDecoder(actor.replace(nfe=config.nfe), delta=config.delta_for(actor))
        # By default, draws around a mean are clipped to the box, and draws around zero are not.
        drawn: Literal["clipped"] | None = None if has_anchor(actor) else "clipped"
        self.warmup = TensorDictSequential(ResidualSampler(self.decoder, distribution=drawn), self.decoder)
        self.state_keys = [self.decoder.observation_key, keys.ANCHOR]
        names = ("action_dim", "observation_dim", "prediction_length", "observation_steps")
        sizes: dict[str, Any] = {name: getattr(actor.network, name, None) for name in names}
        if missing := [name for name, size in sizes.items() if size is None]:
            kind = type(actor.network).__name__
            raise TypeError(
                f"an agent needs the policy's {', '.join(missing)}: make {kind} a VelocityNetwork"
            )
        sizes |= {"hidden_dim": config.hidden_dim, "num_layers": config.num_layers}
        network = make_prior_space_actor(**sizes, delta=self.decoder.delta, in_keys=self.state_keys)
        self.network = network.to(self.device)
        self.policy = TensorDictSequential(self.network, self.decoder)
        self.loss = self._make_loss(self.network, sizes).to(self.device)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self._updater = SoftUpdate(self.loss, tau=config.tau)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.learning_rate)

    def _make_loss(self, network: ProbabilisticActor, sizes: dict[str, int]) -> LossModule:
        config = self.config
        entropy = {"alpha_init": config.alpha_init, "target_entropy": config.target_entropy}
        noise_critic = make_prior_space_critic(
            **sizes, delta=self.decoder.delta, in_keys=(*self.state_keys, keys.DELTA)
        )
        if config.algorithm == "dsrl-na":
            chunk_keys = (self.decoder.observation_key, keys.CHUNK)
            return DSRLNALoss(
                network,
                make_prior_space_critic(**sizes, in_keys=chunk_keys),
                noise_critic,
                self.decoder,
                discount="decision",
                noise_critic_steps=config.noise_critic_steps,
                backup_entropy=config.backup_entropy,
                **entropy,
            )
        return SACLoss(network, noise_critic, loss_function="l2", action_spec=network.spec, **entropy)

    def learn(self, buffer: ReplayBuffer) -> dict[str, float]:
        """Make the updates for one vector step of the environment, each on its own batch.

        Returns the critic's loss ``"q"`` and the temperature ``"alpha"`` of the last update. Raises
        FloatingPointError if a loss is NaN or infinite, before it changes anything.
        """
        values: dict[str, Tensor] = {}
        schedule: Iterable[Callable[[TensorDictBase], TensorDict]] = [self.loss] * self.config.updates
        if isinstance(self.loss, DSRLNALoss):
            schedule = self.loss.schedule(self.config.updates)
        for compute in schedule:
            result = compute(buffer.sample())
            losses = {k: v for k, v in result.items() if k.startswith("loss_")}
            check_finite(losses)  # TorchRL's SAC does not check this
            self.optimizer.zero_grad()
            torch.stack(list(losses.values())).sum().backward()
            self.optimizer.step()
            if "loss_qvalue" in losses:
                self._updater.step()
            values |= {k: v.detach() for k, v in result.items()}
        return {"q": float(values["loss_qvalue"]), "alpha": float(values["alpha"])}

    def _parameters(self) -> dict[str, Tensor]:
        # Without the frozen policy, and without buffers other than the target critics'.
        targets = {k: v for k, v in self.loss.named_buffers() if k.split(".")[0].endswith("_params")}
        return {k: v for k, v in self.loss.named_parameters() if v.requires_grad} | targets

    def state(self) -> dict[str, Tensor]:
        """Return all learned tensors, by name, checked: a finite loss may have an infinite gradient."""
        tensors = {
            **named("loss", self._parameters()),
            **named("optimizer", snapshot_optimizer(self.optimizer)),
        }
        check_finite(tensors)
        return tensors

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the tensors of :meth:`state`."""
        saved = select("loss", tensors)
        with torch.no_grad():
            for name, value in self._parameters().items():
                value.copy_(saved[name])
        restore_optimizer(self.optimizer, select("optimizer", tensors))
