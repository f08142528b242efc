"""The part of a prior's source and of its targets that follows linearly from the observation."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from warmprior import keys
from warmprior.modules.prior import Prior

__all__ = ["ObservationTrend"]

DRAWS = 16
"""Of the source, per window."""

RIDGE = 1e-4
"""Variance of the noise that the coefficients are made robust to: a standard deviation of 0.01, half a
percent of the normalised range. What varies less cannot be relied on at deployment."""


class ObservationTrend(nn.Module):
    r"""Best linear predictions of source :math:`a_0` and target :math:`a_1` from the observation.

    Absolute poses lie near the observed one: most of their variance is that of where the robot is. A network
    that has to find this by itself spends its precision on it, and what it hands on of the source's noise is
    a share of the whole range, many times what a pose changes in a step. With a trend,
    :class:`PreconditionedNetwork` learns the remainder.

    The predictions are ridge regressions on all ``To`` steps of the observation, one per chunk position and
    action dimension, for normalised inputs. They say nothing of the mean, which :class:`SourceMoments` has.

    Args:
        centre: ``[To, d_o]``, mean observation.
        source: ``[To * d_o, P, d_a]``, coefficients of :math:`a_0 - E[a_0]`.
        target: ``[To * d_o, P, d_a]``, coefficients of :math:`a_1 - E[a_1]`.

    Raises:
        ValueError: if the shapes differ, or an entry is NaN or infinite.

    Examples:
        >>> import torch
        >>> trend = ObservationTrend(torch.zeros(1, 2), torch.zeros(2, 4, 1), torch.ones(2, 4, 1))
        >>> source, target = trend(torch.tensor([[[0.5, 0.25]]]))
        >>> target.flatten().tolist()
        [0.75, 0.75, 0.75, 0.75]
    """

    centre: Tensor
    source: Tensor
    target: Tensor

    def __init__(self, centre: Tensor, source: Tensor, target: Tensor) -> None:
        super().__init__()
        shapes = [tuple(value.shape) for value in (centre, source, target)]
        fits = centre.ndim == 2 and source.ndim == 3 and len(source) == centre.numel()
        if not fits or source.shape != target.shape:
            raise ValueError(
                f"a trend needs [To, d_o] and twice [To * d_o, P, d_a], got the shapes {shapes}"
            )
        for name, value in (("centre", centre), ("source", source), ("target", target)):
            if not torch.isfinite(value).all():
                raise ValueError(f"the trend's {name} holds NaN or infinity: check the data")
            self.register_buffer(name, value.clone())

    @classmethod
    def zero(
        cls, observation_steps: int, observation_dim: int, prediction_length: int, action_dim: int
    ) -> ObservationTrend:
        """No trend, to be replaced by loading a state dict."""
        inputs = observation_steps * observation_dim
        none = torch.zeros(inputs, prediction_length, action_dim)
        return cls(torch.zeros(observation_steps, observation_dim), none, none)

    @classmethod
    @torch.no_grad()
    def fit(
        cls, windows: TensorDictBase, prior: Prior, *, generator: torch.Generator | None = None
    ) -> ObservationTrend:
        """Estimate it from training windows and draws of the prior.

        Args:
            windows: ``[N]``, see :class:`~warmprior.ActionWindow`, with observations ``[N, To, d_o]``.
            prior: the source distribution that these windows were made for.

        Keyword Args:
            generator: source of randomness of the source samples, on the windows' device.

        Returns:
            The trend over the positions that are not padded, as float32; none where all are.
        """
        observation = windows[keys.OBSERVATION].double()
        centre = observation.mean(0)
        inputs = (observation - centre).flatten(1)
        ends = windows[keys.LOC], windows[keys.WARM]
        # The mean of several draws: their noise belongs to no observation.
        draws = [prior.sample(*ends, generator).double() for _ in range(DRAWS)]
        source = torch.stack(draws).mean(0)
        target, weight = windows[keys.CHUNK].double(), (~windows[keys.IS_PAD]).double()
        ridge = RIDGE * torch.eye(inputs.shape[1], dtype=inputs.dtype, device=inputs.device)
        coefficients = []
        for position in range(weight.shape[1]):
            # Padded windows do not count: an episode's end would pull the trend to the repeated action.
            share = weight[:, position, None] / weight[:, position].sum().clamp_min(1)
            mean = (share * inputs).sum(0)
            scaled = share * (inputs - mean)
            values = torch.cat((source[:, position], target[:, position]), -1)
            covariance = (inputs - mean).mT @ scaled
            coefficients.append(torch.linalg.solve(covariance + ridge, scaled.mT @ values))
        both = torch.stack(coefficients, 1).float()
        return cls(centre.float(), *both.chunk(2, -1))

    def config(self) -> dict[str, Any]:
        """JSON-serialisable arguments of :meth:`zero`; the values themselves are buffers."""
        names = ("observation_steps", "observation_dim", "prediction_length", "action_dim")
        return dict(zip(names, (*self.centre.shape, *self.source.shape[1:]), strict=True))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """What source and target deviate from their means by, each ``[B, P, d_a]``.

        Args:
            observation: ``[B, To, d]`` whose first ``d_o`` entries per step are those of the trend; others
                are not looked at.
        """
        inputs = (observation[..., : self.centre.shape[1]] - self.centre).flatten(1)
        shape = self.source.shape[1:]
        source, target = (
            (inputs @ w.flatten(1)).unflatten(1, shape) for w in (self.source, self.target)
        )
        return source, target
