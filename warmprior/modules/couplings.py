"""Standard normal sources that are paired with the data in another way than at random."""

from __future__ import annotations

from itertools import chain
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from warmprior.io.extras import require
from warmprior.modules.checks import check_finite_numbers, check_whole_numbers
from warmprior.modules.priors import GaussianPrior

__all__ = ["OTPrior", "ReflowPrior"]


class OTPrior(GaussianPrior):
    r"""OT-CFM: source and data of a batch are paired by optimal transport.

    The permutation :math:`\pi` of the sources minimises

    .. math::
        \sum_j \|a_0^{\pi(j)} - a_1^j\|^2 + w \|o^{\pi(j)} - o^j\|^2

    (Tong et al., 2024; Pooladian et al., 2023), exactly, in nearly equal groups of at most 256. At decisions
    the source is drawn at any observation, so pairs across observations bias the policy; ``w`` makes them
    dear. At ``w = 0`` the observation is ignored; at a large one everything stays where it is.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        observation_weight: ``w``, for observations in the data's normalised units, each one tensor.

    Raises:
        ValueError: if the weight is negative or not finite, a batch has fewer than two windows, or its
            observations are nested.
        ImportError: if scipy is missing.

    See Also:
        :class:`~warmprior.ReflowPrior`: pairs each source with what a trained flow makes of it.

    Examples:
        >>> import torch
        >>> prior = OTPrior(1, observation_weight=0.0)
        >>> a0, a1 = torch.tensor([[[0.0]], [[1.0]]]), torch.tensor([[[5.0]], [[4.0]]])
        >>> [x.flatten().tolist() for x in prior.couple(a0, a1)]
        [[1.0, 0.0], [5.0, 4.0]]
    """

    name = "ot"
    label = "OT-CFM"
    color = "#2ca02c"
    least_batch = 2
    GROUP: ClassVar[int] = 256

    def __init__(self, chunk_length: int, *, observation_weight: float = 10.0) -> None:
        check_finite_numbers(observation_weight=observation_weight)
        if observation_weight < 0:
            raise ValueError(f"observation_weight must be at least 0, got {observation_weight}")
        require("scipy", "sim")
        self.observation_weight = observation_weight
        super().__init__(chunk_length)

    @property
    def needs_vector(self) -> bool:
        """If observations are part of the cost."""
        return self.observation_weight > 0

    def couple(
        self,
        a0: Tensor,
        a1: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Permute the sources within the batch."""
        from scipy.optimize import linear_sum_assignment

        source, target = a0.reshape(-1, *a0.shape[-2:]), a1.reshape(-1, *a1.shape[-2:])
        if len(source) < 2:
            raise ValueError(f"{self.name} pairs within a batch: it needs at least 2 windows")
        if observation is None and self.observation_weight:
            raise ValueError(f"{self.name} needs the observations, or observation_weight=0")
        if self.observation_weight and not isinstance(observation, Tensor):
            raise ValueError(
                f"{self.name} compares observations that are one tensor each, and no nested ones: "
                "concatenate their entries, or set observation_weight=0"
            )
        paired = []
        # Groups of nearly one size: a window that is left over could only be paired with itself.
        for group in torch.arange(len(source)).tensor_split(-(-len(source) // self.GROUP)):
            cost = _squared_distances(target[group], source[group])
            if self.observation_weight:
                assert observation is not None
                seen = observation.reshape(len(source), -1)[group]
                cost = cost + self.observation_weight * _squared_distances(seen, seen)
            order = torch.as_tensor(linear_sum_assignment(cost.double().cpu().numpy())[1])
            paired.append(source[group][order.to(source.device)])
        return torch.cat(paired).view_as(a0), a1


def _squared_distances(x: Tensor, y: Tensor) -> Tensor:
    return torch.cdist(x.flatten(1), y.flatten(1)).square()


class ReflowPrior(GaussianPrior):
    r"""2-rectified flow: the target of every source is where a trained policy's flow leads it.

    The teacher is the policy of :class:`GaussianPrior` (the 1-rectified flow) of the same recipe and seed.
    Pairs :math:`(a_0, \hat a_1)`, with :math:`\hat a_1` the end of its flow at the window's observation, are
    drawn anew for every batch (Liu et al., 2023): a step costs ``teacher_nfe`` more forward passes.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        teacher_nfe: the teacher's Euler steps.

    Raises:
        ValueError: if ``teacher_nfe`` is no whole number of at least 1, or it is trained without a teacher.

    Examples:
        >>> import torch
        >>> from warmprior import VelocityMLP, WarmPriorActor
        >>> prior = ReflowPrior(4, teacher_nfe=2)
        >>> prior.learn_from(WarmPriorActor(VelocityMLP(2, 3, 4), GaussianPrior(4)))
        >>> a0, a1, seen = torch.randn(5, 4, 2), torch.zeros(5, 4, 2), torch.zeros(5, 2, 3)
        >>> source, target = prior.couple(a0, a1, observation=seen)
        >>> source is a0, target.shape
        (True, torch.Size([5, 4, 2]))
    """

    name = "reflow"
    label = "2-rectified flow"
    color = "#17becf"
    teacher = "gaussian"

    def __init__(self, chunk_length: int, *, teacher_nfe: int = 9) -> None:
        check_whole_numbers(teacher_nfe=teacher_nfe)
        super().__init__(chunk_length)
        self.teacher_nfe = teacher_nfe
        self.policy: Any = None

    def learn_from(self, policy: Any) -> None:
        """Take the teacher, which :meth:`couple` moves to the device of the data.

        Raises:
            ValueError: if it is the policy of another prior, or of another chunk length.
        """
        if policy.prior.name != self.teacher:
            raise ValueError(f"{self.name} learns from {self.teacher}, not from {policy.prior}")
        if policy.prior.chunk_length != self.chunk_length:
            raise ValueError(
                f"{self.name} has chunks of {self.chunk_length} actions, but its teacher of "
                f"{policy.prior.chunk_length}"
            )
        self.policy = policy.eval().requires_grad_(False)

    @torch.no_grad()
    def couple(
        self,
        a0: Tensor,
        a1: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Replace the targets by the ends of the teacher's flow."""
        if self.policy is None:
            raise ValueError(
                f"{self.name} has no teacher: hand a trained policy of {self.teacher} to learn_from"
            )
        for tensor in chain(self.policy.parameters(), self.policy.buffers()):
            if tensor.device != a0.device:
                self.policy.to(a0.device)
                break
        ode = self.policy.ode
        noise_key, observation_key = ode.in_keys[:2]
        data = TensorDict({noise_key: a0, observation_key: observation}, a0.shape[:-2])
        return a0, ode(data, nfe=self.teacher_nfe)[ode.out_keys[0]]
