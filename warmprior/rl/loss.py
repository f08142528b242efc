"""What a loss in source space needs beside its equations: a hidden decoder, keys and checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ValueEstimators
from torchrl.objectives.common import LossModule
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import dispatch_value_estimator

from warmprior.rl.box_normal import BoxTanhNormal
from warmprior.rl.decoder import PriorDecoder

__all__ = ["PriorSpaceLoss", "check_counts", "check_finite", "check_networks"]


class PriorSpaceLoss(LossModule):
    """Base of losses that decode: holds the frozen policy without making it a part of what is trained.

    Args:
        decoder: the frozen policy.
        backup: ``"min"`` or ``"mean"`` over critics.
        bootstrap_timeouts: whether the value after a time-out counts.
        discount: per ``"step"`` or per ``"decision"``.

    Raises:
        ValueError: for an unknown option.
    """

    default_value_estimator = ValueEstimators.TD0
    decoder: PriorDecoder
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    log_alpha: Tensor
    target_entropy: Tensor
    _results: ClassVar[tuple[str, ...]]
    _diagnostics: ClassVar[tuple[str, ...]]

    def __init__(
        self, decoder: PriorDecoder, *, backup: str, bootstrap_timeouts: bool, discount: str
    ) -> None:
        if backup not in ("min", "mean"):
            raise ValueError(f"backup must be 'min' or 'mean', got {backup!r}")
        if discount not in ("step", "decision"):
            raise ValueError(f"discount must be 'step' or 'decision', got {discount!r}")
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        # Past nn.Module's registration: neither parameters, nor state_dict, nor target updates see it.
        self.__dict__["decoder"] = decoder
        self.backup = backup
        self.bootstrap_timeouts = bootstrap_timeouts
        self.discount = discount
        self.reduction = "mean"

    def _register_temperature(
        self, alpha_init: float, fixed_alpha: bool, target_entropy: float
    ) -> None:
        if not (alpha_init > 0 and math.isfinite(alpha_init)):
            raise ValueError(f"alpha_init must be a finite number > 0, got {alpha_init}")
        if not math.isfinite(target_entropy):
            raise ValueError(f"target_entropy must be a finite number, got {target_entropy}")
        device = self._default_device
        log_alpha = torch.tensor(math.log(alpha_init), device=device)
        if fixed_alpha:
            self.register_buffer("log_alpha", log_alpha)
        else:
            self.register_parameter("log_alpha", nn.Parameter(log_alpha))
        self.register_buffer("target_entropy", torch.tensor(float(target_entropy), device=device))

    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any) -> PriorSpaceLoss:
        # Not a submodule, but it must be on the device of the rest.
        self.decoder._apply(fn)
        return super()._apply(fn, *args)

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: Any
    ) -> None:
        """Choose the discount: ``make_value_estimator(ValueEstimators.TD0, gamma=0.99)``.

        Args:
            value_type: ``TD0``, the only one that fits, or an estimator of the user's.
            hyperparams: ``gamma``, see the option ``discount``.
        """
        value_type, hyperparams = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            dispatch_value_estimator(
                self,
                value_type,
                supported=(ValueEstimators.TD0,),
                value_network=None,
                **hyperparams,
            )

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that :meth:`forward` reads: ``buffer.extend(data.reshape(-1).select(*loss.in_keys))``."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys(unravel_key(key) for key in self._needed_keys()))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        self._in_keys = value

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the result: what starts with ``"loss_"`` is to be minimised, the rest is detached."""
        if self._out_keys is None:
            self._out_keys = [*self._results, *self._diagnostics]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, value: list[NestedKey]) -> None:
        self._out_keys = value

    def _needed_keys(self) -> list[NestedKey]:
        raise NotImplementedError

    def _states(self, *modules: TensorDictModuleBase) -> list[NestedKey]:
        """What the modules read, actions apart."""
        actions = {self.decoder.delta_key, self.decoder.chunk_key}
        needed = dict.fromkeys(unravel_key(key) for module in modules for key in module.in_keys)
        return [key for key in needed if key not in actions]

    def _check_keys(self, tensordict: TensorDictBase, needed: list[NestedKey]) -> None:
        missing = [key for key in needed if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"{type(self).__name__} needs the keys {needed}; missing: {missing}. Data from an "
                'environment with PriorSpace hold the chunk under ("next", "decoded", "chunk"): '
                "set_keys(chunk=...)"
            )

    def _td_target(self, after: TensorDictBase, value: Tensor) -> Tensor:
        k = self.tensor_keys
        estimator = self.value_estimator
        e = estimator.tensor_keys
        reward = after.get(k.reward)
        ended = after.get(k.terminated if self.bootstrap_timeouts else k.done)
        data = TensorDict({}, batch_size=after.batch_size)
        data.set(("next", e.reward), reward)
        data.set(("next", e.done), after.get(k.done))
        data.set(("next", e.terminated), ended)
        if self.discount == "step":
            data.set(e.steps_to_next_obs, after.get(k.executed))
        return estimator.value_estimate(data, next_value=value.view_as(reward)).squeeze(-1)

    def _act(self, state: TensorDictBase) -> tuple[Tensor, Tensor]:
        """A residual and its log-probability in units of the box."""
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            distribution = self.actor_network.get_dist(state)
            delta, log_prob = compute_rsample_log_prob(distribution)
        if log_prob.shape != state.shape:
            raise ValueError(
                f"the actor gives log-probabilities {tuple(log_prob.shape)} for {tuple(state.shape)} "
                "states: its distribution needs event_dims=2"
            )
        if not isinstance(distribution, BoxTanhNormal):
            log_prob = log_prob + delta.shape[-2:].numel() * math.log(self.decoder.delta)
        return delta, log_prob

    def _values(self, data: TensorDictBase) -> Tensor:
        key = self.tensor_keys.state_action_value
        values = data.get(key, None)
        if values is None or values.shape[-1:] != (1,):
            found = "none" if values is None else f"the shape {tuple(values.shape)}"
            raise ValueError(f"every critic must give one value [*B, 1] at {key!r}, found {found}")
        return values.squeeze(-1)

    def _combine(self, data: TensorDictBase) -> Tensor:
        values = self._values(data)
        return values.amin(0) if self.backup == "min" else values.mean(0)

    def _finish(
        self, losses: dict[str, Tensor], tensordict: TensorDictBase, weights: Tensor | None
    ) -> TensorDict:
        reduced = {
            name: self._reduce_loss(loss, tensordict=tensordict, weights=weights)
            for name, loss in losses.items()
        }
        check_finite(reduced)
        return TensorDict(reduced, batch_size=[])


def check_networks(
    actor: ProbabilisticTensorDictSequential,
    chunk_critic: Any,
    noise_critic: Any,
    decoder: PriorDecoder,
) -> None:
    """Whether the networks read and write what the decoder does.

    Raises:
        TypeError: if the actor gives no distribution.
        ValueError: naming the network and the key or size.
    """
    if not isinstance(actor, ProbabilisticTensorDictSequential):
        raise TypeError(
            f"the actor must be the ProbabilisticActor alone, without a decoder behind it, got "
            f"{type(actor).__name__}"
        )
    written = [unravel_key(key) for key in actor.dist_sample_keys]
    if written != [decoder.delta_key]:
        raise ValueError(f"the actor writes {written}, but the decoder reads {decoder.delta_key}")
    spec = getattr(actor, "spec", None)
    box = (
        None
        if spec is None or decoder.delta_key not in spec.keys(True, True)
        else spec[decoder.delta_key]
    )
    high = getattr(box, "high", None)
    if high is not None and not torch.allclose(high, torch.full_like(high, decoder.delta)):
        raise ValueError(
            f"the actor's residuals lie in a box of half side {float(high.max())}, the decoder's in one of "
            f"{decoder.delta}: build the actor with delta=decoder.delta"
        )
    for name, critic, key in (
        ("qvalue_network", chunk_critic, decoder.chunk_key),
        ("noise_qvalue_network", noise_critic, decoder.delta_key),
    ):
        critics = critic if isinstance(critic, list) else [critic]
        for module in critics:
            if key not in [unravel_key(k) for k in module.in_keys]:
                raise ValueError(f"{name} must read {key}, it reads {module.in_keys}")


def check_counts(**counts: int) -> None:
    """Raise ValueError for the first of them that is below one."""
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")


def check_finite(losses: Mapping[str, Tensor]) -> None:
    """Stop at the first NaN or infinity.

    Raises:
        FloatingPointError: naming the losses.
    """
    values = torch.stack([loss.detach() for loss in losses.values()])
    finite = torch.isfinite(values).tolist()
    if not all(finite):
        wrong = [
            f"{name}={value}"
            for name, value, fine in zip(losses, values.tolist(), finite, strict=True)
            if not fine
        ]
        raise FloatingPointError(
            f"{', '.join(wrong)}: the training has diverged; lower the learning rate or check the rewards"
        )
