"""Policies to compare with that are no flow from a warm source, written as priors."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.priors import GaussianPrior, PastPrior

__all__ = ["HistoryPrior", "RegressionPrior"]


class RegressionPrior(GaussianPrior):
    r"""Behaviour cloning by mean squared error, in the same network and with the same code.

    The source is the point :math:`a_0 = 0` and the field is trained at :math:`t = 0` alone
    (:attr:`Prior.is_flow`), so that :math:`v(0, 0, o)` regresses :math:`a_1 - a_0 = a_1` and one Euler step
    returns it. The field means nothing at any other time: more than one network evaluation is refused.

    Args:
        chunk_length: ``H``.

    See Also:
        :class:`~warmprior.GaussianPrior`: the flow beside which it is put.

    Examples:
        >>> import torch
        >>> from warmprior import VelocityMLP, WarmPriorActor
        >>> prior = RegressionPrior(4)
        >>> prior.sample(torch.ones(1, 4, 2), torch.ones(1, 4, 1, dtype=torch.bool)).unique()
        tensor([0.])
        >>> WarmPriorActor(VelocityMLP(2, 3, 4), prior).ode.nfe
        1
    """

    name = "regression"
    label = "Regression"
    color = "#b8860b"
    is_flow = False

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length, sigma=0.0)

    def sample(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """The point 0; nothing is drawn."""
        return torch.zeros_like(loc)


class HistoryPrior(PastPrior):
    r"""History-conditioned flow matching: the network sees the last ``H`` actions, the source is N(0, I).

    ``loc`` and ``warm`` are those of :class:`~warmprior.PastPrior`, in training and at decisions, but
    they condition the network instead of shifting the source: :class:`~warmprior.MeanObservation` writes
    them beside the observation. Build the network with
    ``observation_dim = d_o + MeanObservation.width(prior, d_a)``.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        cold_probability: history dropout, the share of training samples whose history is withheld.

    Examples:
        >>> import torch
        >>> prior = HistoryPrior(2)
        >>> loc, warm = torch.full((10_000, 2, 1), 7.0), torch.ones(10_000, 2, 1, dtype=torch.bool)
        >>> abs(prior.sample(loc, warm, torch.Generator().manual_seed(0)).mean().item()) < 0.1
        True
    """

    name = "history"
    label = "History"
    color = "#6a51a3"
    conditions_network = True

    def __init__(self, chunk_length: int, *, cold_probability: float = 0.0) -> None:
        super().__init__(chunk_length, sigma=1.0, cold_probability=cold_probability)

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Standard normal everywhere."""
        return super().distribution(loc, torch.zeros_like(warm), observation)
