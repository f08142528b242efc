"""A gradient step of behaviour cloning, and the state that it changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim.lr_scheduler import LambdaLR

from warmprior import keys
from warmprior.io.distributed import world_size
from warmprior.io.workers import count_devices
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.learning_rate import warmup_cosine
from warmprior.modules.network import compiling
from warmprior.objectives.couplings import Coupling
from warmprior.objectives.flow_matching import FlowMatchingLoss
from warmprior.options.training import TrainingConfig
from warmprior.saving.training_state import (
    module_tensors,
    named,
    restore_module,
    restore_optimizer,
    select,
    snapshot_optimizer,
)
from warmprior.training.optim import ema_of, make_optimizer


class GradientStep:
    """The loss of a policy, its optimiser, learning-rate schedule and averaged weights (Table 3).

    Args:
        actor: the policy; its network, and its prior if it has weights, are trained in place.
        config: the recipe.
        coupling: pairs sources and targets.
        generator: draws the loss's randomness, on the network's device.
    """

    def __init__(
        self,
        actor: WarmPriorActor,
        config: TrainingConfig,
        *,
        coupling: Coupling | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        #: The network, and the prior if it has weights.
        self.trained = nn.ModuleDict({"network": actor.network})
        if isinstance(actor.prior, nn.Module):
            self.trained["prior"] = actor.prior
        self.ema = ema_of(self.trained, config.ema_rate)
        self._average = cast(Any, self.ema).update_from(self.trained)
        self.loss_module = FlowMatchingLoss(
            actor,
            times=config.times,
            objective=config.objective,
            weighting=config.weighting,
            coupling=coupling,
            generator=generator,
        )
        self._loss: nn.Module = _Scalar(self.loss_module)
        if world_size() > 1:
            self._loss = DistributedDataParallel(self._loss, broadcast_buffers=False)
        self._device = generator.device if generator is not None else torch.device("cpu")
        self.optimizer = make_optimizer(
            actor.network, learning_rate=config.learning_rate, weight_decay=config.weight_decay
        )
        # A prior that was trained before has no parameters that require gradients.
        prior = actor.prior.parameters() if isinstance(actor.prior, nn.Module) else ()
        if learning := [parameter for parameter in prior if parameter.requires_grad]:
            self.optimizer.add_param_group({"params": learning, "weight_decay": 0.0})
        self.schedule = warmup_cosine(self.optimizer, config.iterations, config.warmup_ratio)
        self._graphs = False
        self.config = config

    def compile(self) -> None:
        """Compile the network; on a GPU, with CUDA graphs."""
        count_devices()
        self._graphs = self._device.type == "cuda"
        self.loss_module.actor_network.network.compile(mode="reduce-overhead" if self._graphs else None)

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Take a step on a batch of windows; return its loss, a detached scalar.

        Raises:
            ValueError: if the network cannot be compiled.
        """
        if self.config.count_padding:
            batch = batch.exclude(keys.IS_PAD)
        if self._graphs:  # the graphs may overwrite the outputs of the last step
            torch.compiler.cudagraph_mark_step_begin()
        low = self.config.precision == "bf16"
        # Without the cache, which would return the weights that a coupling has cast without gradients.
        with torch.autocast(self._device.type, torch.bfloat16, enabled=low, cache_enabled=False), compiling():
            loss = cast(Tensor, self._loss(batch))
        self.optimizer.zero_grad()
        loss.backward()
        if self.config.max_grad_norm is not None:  # gradients are already averaged over all processes
            nn.utils.clip_grad_norm_(self.trained.parameters(), self.config.max_grad_norm)
        self.optimizer.step()
        self.schedule.step()
        self._average()
        return loss.detach()

    def averaged(self, actor: WarmPriorActor) -> WarmPriorActor:
        """Return the policy with the averaged weights."""
        return actor.replace(**dict(cast(nn.ModuleDict, self.ema.module).items()))

    def state(self) -> dict[str, Tensor]:
        """Return all that a step changes, by name."""
        return {
            **named("trained", module_tensors(self.trained)),
            **named("ema", module_tensors(self.ema)),
            **named("optimizer", snapshot_optimizer(self.optimizer)),
        }

    def load(self, tensors: Mapping[str, Tensor], iteration: int) -> None:
        """Continue from the tensors that :meth:`state` returned after an iteration."""
        restore_module(self.trained, select("trained", tensors))
        restore_module(self.ema, select("ema", tensors))
        restore_optimizer(self.optimizer, select("optimizer", tensors))
        self.schedule = LambdaLR(self.optimizer, self.schedule.lr_lambdas, last_epoch=iteration - 1)


class _Scalar(nn.Module):
    """The loss of a batch as a tensor, whose gradients DDP averages."""

    def __init__(self, loss_module: FlowMatchingLoss) -> None:
        super().__init__()
        self.loss_module = loss_module

    def forward(self, batch: TensorDictBase) -> Tensor:
        return cast(Tensor, self.loss_module(batch)["loss_flow_matching"])
