"""Policies to compare with that are no flow from a warm source, written as priors."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.priors import GaussianPrior, PastPrior

__all__ = ["HistoryPrior", "RegressionPrior"]


class RegressionPrior(GaussianPrior):
    r"""Behaviour cloning by mean squared error, in the same network and with the same code.

    The source is the point :math:`a_0 = 0` and the field is trained at :math:`t = 0` alone, so that
    :math:`v(0, 0, o)` regresses :math:`a_1 - a_0 = a_1` and one Euler step returns it. The field means
    nothing at any other time: more than one network evaluation is refused.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        sigma: 0, the only possible value.
        cold_probability: without effect, nothing is ever warm.

    Raises:
        ValueError: if ``sigma`` is not 0.

    Examples:
        >>> import torch
        >>> from warmprior import ODEActor, VelocityMLP
        >>> prior = RegressionPrior(4)
        >>> prior.sample(torch.ones(1, 4, 2), torch.ones(1, 4, 1, dtype=torch.bool)).unique()
        tensor([0.])
        >>> ODEActor(VelocityMLP(2, 3, 4), prior=prior).nfe
        1
    """

    name = "regression"
    default_sigma = 0.0
    max_nfe = 1

    def __init__(
        self, chunk_length: int, *, sigma: float | None = None, cold_probability: float = 0.0
    ) -> None:
        super().__init__(chunk_length, sigma=sigma, cold_probability=cold_probability)
        if self.sigma != 0.0:
            raise ValueError(f"regression starts at a point: sigma must be 0, got {self.sigma}")

    def sample(self, loc: Tensor, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The point 0; nothing is drawn."""
        return torch.zeros_like(loc)

    def sample_times(
        self, batch_shape: torch.Size, generator: torch.Generator | None, like: Tensor
    ) -> Tensor:
        """Always ``t = 0``; nothing is drawn."""
        return torch.zeros(batch_shape, device=like.device, dtype=like.dtype)


class HistoryPrior(PastPrior):
    r"""History-conditioned flow matching: the network sees the last ``H`` actions, the source is N(0, I).

    ``loc`` and ``warm`` are those of :class:`~warmprior.PastPrior`, in training and at decisions, but
    they condition the network (:meth:`Prior.extend_observation`) instead of shifting the source. Build
    the network with ``observation_dim = d_o + prior.context_dim(d_a)``.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        sigma: 1, the only possible value: the source is standard normal.
        cold_probability: history dropout, the share of training samples whose history is withheld.

    Raises:
        ValueError: if ``sigma`` is not 1.

    Examples:
        >>> import torch
        >>> prior = HistoryPrior(2)
        >>> prior.context_dim(action_dim=1)
        3
        >>> loc = torch.tensor([[[0.3], [0.4]]])
        >>> warm = torch.ones(1, 2, 1, dtype=torch.bool)
        >>> prior.extend_observation(torch.zeros(1, 1, 2), loc, warm)
        tensor([[[0.0000, 0.0000, 0.3000, 0.4000, 1.0000]]])
    """

    name = "history"
    default_sigma = 1.0
    conditions_network = True

    def __init__(
        self, chunk_length: int, *, sigma: float | None = None, cold_probability: float = 0.0
    ) -> None:
        super().__init__(chunk_length, sigma=sigma, cold_probability=cold_probability)
        if self.sigma != 1.0:
            raise ValueError(
                f"the source of a history-conditioned flow is N(0, I): sigma must be 1, got {self.sigma}"
            )

    def sample(self, loc: Tensor, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Standard normal everywhere."""
        return super().sample(loc, torch.zeros_like(warm), generator)
