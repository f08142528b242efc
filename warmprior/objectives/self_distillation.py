"""Self-distillation: one integration step that ends where the whole flow does."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import nn

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import velocity_field
from warmprior.modules.ode import integrate
from warmprior.objectives.flow_matching import FlowMatchingLoss, check_straight

TEACHER_STEPS = 9
"""The number of Euler steps, as in the paper, that one step learns to replace."""

SHARE = 0.25
"""The distilled share of a batch, as in shortcut models: each of these windows costs nine forward passes."""


class SelfDistillationLoss(FlowMatchingLoss):
    r"""A loss that trains one integration step to end where the flow of averaged weights ends.

    With averaged weights :math:`\bar\theta`, at the time :math:`s` at which integration starts, it is

    .. math::
        \left\| v_\theta(s, a_s, o) - \frac{\hat a_1 - a_s}{1 - s} \right\|^2, \qquad
        \hat a_1 = \Phi^{\bar\theta}_{s + h \to 1}(a_{s + h}), \qquad h = \frac{1 - s}{9},

    where :math:`\Phi` is the flow by Euler's method with steps of :math:`h`, and :math:`a_{s+h}` lies on the
    data's own path. Add it to a :class:`FlowMatchingLoss`, which trains the flow at all other times. The idea
    is the self-consistency of One-Step Flow Policy (Li et al., 2026, arXiv:2603.12480), but only the whole
    interval is learnt, the teacher crosses it in steps (progressive distillation), and there is no
    self-guidance. The first quarter of a batch is distilled, as in shortcut models (Frans et al., 2025); both
    losses together take about twice the time of flow matching alone.

    Args:
        actor_network: the policy whose velocity network is trained.
        teacher: the network with averaged weights; by default the trained one. It is neither trained nor
            saved with the loss.
        **options: options of :class:`FlowMatchingLoss`; ``times`` has no effect. With ``reduction="none"``
            the loss is that of the distilled windows, ``[n, P, d_a]``.

    Raises:
        ValueError: if the policy is trained at ``t = 0`` only, or the path is not straight.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, SelfDistillationLoss, VelocityMLP, WarmPriorActor
        >>> from warmprior import window_replay_buffer
        >>> data = TensorDict({"observation": torch.randn(100, 3), "action": torch.randn(100, 2),
        ...                    "episode": torch.arange(100) // 25}, [100])
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, prediction_length=8), PastPrior(8))
        >>> batch = window_replay_buffer(data, actor.prior, batch_size=16).sample()
        >>> SelfDistillationLoss(actor)(batch)["loss_self_distillation"].backward()
    """

    out_keys: ClassVar[list[NestedKey]] = ["loss_self_distillation"]

    def __init__(
        self, actor_network: WarmPriorActor, *, teacher: nn.Module | None = None, **options: Any
    ) -> None:
        super().__init__(actor_network, **options)
        if actor_network.sampling.max_nfe == 1:
            raise ValueError("self-distillation needs a flow, but the policy is trained at t = 0 only")
        check_straight(self.interpolant)
        self.__dict__["teacher"] = teacher  # not part of this module: its owner saves it

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss of a batch of windows; raise KeyError if a needed key is missing."""
        a0, a1, observation, weight = self.ends(tensordict)
        n = max(1, round(SHARE * a1.shape[:-2].numel()))
        a0, a1 = (end.detach().reshape(-1, *end.shape[-2:])[:n] for end in (a0, a1))
        observation, network = observation[:n], self.actor_network.network
        begin = self.actor_network.ode.start_time
        near = begin + (1.0 - begin) / TEACHER_STEPS
        t = a0.new_full((n,), begin)
        start, _ = self.interpolant(a0, a1, t)
        with torch.no_grad():
            point, _ = self.interpolant(a0, a1, a0.new_full((n,), near))
            field = velocity_field(network if self.teacher is None else self.teacher, observation)
            end = integrate(field, point, nfe=TEACHER_STEPS - 1, start_time=near)
        jump = velocity_field(network, observation)(t, start)
        error = self.error(jump, (end - start) / (1.0 - begin), t)
        loss = self.reduced(error, None if weight is None else weight.reshape(-1, weight.shape[-1])[:n])
        return TensorDict({self.out_keys[0]: loss}, batch_size=[])
