"""The agent of prior-space reinforcement learning: recipe, networks, loss and optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, SACLoss, SoftUpdate, ValueEstimators

from warmprior import keys
from warmprior.checks import check_finite
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import compiling
from warmprior.options.agent import WARM_DELTA, ZERO_DELTA, PriorSpaceConfig
from warmprior.rl.anchor import has_anchor
from warmprior.rl.decoder import PriorDecoder, ResidualSampler
from warmprior.rl.dsrl import DSRLNALoss
from warmprior.rl.networks import make_prior_space_actor, make_prior_space_critic
from warmprior.saving.training_state import named, restore_optimizer, select, snapshot_optimizer


def delta_of(config: PriorSpaceConfig, actor: WarmPriorActor) -> float:
    """Return ``delta``, or its default for a policy: around a mean, or around zero."""
    return config.delta or (WARM_DELTA if has_anchor(actor) else ZERO_DELTA)


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
        self.decoder = PriorDecoder(
            actor.replace(nfe=config.nfe),
            delta=delta_of(config, actor),
            residual_length=config.residual_length,
        )
        # By default, draws around a mean are clipped to the box, and draws around zero are not.
        drawn: Literal["clipped"] | None = None if has_anchor(actor) else "clipped"
        self.warmup = TensorDictSequential(ResidualSampler(self.decoder, distribution=drawn), self.decoder)
        self.state_keys = [self.decoder.observation_key, keys.ANCHOR]
        layers = {"hidden_dim": config.hidden_dim, "num_layers": config.num_layers}
        sizes = self.decoder.sizes | layers
        network = make_prior_space_actor(**sizes, delta=self.decoder.delta, in_keys=self.state_keys)
        self.network = network.to(self.device)
        self.policy = TensorDictSequential(self.network, self.decoder)
        self.loss = self._make_loss(self.network, sizes).to(self.device)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self._updater = SoftUpdate(self.loss, tau=config.tau)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.learning_rate, fused=True)

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

    def compile(self) -> None:
        """Compile the losses, decoding included."""
        loss: Any = self.loss
        if isinstance(loss, DSRLNALoss):
            for name in ("reinforcement_loss", "distillation_loss"):
                setattr(loss, name, torch.compile(getattr(loss, name)))
        else:
            loss.compile()

    def learn(self, buffer: ReplayBuffer) -> dict[str, float]:
        """Make the updates for one vector step of the environment, each on its own batch.

        Returns the critic's loss ``"q_loss"`` and the temperature ``"alpha"`` of the last update. Raises
        FloatingPointError if a loss is NaN or infinite, before it changes anything, and ValueError if the
        losses cannot be compiled.
        """
        values: dict[str, Tensor] = {}
        schedule: Iterable[Callable[[TensorDictBase], TensorDict]] = [self.loss] * self.config.updates
        if isinstance(self.loss, DSRLNALoss):
            schedule = self.loss.schedule(self.config.updates)
        for compute in schedule:
            with compiling():
                result = compute(buffer.sample())
            losses = {k: v for k, v in result.items() if k.startswith("loss_")}
            check_finite(losses)  # TorchRL's SAC does not check this
            self.optimizer.zero_grad()
            torch.stack(list(losses.values())).sum().backward()
            self.optimizer.step()
            if "loss_qvalue" in losses:
                self._updater.step()
            values |= {k: v.detach() for k, v in result.items()}
        return {"q_loss": float(values["loss_qvalue"]), "alpha": float(values["alpha"])}

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
