"""STEP: a forecast enters the flow on the way."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.checks import check_finite_numbers
from warmprior.modules.point_forecast import PointForecastPrior

__all__ = ["StepPrior"]


class StepPrior(PointForecastPrior):
    r"""STEP: a forecast enters the flow of a standard normal source at an intermediate time.

    The flow is trained as ever, from N(0, I). At decisions a forecaster :math:`f_\phi(o, h)`, trained by mean
    squared error, gives

    .. math::
        a_{t_s} = (1 - t_s) \varepsilon + t_s f_\phi(o, h),

    from which the flow is integrated to ``t = 1`` (Li et al., 2026). Where the forecast stays where the last
    chunk was (root mean square distance per coordinate below ``stall``), the robot may be stuck, and the
    noise is multiplied by ``1 + stall_noise`` (velocity-aware noise).

    Args:
        chunk_length: ``H``.

    Keyword Args:
        start_time: :math:`t_s`.
        stall: see above, in normalised action units.
        stall_noise: see above.

    Raises:
        ValueError: if ``start_time`` is not in (0, 1), ``stall`` below 0, or one of the three not finite.

    See Also:
        :class:`~warmprior.ForecastPrior`: moves the source itself to a learned forecast.

    Examples:
        >>> import torch
        >>> prior = StepPrior(4, start_time=0.75).sized(
        ...     action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.zeros(5, 4, 2), torch.zeros(5, 4, 1, dtype=torch.bool)
        >>> seen, draw = torch.zeros(5, 1, 3), torch.Generator().manual_seed(0)
        >>> start = prior.start(loc, warm, draw, seen)
        >>> noise = prior.sample(loc, warm, draw.manual_seed(0))
        >>> torch.allclose(start, prior.anchor(loc, warm, seen) + prior.residual_sigma * noise)
        True
    """

    name = "step"
    label = "STEP"
    color = "#00695c"
    stall: float
    stall_noise: float

    def __init__(
        self,
        chunk_length: int,
        *,
        start_time: float = 0.5,
        stall: float = 0.02,
        stall_noise: float = 0.1,
        action_dim: int | None = None,
        observation_dim: int | None = None,
        observation_steps: int | None = None,
        hidden_dim: int = 256,
    ) -> None:
        check_finite_numbers(start_time=start_time, stall=stall, stall_noise=stall_noise)
        if not 0.0 < start_time < 1.0 or stall < 0:
            raise ValueError(
                f"need 0 < start_time < 1 and stall >= 0, got {start_time} and {stall}"
            )
        self.__dict__.update(start_time=start_time, stall=stall, stall_noise=stall_noise)
        super().__init__(
            chunk_length,
            action_dim=action_dim,
            observation_dim=observation_dim,
            observation_steps=observation_steps,
            hidden_dim=hidden_dim,
            sigma=1.0,
        )

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Standard normal: that of the training."""
        return super().distribution(loc, torch.zeros_like(warm), observation)

    @property
    def residual_sigma(self) -> float:
        """Share of the noise in :meth:`start`, without what is added where the robot may be stuck."""
        return 1.0 - self.start_time

    def anchor(self, loc: Tensor, warm: Tensor, observation: Tensor | None = None) -> Tensor:
        """Share of the forecast in :meth:`start`."""
        return self.start_time * self.forecast(loc, warm, observation)

    def start(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Noise and forecast, mixed as on the path at ``start_time``."""
        eps = torch.randn(loc.shape, generator=generator, dtype=loc.dtype, device=loc.device)
        forecast = self.forecast(loc, warm, observation)
        moved = (forecast - loc).square().mean((-1, -2), keepdim=True).sqrt()
        stuck = warm[..., :1, :] & (moved < self.stall)
        eps = torch.where(stuck, (1 + self.stall_noise) * eps, eps)
        return (1 - self.start_time) * eps + self.start_time * forecast
