"""DSRL-NA: reinforcement learning in source space with a critic of executed chunks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ValueEstimators
from torchrl.objectives.common import LossModule
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import _vmap_func, dispatch_value_estimator

from warmprior import keys
from warmprior.checks import (
    check_choice,
    check_finite,
    check_finite_numbers,
    check_keys,
    check_positive,
    check_shape,
    check_whole_numbers,
)
from warmprior.rl.decoder import PriorDecoder, ResidualSampler
from warmprior.rl.networks import BoxTanhNormal
from warmprior.transforms.inner_step import rows_where

type Critics = TensorDictModule | list[TensorDictModule]

CRITICS = 2
"""The number of critics of each kind if one is given to copy; the smallest of their values is used."""

STEPS = "steps_to_next_obs"
"""TorchRL's key of the decisions up to the next state, which its ``MultiStep`` writes."""


class DSRLNALoss(LossModule):
    r"""The loss of noise-aliased DSRL (`Wagenmaker et al. 2025 <https://arxiv.org/abs/2506.15799>`_).

    It works around any anchor.

    Many sources decode to the same chunk, so an action critic :math:`Q^A(s, a)` learns about the *chunk*, by
    temporal differences on executed chunks. A noise critic :math:`Q^W(s, \Delta)` is distilled from it
    through the frozen decoder :math:`D`, and the actor maximises the noise critic, without gradients through
    the decoder:

    .. math::
        y &= r + \gamma^k (1 - d) \Big[\min_i \bar Q^A_i(s', D(s', \Delta'))
            - \alpha \log \pi(\Delta' | s')\Big], \quad \Delta' \sim \pi(\cdot | s') \\
        L_{Q^A} &= \tfrac12 \sum_i \big(Q^A_i(s, a) - y\big)^2, \qquad
        L_{Q^W} = \tfrac12 \sum_i \big(Q^W_i(s, \Delta) - Q^A_i(s, D(s, \Delta))\big)^2,
            \quad \Delta \sim q \\
        L_\pi &= \alpha \log \pi(\Delta | s) - \min_i Q^W_i(s, \Delta), \qquad
        L_\alpha = -\log \alpha \, (\log \pi + \mathcal{H})

    with stopped gradients where SAC has them, and batch means throughout. :math:`q` is the distribution that
    :class:`~warmprior.ResidualSampler` chooses for the policy. As in the official implementation,
    log-probabilities are in units of the box, :math:`\Delta / \delta \in [-1, 1]`, and time-outs are
    terminations. The defaults are the official ones, except the discount. The official schedule makes several
    updates per step and then distils on separate batches:

    .. code-block:: python

        updater = SoftUpdate(loss, tau=0.005)
        optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
        for compute in loss.schedule(updates=20):  # 20 times the first three, 10 times the distillation
            losses = compute(buffer.sample())
            optimizer.zero_grad()
            sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
            optimizer.step()
            if "loss_qvalue" in losses.keys():
                updater.step()

    Args:
        actor_network: the policy over residuals, see :func:`~warmprior.make_prior_space_actor`.
        qvalue_network: :math:`Q^A`, which reads ``keys.CHUNK`` (all ``P`` actions, see
            :func:`~warmprior.make_prior_space_critic`); one module, of which two copies are initialised, or a
            list.
        noise_qvalue_network: :math:`Q^W`, which reads ``keys.DELTA``; also one module or a list.
        decoder: the frozen policy. It is in the loss's ``state_dict()`` and moves with ``loss.to(device)``;
            no gradient and no target update reaches it.
        backup_entropy: True includes the entropy in the targets.
        discount: ``"step"`` discounts by :math:`\gamma^k` for ``k`` executed control steps, with the
            ``gamma`` of :class:`~warmprior.ChunkStep`; ``"decision"`` by :math:`\gamma` for any ``k``, as in
            the official implementation (with undiscounted rewards inside chunks).
        noise_critic_steps: distillation steps per round of :meth:`schedule`.
        alpha_init: initial temperature.
        target_entropy: :math:`\mathcal{H}`, target of the residual's entropy in units of the box.

    .. note::
        The keys, which :meth:`set_keys` renames, are ``chunk``, the decoded chunk of the transition (in data
        from :class:`~warmprior.PriorSpace` ``("next", "decoded", "chunk")``); under ``"next"`` ``reward``,
        ``done`` and ``executed``; ``priority``, where the TD error of each row is written;
        ``priority_weight``; and ``state_action_value``, the critics' output. ``loss.in_keys`` lists all keys
        that the loss reads: ``buffer.extend(data.reshape(-1).select(*loss.in_keys))``.

    Raises:
        TypeError: if the actor has no distribution.
        ValueError: if an option is unknown or a network does not fit the decoder; (when called) if a critic
            returns several values, or ``MultiStep`` has skipped decisions.
        KeyError: (when called) if the batch lacks a key.
        FloatingPointError: (when called) if a loss is NaN or infinite.

    Examples:
        >>> from warmprior import DSRLNALoss, PastPrior, PriorDecoder, VelocityMLP, WarmPriorActor
        >>> from warmprior import keys, make_prior_space_actor, make_prior_space_critic
        >>> decoder = PriorDecoder(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), delta=0.5)
        >>> loss = DSRLNALoss(
        ...     make_prior_space_actor(2, 3, 4, delta=0.5),
        ...     make_prior_space_critic(2, 3, 4, in_keys=(keys.OBSERVATION, keys.CHUNK)),
        ...     make_prior_space_critic(2, 3, 4, delta=0.5),
        ...     decoder)
        >>> loss.make_value_estimator(gamma=0.99)
        >>> [compute.__name__ for compute in loss.schedule(updates=2)][:3]
        ['reinforcement_loss', 'reinforcement_loss', 'distillation_loss']
    """

    @dataclass
    class _AcceptedKeys:
        """The configurable tensordict keys, see the class docstring."""

        chunk: NestedKey = keys.CHUNK
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        executed: NestedKey = keys.EXECUTED
        state_action_value: NestedKey = "state_action_value"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    decoder: PriorDecoder
    log_alpha: Tensor
    target_entropy: Tensor
    # TorchRL warns of parameters that are not annotated.
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    noise_qvalue_network: TensorDictModule
    noise_qvalue_network_params: TensorDictParams
    target_noise_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: Critics,
        noise_qvalue_network: Critics,
        decoder: PriorDecoder,
        *,
        backup_entropy: bool = True,
        discount: Literal["step", "decision"] = "step",
        noise_critic_steps: int = 10,
        alpha_init: float = 1.0,
        target_entropy: float = 0.0,
    ) -> None:
        check_choice("discount", discount, ("step", "decision"))
        check_whole_numbers(noise_critic_steps=noise_critic_steps)
        check_positive(alpha_init=alpha_init)
        check_finite_numbers(target_entropy=target_entropy)
        _check_networks(actor_network, qvalue_network, noise_qvalue_network, decoder)
        super().__init__()
        self.decoder = decoder
        self.backup_entropy = backup_entropy
        self.discount = discount
        self.noise_critic_steps = noise_critic_steps
        self.reduction = "mean"
        self.distillation = ResidualSampler(decoder)
        self.convert_to_functional(actor_network, "actor_network")
        number, noise_number = (
            len(critics) if isinstance(critics, list) else CRITICS
            for critics in (qvalue_network, noise_qvalue_network)
        )
        self.convert_to_functional(qvalue_network, "qvalue_network", number, create_target_params=True)
        self.convert_to_functional(noise_qvalue_network, "noise_qvalue_network", noise_number)
        log_alpha = torch.tensor(math.log(alpha_init), device=self._default_device)
        self.log_alpha = nn.Parameter(log_alpha)
        self.register_buffer("target_entropy", torch.full_like(log_alpha, target_entropy))
        self._make_vmap()
        self._set_in_keys()
        self.out_keys = ["loss_actor", "loss_alpha", "loss_qvalue", "loss_qvalue_noise"]
        self.out_keys += ["alpha", "entropy", "td_error"]

    def _make_vmap(self) -> None:
        options = {"randomness": self.vmap_randomness}
        self._vmap_qvalue = _vmap_func(self.qvalue_network, (None, 0), **options)
        self._vmap_noise_qvalue = _vmap_func(self.noise_qvalue_network, (None, 0), **options)

    def _reinforcement_keys(self) -> list[NestedKey]:
        k = self.tensor_keys
        after = self._states(self.actor_network, self.decoder, self.qvalue_network)
        after += [k.reward, k.done, *[k.executed] * (self.discount == "step")]
        before = self._states(self.actor_network, self.qvalue_network, self.noise_qvalue_network)
        return [*before, k.chunk, *(unravel_key(("next", key)) for key in after)]

    def _distillation_keys(self) -> list[NestedKey]:
        return self._states(self.decoder, self.qvalue_network, self.noise_qvalue_network)

    def _set_in_keys(self) -> None:
        """Set ``in_keys``, when TorchRL calls it from :meth:`set_keys`."""
        needed = [*self._reinforcement_keys(), *self._distillation_keys()]
        self.in_keys = list(dict.fromkeys(unravel_key(key) for key in needed))

    def _states(self, *modules: TensorDictModuleBase) -> list[NestedKey]:
        """Return the keys that the modules read, without actions."""
        actions = {keys.DELTA, keys.CHUNK}
        needed = dict.fromkeys(unravel_key(key) for module in modules for key in module.in_keys)
        return [key for key in needed if key not in actions]

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams: Any) -> None:
        """Choose the discount: ``make_value_estimator(ValueEstimators.TD0, gamma=0.99)``; no other fits."""
        value_type, hyperparams = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            dispatch_value_estimator(
                self, value_type, supported=(ValueEstimators.TD0,), value_network=None, **hyperparams
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return all four losses on one batch of transitions ``[N]``, as scalars.

        The result also has detached ``alpha``, ``entropy`` (units of the box) and ``td_error``.
        """
        return self.reinforcement_loss(tensordict).update(self.distillation_loss(tensordict))

    def schedule(self, updates: int) -> Iterator[Callable[[TensorDictBase], TensorDict]]:
        """Yield losses in the official order: the first three ``updates`` times, then the distillation.

        They are methods, to be called on a separate batch each. ``updates`` is the official ``utd``: updates
        per vector step, 20 for four environments.
        """
        check_whole_numbers(updates=updates)
        return iter([self.reinforcement_loss] * updates + [self.distillation_loss] * self.noise_critic_steps)

    def reinforcement_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of actor, temperature and action critic on transitions; write the TD errors."""
        elsewhere = (
            ". Data from an environment with PriorSpace hold the chunk under ('next', 'decoded', 'chunk'): "
            "set_keys(chunk=...)"
        )
        check_keys(tensordict, self._reinforcement_keys(), type(self).__name__, elsewhere)
        self._check_next_states(tensordict)
        weights = self._maybe_get_priority_weight(tensordict)
        alpha = self.log_alpha.exp().detach()
        loss_qvalue, td_error = self._qvalue_loss(tensordict, alpha)
        tensordict.set(self.tensor_keys.priority, td_error)

        state = tensordict.select(*self._states(self.actor_network, self.noise_qvalue_network))
        delta, log_prob = self._act(state)
        # Detached, so that gradients reach the residual but not the critic.
        frozen = self.noise_qvalue_network_params.detach()
        value = self._vmap_noise_qvalue(state.set(keys.DELTA, delta), frozen)
        loss_actor = alpha * log_prob - self._values(value).amin(0)
        loss_alpha = -self.log_alpha * (log_prob.detach() + self.target_entropy)
        losses = {"loss_actor": loss_actor, "loss_alpha": loss_alpha, "loss_qvalue": loss_qvalue}
        result = self._finish(losses, tensordict, weights).set("alpha", alpha)
        diagnostics = {"entropy": -log_prob.detach(), "td_error": td_error}
        return result.update(self._finish(diagnostics, tensordict, None))

    def _check_next_states(self, tensordict: TensorDictBase) -> None:
        """Raise ValueError if next states are several decisions later (``MultiStep``)."""
        steps = tensordict.get(STEPS, None)
        executed = tensordict.get(unravel_key(("next", self.tensor_keys.executed)), None)
        # A copy of the executed steps, which TorchRL's own losses need, says what this loss knows.
        copied = steps is not None and executed is not None and bool((steps == executed).all())
        if steps is not None and not copied and bool((steps > 1).any()):
            raise ValueError(
                f"{STEPS!r} says that next states are several decisions later, but nothing says how many "
                "control steps, nor whether an episode has ended there: leave MultiStep out"
            )

    def _qvalue_loss(self, tensordict: TensorDictBase, alpha: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            after = tensordict.get("next")
            state = after.select(*self._states(self.actor_network, self.decoder, self.qvalue_network))
            # The state after an end has no value, and some simulators write NaN there.
            state = rows_where(~after.get(self.tensor_keys.done).squeeze(-1), state, tensordict)
            delta, log_prob = self._act(state)
            state = self.decoder(state.set(keys.DELTA, delta))
            value = self._values(self._vmap_qvalue(state, self.target_qvalue_network_params)).amin(0)
            if self.backup_entropy:
                value = value - alpha * log_prob
            target = self._td_target(after, value)
        state = tensordict.select(*self._states(self.qvalue_network))
        state.set(keys.CHUNK, tensordict.get(self.tensor_keys.chunk))
        error = self._values(self._vmap_qvalue(state, self.qvalue_network_params)) - target
        return 0.5 * error.square().sum(0), error.detach().abs().amax(0)

    def distillation_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss of the noise critic against the action critic, at any states ``[N]``."""
        check_keys(tensordict, self._distillation_keys(), type(self).__name__)
        weights = self._maybe_get_priority_weight(tensordict)
        with torch.no_grad():
            state = tensordict.select(*self._distillation_keys())
            state = self.decoder(self.distillation(state))
            target = self._values(self._vmap_qvalue(state, self.qvalue_network_params))
        value = self._values(self._vmap_noise_qvalue(state, self.noise_qvalue_network_params))
        loss = 0.5 * (value - target).square().sum(0)
        return self._finish({"loss_qvalue_noise": loss}, tensordict, weights)

    def _td_target(self, after: TensorDictBase, value: Tensor) -> Tensor:
        k = self.tensor_keys
        estimator = self.value_estimator
        e = estimator.tensor_keys
        reward = after.get(k.reward)
        data = TensorDict({}, batch_size=after.batch_size)
        data.set(("next", e.reward), reward)
        for flag in (e.done, e.terminated):  # time-outs are terminations, as in the official implementation
            data.set(("next", flag), after.get(k.done))
        if self.discount == "step":
            data.set(e.steps_to_next_obs, after.get(k.executed))
        return estimator.value_estimate(data, next_value=value.view_as(reward)).squeeze(-1)

    def _act(self, state: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return a residual and its log-probability in units of the box."""
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
        check_keys(data, [key], "DSRLNALoss", ": a critic must write it (ValueOperator(..., out_keys=[...]))")
        values = data[key]
        check_shape(f"a critic's {key!r}", values, (*values.shape[:-1], 1))
        return values.squeeze(-1)

    def _finish(
        self, losses: dict[str, Tensor], tensordict: TensorDictBase, weights: Tensor | None
    ) -> TensorDict:
        if weights is not None and not weights.any():  # no row counts, and TorchRL would divide by 0
            losses, weights = {name: 0 * loss for name, loss in losses.items()}, None
        options: Any = {"tensordict": tensordict, "weights": weights}
        reduced = {name: self._reduce_loss(loss, **options) for name, loss in losses.items()}
        check_finite(reduced)
        return TensorDict(reduced, batch_size=[])


def _check_networks(
    actor: ProbabilisticTensorDictSequential, chunk_critic: Any, noise_critic: Any, decoder: PriorDecoder
) -> None:
    """Raise an error unless the networks read and write the decoder's keys."""
    if not isinstance(actor, ProbabilisticTensorDictSequential):
        raise TypeError(
            f"the actor must be the ProbabilisticActor alone, without a decoder behind it, got "
            f"{type(actor).__name__}"
        )
    written = [unravel_key(key) for key in actor.dist_sample_keys]
    if written != [keys.DELTA]:
        raise ValueError(f"the actor writes {written}, but the decoder reads {keys.DELTA}")
    spec = getattr(actor, "spec", None)
    box = None if spec is None or keys.DELTA not in spec.keys(True, True) else spec[keys.DELTA]
    high = getattr(box, "high", None)
    if high is not None and not torch.allclose(high, torch.full_like(high, decoder.delta)):
        raise ValueError(
            f"the actor's box has the half side {float(high.max())}, but the decoder's {decoder.delta}: "
            "build the actor with delta=decoder.delta"
        )
    for name, critic, key in (
        ("qvalue_network", chunk_critic, keys.CHUNK),
        ("noise_qvalue_network", noise_critic, keys.DELTA),
    ):
        critics = critic if isinstance(critic, list) else [critic]
        for module in critics:
            if key not in [unravel_key(k) for k in module.in_keys]:
                raise ValueError(f"{name} must read {key}, it reads {module.in_keys}")
