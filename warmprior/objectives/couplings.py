"""Couplings pair the sources and targets of a batch: OT-CFM, 2-rectified flow, or a function of your own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior.checks import check_not_negative, check_positions, check_whole_numbers
from warmprior.io.extras import require
from warmprior.io.files import digest_of
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import device_of

Coupling = Callable[[Tensor, Tensor, Tensor | TensorDictBase | None], tuple[Tensor, Tensor]]
"""A function that pairs sources and targets: ``(a0, a1, observation) -> (a0, a1)``, chunks ``[*B, P, d_a]``.

The observations ``[*B, To, d_o]`` belong to the targets, so a coupling permutes ``a0`` or replaces ``a1``. It
may have a ``config()``, which a training run compares before it continues, and an ``interpolant`` and
``times``, a path and training times that the loss uses instead of its own.
"""


class OTCoupling:
    r"""The coupling of OT-CFM: it pairs the sources and targets of a batch by optimal transport.

    The permutation :math:`\pi` of the sources minimises

    .. math::
        \sum_j \|a_0^{\pi(j)} - a_1^j\|^2 + w \|o^{\pi(j)} - o^j\|^2

    (Tong et al., 2024; Pooladian et al., 2023), exactly, in nearly equal groups of at most 256. At decisions
    the source is independent of the observation, so pairs across observations bias the policy; ``w``
    penalises them.

    Args:
        observation_weight: ``w``, for normalised observations, each one tensor; 0 ignores them.

    Raises:
        ValueError: if the weight is negative or not finite, a batch has fewer than two windows, or its
            observations are nested.
        ImportError: if scipy is missing.

    Examples:
        >>> import torch
        >>> from warmprior import OTCoupling
        >>> a0, a1 = torch.tensor([[[0.0]], [[1.0]]]), torch.tensor([[[5.0]], [[4.0]]])
        >>> [x.flatten().tolist() for x in OTCoupling(observation_weight=0.0)(a0, a1)]
        [[1.0, 0.0], [5.0, 4.0]]
    """

    GROUP: ClassVar[int] = 256

    def __init__(self, observation_weight: float = 10.0) -> None:
        check_not_negative(observation_weight=observation_weight)
        require("scipy", "sim")
        self.observation_weight = observation_weight

    def config(self) -> dict[str, Any]:
        """Return the options as JSON holds them."""
        return {"name": "ot", "observation_weight": self.observation_weight}

    def __call__(
        self, a0: Tensor, a1: Tensor, observation: Tensor | TensorDictBase | None = None
    ) -> tuple[Tensor, Tensor]:
        """Permute the sources within the batch."""
        source, target = a0.reshape(-1, *a0.shape[-2:]), a1.reshape(-1, *a1.shape[-2:])
        if len(source) < 2:
            raise ValueError("optimal transport pairs within a batch: it needs at least 2 windows")
        if self.observation_weight and not isinstance(observation, Tensor):
            kind = "none" if observation is None else "nested ones"
            raise ValueError(
                f"optimal transport compares observations that are one tensor each, but got {kind}: "
                "concatenate their entries, or set observation_weight=0"
            )
        paired = []
        # Groups of nearly equal size: a leftover window could only be paired with itself.
        for group in torch.arange(len(source)).tensor_split(-(-len(source) // self.GROUP)):
            cost = _squared_distances(target[group], source[group])
            if isinstance(observation, Tensor) and self.observation_weight:
                vectors = observation.reshape(len(source), -1)[group]
                cost = cost + self.observation_weight * _squared_distances(vectors, vectors)
            paired.append(source[group][self.assigned(cost.double().cpu()).to(source.device)])
        return torch.cat(paired).view_as(a0), a1

    def assigned(self, cost: Tensor) -> Tensor:
        """Return the index of every target's source, for costs ``[n, n]``, float64 on the CPU."""
        from scipy.optimize import linear_sum_assignment

        return torch.as_tensor(linear_sum_assignment(cost.numpy())[1])


def _squared_distances(x: Tensor, y: Tensor) -> Tensor:
    return torch.cdist(x.flatten(1), y.flatten(1)).square()


class ReflowCoupling:
    r"""The coupling of 2-rectified flow: the target of every source is the end of a trained policy's flow.

    Every batch draws new pairs :math:`(a_0, \hat a_1)`, where :math:`\hat a_1` is the end of the teacher's
    flow at the window's observation (Liu et al., 2023): a step costs ``nfe`` more forward passes.

    Args:
        teacher: a trained policy with the same source; it is frozen, and moved to the device of the data.
        nfe: number of the teacher's Euler steps.

    Raises:
        ValueError: if ``nfe`` is not a whole number of at least 1, or chunks and teacher differ in length.

    Examples:
        >>> import torch
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior import ReflowCoupling
        >>> couple = ReflowCoupling(WarmPriorActor(VelocityMLP(2, 3, 4), GaussianPrior(4)), nfe=2)
        >>> a0, a1, observation = torch.randn(5, 4, 2), torch.zeros(5, 4, 2), torch.zeros(5, 2, 3)
        >>> source, target = couple(a0, a1, observation)
        >>> source is a0, target.shape
        (True, torch.Size([5, 4, 2]))
    """

    def __init__(self, teacher: WarmPriorActor, nfe: int = 9) -> None:
        check_whole_numbers(nfe=nfe)
        # Only the teacher's flow, from the source at t = 0.
        teacher = teacher.replace(start=None, guidance=None, solver="euler", grid="uniform")
        self.teacher, self.nfe = teacher.eval().requires_grad_(False), nfe

    def config(self) -> dict[str, Any]:
        """Return the options, with a digest of the teacher's weights."""
        weights = {name: value.tolist() for name, value in self.teacher.state_dict().items()}
        return {"name": "reflow", "nfe": self.nfe, "teacher": digest_of(weights)}

    @torch.no_grad()
    def __call__(
        self, a0: Tensor, a1: Tensor, observation: Tensor | TensorDictBase | None = None
    ) -> tuple[Tensor, Tensor]:
        """Replace the targets by the ends of the teacher's flow."""
        ode = self.teacher.ode
        check_positions("a source of the batch", a0, self.teacher.prior)
        if device_of(self.teacher) != a0.device:
            self.teacher.to(a0.device)
        noise, *_ = ode.in_keys
        data = TensorDict({noise: a0, ode.observation_key: observation}, a0.shape[:-2])
        return a0, ode(data, nfe=self.nfe)[ode.out_keys[0]]
