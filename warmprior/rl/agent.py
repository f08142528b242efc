"""The agent of prior-space reinforcement learning: networks, loss and optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import LossModule, SACLoss, SoftUpdate, ValueEstimators

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.checks import check_finite
from warmprior.rl.anchor import has_anchor
from warmprior.rl.config import PriorSpaceConfig
from warmprior.rl.decoder import PriorDecoder
from warmprior.rl.dsrl import DSRLNALoss
from warmprior.rl.networks import BoxTanhNormal, make_prior_space_actor, make_prior_space_critic
from warmprior.rl.residual import ResidualDistribution, ResidualSampler
from warmprior.training.checkpoint import named, restore_optimizer, select, snapshot_optimizer

__all__ = ["PriorSpaceAgent"]


class PriorSpaceAgent:
    """An agent around a copy of a frozen policy, its critics, and one update of them.

    Initial weights follow from PyTorch's global generator. A ``ValueError`` if the recipe does not suit the
    policy. ``policy`` is the agent followed by the decoder, ``warmup`` residuals from the prior in the
    agent's place.
    """

    def __init__(self, actor: WarmPriorActor, config: PriorSpaceConfig) -> None:
        self.config = config
        self.device = next(actor.parameters()).device
        self.decoder = PriorDecoder(actor, delta=config.box(actor), nfe=config.nfe)
        # By default draws around a mean stay in the box, and draws around zero do not.
        drawn: ResidualDistribution | None = None if has_anchor(actor) else "clipped"
        self.warmup = TensorDictSequential(ResidualSampler(self.decoder, distribution=drawn), self.decoder)
        self.state_keys = [self.decoder.observation_key, keys.ANCHOR]
        frozen: Any = actor.network
        sizes = {
            "action_dim": frozen.action_dim,
            "observation_dim": frozen.observation_dim,
            "prediction_length": actor.prior.prediction_length,
            "observation_steps": frozen.observation_steps,
            "hidden_dim": config.hidden_dim,
            "num_layers": config.num_layers,
        }
        network = make_prior_space_actor(
            **sizes,
            delta=self.decoder.delta,
            in_keys=self.state_keys,
            # DSRL-NA changes units by itself, TorchRL's SAC does not.
            distribution_class=BoxTanhNormal if config.algorithm == "dsrl-sac" else TanhNormal,
        ).to(self.device)
        self.policy = TensorDictSequential(network, self.decoder)
        self.loss = self._make_loss(network, sizes).to(self.device)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self._updater = SoftUpdate(self.loss, tau=config.tau)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.learning_rate)

    def _make_loss(self, network: ProbabilisticActor, sizes: dict[str, int]) -> LossModule:
        config = self.config
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
                distillation=config.distillation,
                backup_entropy=config.backup_entropy,
                alpha_init=config.alpha_init,
                target_entropy=config.target_entropy,
            )
        return SACLoss(
            network,
            noise_critic,
            loss_function="l2",
            action_spec=network.spec,
            alpha_init=config.alpha_init,
            target_entropy=config.target_entropy,
        )

    def learn(self, buffer: ReplayBuffer) -> dict[str, float]:
        """The updates for one vector step of the environment, each on its own batch from the agent's device.

        Of the last one the critic's loss ``"q"`` and the temperature ``"alpha"``. A ``FloatingPointError``
        names a loss that is NaN or infinite before it changes anything.
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
        # Only the buffers of the target critics: the others are the frozen policy and constants.
        buffers = self.loss.named_buffers()
        targets = {k: v for k, v in buffers if k.split(".")[0].endswith("_params")}
        return dict(self.loss.named_parameters()) | targets

    def state(self) -> dict[str, Tensor]:
        """All that learning has changed, by name, checked: a finite loss may have an infinite gradient."""
        tensors = {
            **named("loss", self._parameters()),
            **named("optimizer", snapshot_optimizer(self.optimizer)),
        }
        check_finite(tensors)
        return tensors

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Go back to what :meth:`state` gave."""
        saved = select("loss", tensors)
        with torch.no_grad():
            for name, value in self._parameters().items():
                value.copy_(saved[name])
        restore_optimizer(self.optimizer, select("optimizer", tensors))
