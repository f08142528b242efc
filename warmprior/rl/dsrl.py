"""DSRL-NA: reinforcement learning in source space with a critic of executed chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.utils import _vmap_func

from warmprior import keys
from warmprior.rl.decoder import PriorDecoder
from warmprior.rl.loss import PriorSpaceLoss, check_counts, check_networks
from warmprior.rl.residual import ResidualDistribution, ResidualSampler

__all__ = ["DSRLNALoss"]

type Critics = TensorDictModule | list[TensorDictModule]


class DSRLNALoss(PriorSpaceLoss):
    r"""Noise-aliased DSRL (`Wagenmaker et al. 2025 <https://arxiv.org/abs/2506.15799>`_), around any anchor.

    Many sources decode to the same chunk, so what a transition teaches is learned about the *chunk*: an
    action critic :math:`Q^A(s, a)` by temporal differences on executed chunks. A noise critic
    :math:`Q^W(s, \Delta)` is distilled from it through the frozen decoder :math:`D`, and the actor climbs
    that one, without gradients through the decoder:

    .. math::
        y &= r + \gamma^k (1 - d) \Big[\min_i \bar Q^A_i(s', D(s', \Delta'))
            - \alpha \log \pi(\Delta' | s')\Big], \quad \Delta' \sim \pi(\cdot | s') \\
        L_{Q^A} &= \tfrac12 \sum_i \big(Q^A_i(s, a) - y\big)^2, \qquad
        L_{Q^W} = \tfrac12 \sum_i \big(Q^W_i(s, \Delta) - Q^A_i(s, D(s, \Delta))\big)^2,
            \quad \Delta \sim q \\
        L_\pi &= \alpha \log \pi(\Delta | s) - \min_i Q^W_i(s, \Delta), \qquad
        L_\alpha = -\log \alpha \, (\log \pi + \mathcal{H})

    with stopped gradients where SAC has them; batch means throughout. Log-probabilities count in units of the
    box, :math:`\Delta / \delta \in [-1, 1]`, as in the official implementation, so that entropies do not
    depend on :math:`\delta`. The defaults are the official ones but for the discount. The official schedule
    takes several updates per step and then distils on batches of its own:

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

    One optimiser does for all: Adam passes over parameters without gradient.

    Args:
        actor_network: the policy over residuals, see :func:`~warmprior.make_prior_space_actor`.
        qvalue_network: :math:`Q^A`, which reads ``decoder.chunk_key`` (all ``P`` actions, or its targets
            would not be Markov for WP-Preview; for what else see
            :func:`~warmprior.make_prior_space_critic`); one module, initialised ``num_qvalue_nets`` times
            anew, or a list.
        noise_qvalue_network: :math:`Q^W`, which reads ``decoder.delta_key``; the same.
        decoder: the frozen policy. It is not among the loss's submodules: ``parameters()``,
            ``state_dict()`` and target updates never see it; ``loss.to(device)`` moves it along.

    Keyword Args:
        num_qvalue_nets: critics of each kind.
        backup: how critics are combined, in targets and in the actor's loss: ``"min"`` or ``"mean"``.
        backup_entropy: whether targets hold the entropy term.
        bootstrap_timeouts: whether the value after a time-out counts. The official implementation takes
            time-outs for terminations.
        discount: ``"step"`` discounts by :math:`\gamma^k` for ``k`` executed control steps, with the
            ``gamma`` given to :class:`~warmprior.ChunkStep`; ``"decision"`` by :math:`\gamma`
            whatever ``k``, as the official implementation does (with undiscounted rewards inside chunks).
        noise_critic_steps: distillation steps per round of :meth:`schedule`.
        distillation: :math:`q`, see :class:`~warmprior.ResidualSampler`. By default ``"normal"`` around
            zero, the official one, and ``"clipped"`` around a mean.
        distillation_sigma: scale of the first two; the prior's own by default.
        alpha_init: initial temperature.
        fixed_alpha: do not train it.
        target_entropy: :math:`\mathcal{H}`, of the residual in units of the box.
        deactivate_vmap: evaluate the critics one after the other.
        generator: source of randomness of the distillation; the actor uses PyTorch's global one.

    .. note::
        Keys (renameable by :meth:`set_keys`): ``chunk``, the decoded chunk of the transition (set it to
        ``("next", "decoded", "chunk")`` for data from :class:`~warmprior.PriorSpace`); under ``"next"``
        ``reward``, ``done``, ``terminated`` and ``executed``; ``priority``, where the TD error of each
        row is written; ``priority_weight``; ``state_action_value``, the critics' output. Beyond them the
        networks' and the decoder's ``in_keys``, at the root and under ``"next"``. The residual that led to
        the chunk is not needed.

    Raises:
        TypeError: if the actor gives no distribution.
        ValueError: for an unknown option or a network that does not fit the decoder; (when called) if a
            critic gives several values.
        KeyError: (when called) if the batch lacks a key.
        FloatingPointError: (when called) if a loss is NaN or infinite, naming it.

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
        """Configurable tensordict keys, see the class docstring."""

        chunk: NestedKey = keys.CHUNK
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        executed: NestedKey = keys.EXECUTED
        state_action_value: NestedKey = "state_action_value"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    _results = ("loss_actor", "loss_alpha", "loss_qvalue", "loss_qvalue_noise")
    _diagnostics = ("alpha", "entropy", "td_error")
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
        num_qvalue_nets: int = 2,
        backup: Literal["min", "mean"] = "min",
        backup_entropy: bool = True,
        bootstrap_timeouts: bool = False,
        discount: Literal["step", "decision"] = "step",
        noise_critic_steps: int = 10,
        distillation: ResidualDistribution | None = None,
        distillation_sigma: float | None = None,
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float = 0.0,
        deactivate_vmap: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(
            decoder, backup=backup, bootstrap_timeouts=bootstrap_timeouts, discount=discount
        )
        check_counts(num_qvalue_nets=num_qvalue_nets, noise_critic_steps=noise_critic_steps)
        check_networks(actor_network, qvalue_network, noise_qvalue_network, decoder)
        self.backup_entropy = backup_entropy
        self.noise_critic_steps = noise_critic_steps
        self.deactivate_vmap = deactivate_vmap
        self.distillation = ResidualSampler(
            decoder, distribution=distillation, sigma=distillation_sigma, generator=generator
        )
        self.convert_to_functional(actor_network, "actor_network")
        self.convert_to_functional(
            qvalue_network, "qvalue_network", num_qvalue_nets, create_target_params=True
        )
        self.convert_to_functional(noise_qvalue_network, "noise_qvalue_network", num_qvalue_nets)
        self._register_temperature(alpha_init, fixed_alpha, target_entropy)
        self._make_vmap()

    def _make_vmap(self) -> None:
        options = {"randomness": self.vmap_randomness, "pseudo_vmap": self.deactivate_vmap}
        self._vmap_qvalue = _vmap_func(self.qvalue_network, (None, 0), **options)
        self._vmap_noise_qvalue = _vmap_func(self.noise_qvalue_network, (None, 0), **options)

    def _reinforcement_keys(self) -> list[NestedKey]:
        k = self.tensor_keys
        after = self._states(self.actor_network, self.decoder, self.qvalue_network)
        after += [k.reward, k.done, k.terminated, *[k.executed] * (self.discount == "step")]
        before = self._states(self.actor_network, self.qvalue_network, self.noise_qvalue_network)
        return [*before, k.chunk, *(unravel_key(("next", key)) for key in after)]

    def _distillation_keys(self) -> list[NestedKey]:
        return self._states(self.decoder, self.qvalue_network, self.noise_qvalue_network)

    def _needed_keys(self) -> list[NestedKey]:
        return [*self._reinforcement_keys(), *self._distillation_keys()]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All four losses on one batch.

        Args:
            tensordict: transitions ``[N]``, see the class docstring.

        Returns:
            TensorDict of scalars: ``loss_actor``, ``loss_alpha``, ``loss_qvalue`` and
            ``loss_qvalue_noise``, and detached ``alpha``, ``entropy`` (units of the box) and ``td_error``.
        """
        return self.reinforcement_loss(tensordict).update(self.distillation_loss(tensordict))

    def schedule(self, updates: int) -> Iterator[Callable[[TensorDictBase], TensorDict]]:
        """The official order: ``updates`` times the first three losses, then the distillation.

        Args:
            updates: the official ``utd``: updates per vector step, 20 for four environments.

        Returns:
            The methods to call, each on a batch of its own.

        Raises:
            ValueError: if ``updates < 1``.
        """
        check_counts(updates=updates)
        return iter(
            [self.reinforcement_loss] * updates + [self.distillation_loss] * self.noise_critic_steps
        )

    def reinforcement_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses of the actor, the temperature and the action critic, and the diagnostics.

        Args:
            tensordict: transitions ``[N]``, see the class docstring. The TD errors are written to it.
        """
        self._check_keys(tensordict, self._reinforcement_keys())
        weights = self._maybe_get_priority_weight(tensordict)
        alpha = self.log_alpha.exp().detach()
        loss_qvalue, td_error = self._qvalue_loss(tensordict, alpha)
        tensordict.set(self.tensor_keys.priority, td_error)

        state = tensordict.select(*self._states(self.actor_network, self.noise_qvalue_network))
        delta, log_prob = self._act(state)
        # Gradients reach the residual, not the critic.
        frozen = self.noise_qvalue_network_params.detach()
        value = self._vmap_noise_qvalue(state.set(self.decoder.delta_key, delta), frozen)
        loss_actor = alpha * log_prob - self._combine(value)
        loss_alpha = -self.log_alpha * (log_prob.detach() + self.target_entropy)
        losses = {"loss_actor": loss_actor, "loss_alpha": loss_alpha, "loss_qvalue": loss_qvalue}
        diagnostics = {
            "alpha": alpha,
            "entropy": -log_prob.detach().mean(),
            "td_error": td_error.mean(),
        }
        return self._finish(losses, tensordict, weights).update(diagnostics)

    def _qvalue_loss(self, tensordict: TensorDictBase, alpha: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            after = tensordict.get("next")
            state = after.select(
                *self._states(self.actor_network, self.decoder, self.qvalue_network)
            )
            delta, log_prob = self._act(state)
            state = self.decoder(state.set(self.decoder.delta_key, delta))
            value = self._combine(self._vmap_qvalue(state, self.target_qvalue_network_params))
            if self.backup_entropy:
                value = value - alpha * log_prob
            target = self._td_target(after, value)
        state = tensordict.select(*self._states(self.qvalue_network))
        state.set(self.decoder.chunk_key, tensordict.get(self.tensor_keys.chunk))
        error = self._values(self._vmap_qvalue(state, self.qvalue_network_params)) - target
        return 0.5 * error.square().sum(0), error.detach().abs().amax(0)

    def distillation_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of the noise critic: head by head, the action critic's values of decoded residuals.

        Args:
            tensordict: any states ``[N]``; actions, rewards and next states are not read.
        """
        self._check_keys(tensordict, self._distillation_keys())
        weights = self._maybe_get_priority_weight(tensordict)
        with torch.no_grad():
            state = tensordict.select(*self._distillation_keys())
            state = self.decoder(self.distillation(state))
            target = self._values(self._vmap_qvalue(state, self.qvalue_network_params))
        value = self._values(self._vmap_noise_qvalue(state, self.noise_qvalue_network_params))
        loss = 0.5 * (value - target).square().sum(0)
        return self._finish({"loss_qvalue_noise": loss}, tensordict, weights)
