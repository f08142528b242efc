"""Behaviour cloning by flow matching from any source distribution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.objectives.common import LossModule

from warmprior import keys
from warmprior.checks import check_choice, check_keys, check_positions
from warmprior.history import history_keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.generator import Drawing
from warmprior.modules.interpolant import Interpolant, LinearInterpolant
from warmprior.modules.network import device_of, network_observation, velocity_field
from warmprior.objectives.couplings import Coupling
from warmprior.objectives.times import TIMES, Times
from warmprior.options.training import Objective, Weighting

FAR_OUTSIDE = 10.0
"""A size that no normalised action has; those of other demonstrations reach a little past 1."""


class FlowMatchingLoss(Drawing, LossModule):
    r"""The conditional flow-matching loss with the actor's own source (Algorithm 1, training).

    For each window it draws :math:`a_0` from the prior, pairs it with :math:`a_1`, draws :math:`t \sim U(0,
    1)`, sets :math:`a_t = \alpha(t) a_0 + \beta(t) a_1`, and regresses :math:`v_\theta(t, a_t, o)` on
    :math:`\dot\alpha a_0 + \dot\beta a_1`. Positions past the episode's end do not count.

    The L1 objective compares predicted samples instead of velocities (L1 Flow, Song et al., 2025,
    arXiv:2511.17898). With :math:`\hat a_1 = a_t + (1 - t) v` the error of a coordinate is

    .. math::
        |\hat a_1 - a_1| = (1 - t) \, |v_\theta(t, a_t, o) - (a_1 - a_0)|.

    The two-step sampler of L1 Flow is Euler's method with NFE 2.

    Args:
        actor_network: the policy whose velocity network is trained; its prior is the source.
        coupling: a function that pairs the sources and targets of a batch, see :data:`~warmprior.Coupling`;
            by default they are paired in order (Algorithm 1).
        times: the distribution of training times: ``"uniform"`` (Algorithm 1), ``"u-shaped"``,
            ``"start"`` (regression), or a function with the signature :data:`Times`;
            not with a coupling that has times of its own.
        objective: ``"velocity"`` (Algorithm 1) or ``"l1"``.
        weighting: ``"velocity"`` (Algorithm 1) leaves errors unchanged. ``"standardised"`` divides them by
            the standard deviation of the remainder (:meth:`PreconditionedNetwork.remainder`), so that all
            times, positions and dimensions have equal weight, as in EDM (Karras et al., 2022, Table 1); it is
            the default for a :class:`PreconditionedNetwork`. For a standard normal source and data of
            standard deviation :math:`s`, ``"velocity"`` weights errors at ``t = 0``, where one-step samplers
            evaluate, by :math:`s^2` relative to ``t = 1``.
        interpolant: the path; by default that of the coupling or the
            :class:`~warmprior.PreconditionedNetwork` if they have one, else linear.
        reduction: ``"sum"`` (Algorithm 1), ``"mean"`` (that sum divided by the number of unpadded
            coordinates, or by their total weight) or ``"none"`` (``[*B, P, d_a]``, zero where padded).
        generator: draws ``t`` and :math:`a_0`; by default that of the actor's sampler.

    .. note::
        The loss reads ``chunk`` ``[*B, P, d_a]``, ``history`` (:mod:`warmprior.history`), ``observation``
        ``[*B, To, d_o]`` and, if present, ``pad_mask`` bool ``[*B, P]``, TorchRL's ``priority_weight``
        ``[*B]`` and the masks of its ``loss_mask_key``, such as ``("collector", "mask")`` of padded
        trajectories. By default these are the keys of :class:`~warmprior.ActionWindow`, with the policy's
        observation key; :meth:`set_keys` renames them. Batches are moved to the network's device,
        where the generator must be too.

    Raises:
        ValueError: if an option is unknown, or does not fit another option, the network or the policy; when
            called, if targets are in raw units although the policy has a normaliser.

    See Also:
        :class:`~warmprior.training.BehaviourCloning`: the training loop around this loss.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import FlowMatchingLoss, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior import window_replay_buffer
        >>> data = TensorDict({"observation": torch.randn(100, 3), "action": torch.randn(100, 2),
        ...                    "episode": torch.arange(100) // 25}, [100])
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, prediction_length=8), PastPrior(8))
        >>> batch = window_replay_buffer(data, actor.prior, batch_size=16).sample()
        >>> FlowMatchingLoss(actor)(batch)["loss_flow_matching"].backward()
        >>> bool(FlowMatchingLoss(actor, times="u-shaped", objective="l1")(batch)["loss_flow_matching"] > 0)
        True
    """

    @dataclass
    class _AcceptedKeys:
        """The configurable tensordict keys, see the class docstring."""

        chunk: NestedKey = keys.CHUNK
        pad_mask: NestedKey = keys.IS_PAD
        history: NestedKey = keys.HISTORY
        observation: NestedKey = keys.OBSERVATION
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: WarmPriorActor
    out_keys: ClassVar[list[NestedKey]] = ["loss_flow_matching"]

    def __init__(
        self,
        actor_network: WarmPriorActor,
        *,
        coupling: Coupling | None = None,
        times: str | Times = "uniform",
        objective: Objective = "velocity",
        weighting: Weighting | None = None,
        interpolant: Interpolant | None = None,
        reduction: str = "mean",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        check_choice("objective", objective, get_args(Objective))
        check_choice("reduction", reduction, ("none", "mean", "sum"))
        if not callable(times):
            check_choice("times", times, TIMES)
        network, sampling = actor_network.network, actor_network.sampling
        # A functional copy of the network would turn Ctrl-C into another error, and exclude DDP.
        self.actor_network = actor_network
        self.coupling, self.objective, self.reduction = coupling, objective, reduction
        own = getattr(coupling, "times", None)  # a coupling may come with times, and a path, of its own
        if own is not None and times != "uniform":
            raise ValueError(f"{type(coupling).__name__} has its own times: leave out times={times!r}")
        self.times = own or (times if callable(times) else TIMES[times])
        if times == "start" and (sampling.max_nfe != 1 or actor_network.ode.start_time > 0):
            raise ValueError(
                "times = 'start' trains the field at t = 0 alone: build the policy with max_nfe=1, and "
                f"without a start point (it has {sampling.max_nfe} and {actor_network.start})"
            )
        standardises = hasattr(network, "remainder")
        self.weighting = weighting or ("standardised" if standardises else "velocity")
        check_choice("weighting", self.weighting, get_args(Weighting))
        if self.weighting == "standardised" and not standardises:
            raise ValueError("the weighting 'standardised' needs a PreconditionedNetwork, or take 'velocity'")
        built_for = getattr(network, "interpolant", None)
        self.interpolant = interpolant or getattr(coupling, "interpolant", built_for) or LinearInterpolant()
        if built_for is not None and built_for.config() != self.interpolant.config():
            raise ValueError(
                f"the network is preconditioned for the path {built_for.config()}, but the loss has "
                f"{self.interpolant.config()}: give both the same interpolant"
            )
        straight = isinstance(self.interpolant, LinearInterpolant)
        if not straight and (times == "start" or objective == "l1"):
            raise ValueError(
                "a velocity predicts the sample only on a straight path: use LinearInterpolant, not "
                f"{type(self.interpolant).__name__}"
            )
        self.generator = actor_network.sampler.chosen_generator(generator)
        self._looked_at = False
        self.set_keys(observation=actor_network.observation_key)

    def _set_in_keys(self) -> None:
        """Set ``in_keys``, when TorchRL calls it from :meth:`set_keys`."""
        k = self.tensor_keys
        self.in_keys = [k.observation, k.chunk, k.pad_mask, *history_keys(k.history)]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss of a batch of windows; raise KeyError if a needed key is missing."""
        k, actor, generator = self.tensor_keys, self.actor_network, self.chosen_generator()
        needed = (k.chunk, k.history, k.observation)
        check_keys(tensordict, needed, type(self).__name__, ". Take batches of window_replay_buffer")
        device = device_of(actor.network, tensordict.get(k.chunk))
        a1, history, observation = (_moved(tensordict.get(key), device) for key in needed)
        check_positions(k.chunk, a1, actor.prior)
        if not (self._looked_at or a1.is_meta or torch.compiler.is_compiling()):  # a number is read
            self._check_normalised(a1)
        a1 = a1 if a1.is_floating_point() else a1.to(torch.get_default_dtype())
        weight, masked = self._weight(tensordict, a1)
        if weight is not None:
            # Masked windows and padded targets may be NaN, and would make all gradients NaN.
            unused = weight == 0
            a1 = _blanked(a1, unused)
            if masked:
                history, observation = (_blanked(part, unused.all(-1)) for part in (history, observation))
        a0 = actor.prior.distribution(history, observation).sample(generator)
        if self.coupling is not None:
            a0, a1 = self.coupling(a0, a1, observation)
        t = self.times(a1.shape[:-2], generator, a1.dtype, a1.device)
        a_t, velocity = self.interpolant(a0, a1, t, generator)
        field = velocity_field(actor.network, network_observation(observation, a1.shape[:-2]))
        predicted = field(t.reshape(-1), a_t.reshape(-1, *a1.shape[-2:])).reshape(a1.shape)
        loss = self._reduced(self._error(predicted, velocity, t), weight)
        return TensorDict({self.out_keys[0]: loss}, batch_size=[])

    def _check_normalised(self, a1: Tensor) -> None:
        """Raise ValueError if the first batch is in raw units, but the policy has a normaliser."""
        self._looked_at = True
        actor = self.actor_network
        largest = float(a1.nan_to_num(0.0, 0.0, 0.0).abs().max()) if a1.numel() else 0.0
        # A policy is clipped to the range of its demonstrations, which some units leave larger than 1.
        clip = actor.sampling.clip
        bound = max(1.0, max(clip) if isinstance(clip, Sequence) else clip or 1.0)
        if actor.normalizer is not None and largest > FAR_OUTSIDE * bound:
            raise ValueError(
                f"the targets {self.tensor_keys.chunk!r} reach {largest:.4g}, but the policy's normaliser "
                f"maps actions to +-{bound:.4g}: make the windows from policy.normalizer.normalize(data)"
            )

    def _weight(self, tensordict: TensorDictBase, a1: Tensor) -> tuple[Tensor | None, bool]:
        """Return the positions' weights ``[*B, P]``, ``None`` if all are equal, and if windows are masked."""
        pad, weight = tensordict.get(self.tensor_keys.pad_mask, None), None
        masks = [mask for key in self._loss_mask_keys() if (mask := tensordict.get(key, None)) is not None]
        inside = None if pad is None else pad.logical_not()
        for factor in (inside, self._maybe_get_priority_weight(tensordict), *masks):
            if factor is not None:
                # A factor weights windows `[*B]` or `[*B, 1]`, or positions `[*B, P]`.
                factor = factor.to(a1).reshape(*factor.shape, *(1,) * (a1.ndim - 1 - factor.ndim))
                weight = factor if weight is None else weight * factor
        return None if weight is None else weight.expand(a1.shape[:-1]), bool(masks)

    def _error(self, predicted: Tensor, velocity: Tensor, t: Tensor) -> Tensor:
        """Return the objective's error ``[*B, P, d_a]`` of velocities predicted at times ``t`` ``[*B]``."""
        error = predicted - velocity
        if self.weighting == "standardised":
            unit = cast(Any, self.actor_network.network).remainder(t.reshape(-1))
            error = error / unit.view_as(error)
        return (1 - t)[..., None, None] * error.abs() if self.objective == "l1" else error.square()

    def _reduced(self, error: Tensor, weight: Tensor | None) -> Tensor:
        """Reduce errors ``[*B, P, d_a]`` with weights ``[*B, P]``."""
        count: Tensor | int = max(1, error.numel())
        if weight is not None:
            # Errors without weight may be infinite. If no error has weight, the mean is 0.
            error = torch.where(weight.unsqueeze(-1) == 0, 0.0, error * weight.unsqueeze(-1))
            total = weight.sum() * error.shape[-1]
            count = torch.where(total > 0, total, 1.0)
        if self.reduction == "none":
            return error
        return error.sum() / count if self.reduction == "mean" else error.sum()


def _moved[T: Tensor | TensorDictBase](value: T, device: torch.device) -> T:
    """Return a value on a device; a tensordict that lies there as it is, for its own move takes longer."""
    if isinstance(value, TensorDictBase) and all(v.device == device for v in value.values(True, True)):
        return value
    return cast(T, value.to(device))


def _blanked[T: Tensor | TensorDictBase](value: T, unused: Tensor) -> T:
    """Return a value with 0 in place of NaN and infinity in unused rows ``[*B]`` or positions ``[*B, P]``."""
    if isinstance(value, TensorDictBase):
        return cast(T, value.apply(lambda entry: _blanked(entry, unused)))
    if not value.is_floating_point():
        return value
    return cast(T, torch.where(expand_as_right(unused, value), value.nan_to_num(0.0, 0.0, 0.0), value))
