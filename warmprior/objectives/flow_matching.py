"""Behaviour cloning by flow matching from any source distribution."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.checks import check_keys, check_positions
from warmprior.modules.network import network_observation, velocity_field
from warmprior.modules.ode import Interpolant, LinearInterpolant, integrate
from warmprior.objectives.couplings import Coupling

Times = Callable[[torch.Size, torch.Generator | None, torch.dtype, torch.device], Tensor]
"""Draws times in [0, 1]: ``(shape, generator, dtype, device) -> [*shape]``."""

TimesName = Literal["uniform", "u-shaped", "logit-normal", "start"]

STEEPNESS = 4.0
"""``a`` of :func:`u_shaped_times`: the ends are 3.8 times as dense as the middle."""


def uniform_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """All times alike, as in Algorithm 1."""
    return torch.rand(shape, generator=generator, dtype=dtype, device=device)


def u_shaped_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    r"""More often near both ends.

    The density is :math:`p(t) \propto e^{at} + e^{a(1-t)}` with :math:`a = 4` (Lee et al., 2024, "Improving
    the training of rectified flows"). Their text has :math:`e^{-at}` as the second term, which is no U on [0,
    1]; this is what their code draws from, by the inverse of

    .. math::
        F(t) = \frac12 + \frac{\sinh(a(t - \frac12))}{2 \sinh\frac a2}.
    """
    u = torch.rand(shape, generator=generator, dtype=dtype, device=device)
    t = 0.5 + torch.asinh((2 * u - 1) * math.sinh(STEEPNESS / 2)) / STEEPNESS
    return t.clamp(0.0, 1.0)  # rounding may leave the interval


def logit_normal_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    r"""More often in the middle: :math:`\log\frac t{1-t} \sim N(0, 1)` (Esser et al., 2024)."""
    return torch.randn(shape, generator=generator, dtype=dtype, device=device).sigmoid()


def start_times(
    shape: torch.Size, generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> Tensor:
    r"""``t = 0`` alone: the network regresses :math:`a_1 - a_0`, and one step of Euler's method returns it.

    The field is not trained at any other time: build the policy with ``max_nfe=1``.
    """
    return torch.zeros(shape, dtype=dtype, device=device)


TIMES: dict[str, Times] = {
    "uniform": uniform_times,
    "u-shaped": u_shaped_times,
    "logit-normal": logit_normal_times,
    "start": start_times,
}
"""Those that have a name."""


Objective = Literal["velocity", "l1"]

Weighting = Literal["velocity", "standardised"]

TEACHER_STEPS = 9
"""Euler steps, as in the paper, that self-distillation learns to make in one."""

DISTILLED_SHARE = 0.25
"""Share of a batch, as in shortcut models: each of these windows costs nine more forward passes."""


def check_objective(*, times: str, objective: str, weighting: str | None, self_distillation: float) -> None:
    """A ``ValueError`` names the option if :class:`FlowMatchingLoss` has no such loss."""
    choices = {
        "times": (times, TIMES),
        "objective": (objective, get_args(Objective)),
        "weighting": (weighting, (None, *get_args(Weighting))),
    }
    for name, (value, known) in choices.items():
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(filter(None, known))}, got {value!r}")
    if not (self_distillation >= 0 and math.isfinite(self_distillation)):
        raise ValueError(f"self_distillation must be a finite weight >= 0, got {self_distillation}")
    needs = {"objective": objective != "velocity" and objective, "self_distillation": self_distillation}
    for name, asked in needs.items():
        if asked and times == "start":
            raise ValueError(
                f"{name} = {asked} needs a flow, and times = 'start' trains none: leave one of them out"
            )


class FlowMatchingLoss(LossModule):
    r"""Conditional flow matching with the actor's own source (Algorithm 1, training).

    For each window: draw :math:`a_0` from the prior, pair it with :math:`a_1`, draw :math:`t \sim U(0, 1)`,
    set :math:`a_t = \alpha(t) a_0 + \beta(t) a_1`, and regress :math:`v_\theta(t, a_t, o)` on
    :math:`\dot\alpha a_0 + \dot\beta a_1`. Positions past the episode's end do not count. Two options for few
    integration steps work with any prior, and need the straight path:

    **The L1 objective** compares predicted samples instead of velocities (L1 Flow, Song et al., 2025,
    arXiv:2511.17898). With :math:`\hat a_1 = a_t + (1 - t) v` a coordinate costs

    .. math::
        |\hat a_1 - a_1| = (1 - t) \, |v_\theta(t, a_t, o) - (a_1 - a_0)|,

    and their two-step sampler is Euler's method with NFE 2.

    **Self-distillation** trains the sampler of one step, :math:`v_\theta(s, a_s, o)` at the time :math:`s` at
    which the policy's samplers start, on where the flow of averaged weights :math:`\bar\theta` ends,

    .. math::
        \left\| v_\theta(s, a_s, o) - \frac{\hat a_1 - a_s}{1 - s} \right\|^2, \qquad
        \hat a_1 = \Phi^{\bar\theta}_{s + h \to 1}(a_{s + h}), \qquad h = \frac{1 - s}{9},

    where :math:`\Phi` is the flow by Euler's method with steps of :math:`h`, and :math:`a_{s+h}` lies on the
    data's own path; at all other times the network stays a flow. The idea is the self-consistency of One-Step
    Flow Policy (Li et al., 2026, arXiv:2603.12480), but only the whole interval is learnt, the teacher
    crosses it in steps (progressive distillation), and there is no self-guidance. A quarter of the batch is
    distilled, as in shortcut models (Frans et al., 2025); a training step takes about twice the time.

    Args:
        actor_network: the policy whose velocity network is trained; its prior gives the source.
        coupling: pairs the sources and targets of a batch, see :data:`~warmprior.objectives.Coupling`; in
            their order by default (Algorithm 1).
        times: how training times are distributed: ``"uniform"`` (Algorithm 1), ``"u-shaped"``,
            ``"logit-normal"``, ``"start"`` (regression), or a function of their signature (:data:`Times`).
        objective: ``"velocity"`` (Algorithm 1) or ``"l1"``.
        weighting: ``"velocity"`` (Algorithm 1) takes errors as they are. ``"standardised"`` divides them by
            the standard deviation of the remainder (:meth:`PreconditionedNetwork.remainder`), so that every
            time, position and dimension counts alike, as in EDM (Karras et al., 2022, Table 1); the default
            for a :class:`PreconditionedNetwork`. Without it, with a standard normal source and data of
            deviation :math:`s`, errors at ``t = 0``, where one-step samplers are, count :math:`s^2` times
            those at ``t = 1``.
        self_distillation: weight of the self-distillation; 0 turns it off.
        teacher: the network of averaged weights that self-distillation learns from; by default the trained
            network itself. It is neither trained nor saved with the loss.
        interpolant: the path; by default that of the :class:`~warmprior.PreconditionedNetwork`, or the line.
        reduction: ``"mean"`` over unpadded coordinates (Algorithm 1 divided by their number), ``"sum"``
            (Algorithm 1's) or ``"none"`` (``[*B, P, d_a]``, zero where padded).
        generator: source of randomness of ``t`` and :math:`a_0`; the actor sampler's by default.

    .. note::
        Keys read (renameable by :meth:`set_keys`): ``chunk`` ``[*B, P, d_a]``, ``pad_mask`` bool ``[*B, P]``
        (optional), the ``history`` (:mod:`warmprior.history`) and ``observation`` ``[*B, To, d_o]``. Batches
        are moved to the network's device, where the generator has to be.

    Raises:
        ValueError: for an unknown option, or options that do not fit each other, the network or the policy.

    See Also:
        :class:`~warmprior.training.BehaviourCloning`: the training loop around it.

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
        >>> sorted(FlowMatchingLoss(actor, times="u-shaped", self_distillation=1.0)(batch).keys())
        ['loss_flow_matching', 'loss_self_distillation']
    """

    @dataclass
    class _AcceptedKeys:
        """Configurable tensordict keys, see the class docstring."""

        chunk: NestedKey = keys.CHUNK
        pad_mask: NestedKey = keys.IS_PAD
        history: NestedKey = keys.HISTORY
        observation: NestedKey = keys.OBSERVATION

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    velocity_network: nn.Module
    velocity_network_params: TensorDictParams
    target_velocity_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: WarmPriorActor,
        *,
        coupling: Coupling | None = None,
        times: str | Times = "uniform",
        objective: Objective = "velocity",
        weighting: Weighting | None = None,
        self_distillation: float = 0.0,
        teacher: nn.Module | None = None,
        interpolant: Interpolant | None = None,
        reduction: str = "mean",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        self.reduction = reduction
        self.convert_to_functional(actor_network.network, "velocity_network")
        self.prior, self.coupling = actor_network.prior, coupling
        self.start_time = actor_network.ode.start_time
        check_objective(
            times="uniform" if callable(times) else times,
            objective=objective,
            weighting=weighting,
            self_distillation=self_distillation,
        )
        if times == "start" and self.start_time > 0:
            raise ValueError(
                "times = 'start' trains the field at t = 0 alone, but the policy starts at "
                f"{self.start_time}: leave one of them out"
            )
        if times == "start" and actor_network.ode.max_nfe != 1:
            raise ValueError(
                "times = 'start' trains the field at t = 0 alone: build the policy with max_nfe=1"
            )
        standardises = hasattr(actor_network.network, "remainder")
        if weighting is None:
            weighting = "standardised" if standardises else "velocity"
        if weighting == "standardised" and not standardises:
            raise ValueError(
                "standardised errors are in the units of a PreconditionedNetwork: wrap the network in one, "
                "or take the weighting 'velocity'"
            )
        self.times = times if callable(times) else TIMES[times]
        self.objective, self.weighting = objective, weighting
        self.self_distillation = float(self_distillation)
        self.__dict__["teacher"] = teacher  # not part of this module: its owner saves it
        built_for = getattr(actor_network.network, "interpolant", None)
        # A coupling may come with a path of its own.
        interpolant = interpolant or getattr(coupling, "interpolant", None)
        if interpolant is None:
            interpolant = LinearInterpolant() if built_for is None else built_for
        elif built_for is not None and built_for.config() != interpolant.config():
            raise ValueError(
                f"the network is preconditioned for the path {built_for.config()}, but the loss is given "
                f"{interpolant.config()}: give both the same interpolant"
            )
        self.interpolant = interpolant
        if not isinstance(self.interpolant, LinearInterpolant):
            straight = f"only on a straight path: use LinearInterpolant, not {type(interpolant).__name__}"
            if times == "start":
                raise ValueError(f"one step from t = 0 ends at the data {straight}")
            if objective != "velocity" or self_distillation:
                raise ValueError(f"a velocity predicts the sample {straight}")
        self.generator = actor_network.sampler.generator if generator is None else generator
        self.out_keys = ["loss_flow_matching"]
        if self_distillation:
            self.out_keys.append("loss_self_distillation")
        self.set_keys(observation=actor_network.in_keys[0])

    def _set_in_keys(self) -> None:
        """TorchRL calls it from :meth:`set_keys`."""
        k = self.tensor_keys
        self.in_keys = [k.observation, k.chunk, k.pad_mask, k.history]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Of a batch of windows ``"loss_flow_matching"`` and, weighted, ``"loss_self_distillation"``.

        Unreduced, the latter is of the distilled windows, ``[n, P, d_a]``. A ``KeyError`` if a needed key is
        missing.
        """
        k = self.tensor_keys
        needed = (k.chunk, k.history, k.observation)
        check_keys(tensordict, needed, "FlowMatchingLoss", ". Take batches of window_replay_buffer")
        device = next(iter(self.velocity_network_params.values(True, True)), tensordict.get(k.chunk)).device
        a1, history, observation = (tensordict.get(key).to(device) for key in needed)
        check_positions(k.chunk, a1, self.prior)
        batch = a1.shape[:-2]
        a0 = self.prior.sample(history, observation, self.generator)
        if self.coupling is not None:
            a0, a1 = self.coupling(a0, a1, observation)
        t = self.times(batch, self.generator, a1.dtype, a1.device)
        observation = network_observation(observation, batch)
        pad = tensordict.get(k.pad_mask, None)
        if pad is not None:
            pad = pad.to(device)
        distilled = max(1, round(DISTILLED_SHARE * batch.numel()))
        errors: list[Tensor] = []
        interrupt: KeyboardInterrupt | None = None
        with self.velocity_network_params.to_module(self.velocity_network, preserve_module_state=False):
            try:
                errors.append(self._velocity_error(a0, a1, t, observation))
                if self.self_distillation:
                    errors.append(self._jump_error(a0, a1, observation, distilled))
            except KeyboardInterrupt as key:
                interrupt = key  # inside the context it would become a RuntimeError
        if interrupt is not None:
            raise interrupt
        losses = [self._reduced(errors[0], pad)]
        for error in errors[1:]:
            part = None if pad is None else pad.reshape(-1, pad.shape[-1])[:distilled]
            losses.append(self.self_distillation * self._reduced(error, part))
        return TensorDict(dict(zip(self.out_keys, losses, strict=True)), batch_size=[])

    def _velocity_error(
        self, a0: Tensor, a1: Tensor, t: Tensor, observation: Tensor | TensorDictBase
    ) -> Tensor:
        """Error at times ``t`` ``[*B]`` of the path, ``[*B, P, d_a]``."""
        a_t, velocity = self.interpolant(a0, a1, t, self.generator)
        field = velocity_field(self.velocity_network, observation)
        predicted = field(t.reshape(-1), a_t.reshape(-1, *a1.shape[-2:]))
        return self._distance(predicted.reshape(a1.shape), velocity, t)

    def _jump_error(self, a0: Tensor, a1: Tensor, observation: Tensor | TensorDictBase, n: int) -> Tensor:
        """Error of one step from start to end, for the first windows, ``[n, P, d_a]``."""
        a0, a1 = (a.detach().reshape(-1, *a.shape[-2:])[:n] for a in (a0, a1))
        observation = observation[:n]
        begin = self.start_time
        near = begin + (1.0 - begin) / TEACHER_STEPS
        start, _ = self.interpolant(a0, a1, a0.new_full((n,), begin))
        with torch.no_grad():
            point, _ = self.interpolant(a0, a1, a0.new_full((n,), near))
            teacher = self.velocity_network if self.teacher is None else self.teacher
            end = integrate(
                velocity_field(teacher, observation), point, nfe=TEACHER_STEPS - 1, start_time=near
            )
        t = a0.new_full((n,), begin)
        jump = velocity_field(self.velocity_network, observation)(t, start)
        return self._distance(jump, (end - start) / (1.0 - begin), t)

    def _distance(self, predicted: Tensor, velocity: Tensor, t: Tensor) -> Tensor:
        """The objective's error of predicted velocities at times ``t`` ``[*B]``, ``[*B, P, d_a]``."""
        error = predicted - velocity
        if self.weighting == "standardised":
            unit = cast(Any, self.velocity_network).remainder(t.reshape(-1))
            error = error / unit.view_as(error)
        return (1 - t)[..., None, None] * error.abs() if self.objective == "l1" else error.square()

    def _reduced(self, error: Tensor, pad: Tensor | None) -> Tensor:
        """Errors ``[*B, P, d_a]`` where they count."""
        count: Tensor | int = max(1, error.numel())
        if pad is not None:
            error = error.masked_fill(pad.unsqueeze(-1), 0.0)
            # At least 1, so that padding alone gives 0 and not NaN.
            count = ((~pad).sum() * error.shape[-1]).clamp_min(1)
        if self.reduction == "none":
            return error
        return error.sum() / count if self.reduction == "mean" else error.sum()
