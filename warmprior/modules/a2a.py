"""A2A in action space: the source is made of the last actions."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.point_forecast import PointForecastPrior

__all__ = ["A2APrior"]


class A2APrior(PointForecastPrior):
    r"""A2A in action space: a deterministic source :math:`a_0 = f_\phi(h)` made of the last actions alone.

    A2A (Jia et al., 2026) encodes a history into the source of a flow between latent codes of chunks, without
    any noise. Here the code of a chunk is the chunk itself, the history that of :class:`PastPrior`, and
    :math:`f_\phi` learns by mean squared error to be near the target before the flow does.

    Args:
        chunk_length: ``H``.

    Examples:
        >>> import torch
        >>> prior = A2APrior(4).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.rand(5, 4, 2), torch.ones(5, 4, 1, dtype=torch.bool)
        >>> bool((prior.sample(loc, warm) == prior.sample(loc, warm)).all())
        True
    """

    name = "a2a"
    label = "A2A (action space)"
    color = "#7f3b08"
    default_sigma = 0.0
    sees_observation = False

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The encoded history, and ``sigma`` around it, 0 by default."""
        mean = self.forecast(loc, warm, observation)
        return mean, torch.full_like(mean[..., :1], self.sigma)
