"""Real-Time Chunking: guidance of a flow towards the forecast of the chunk being executed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from warmprior.checks import check_shape
from warmprior.options.guidance import GuidanceOptions, Schedule

Velocity = Callable[[Tensor, Tensor], Tensor]

SCHEDULES: dict[Schedule, Callable[[Tensor], Tensor]] = {
    "exp": lambda linear: linear * torch.expm1(linear) / (math.e - 1),
    "linear": lambda linear: linear,
}
"""Schedules of the weight after the delay, by name; each is a function of a weight that falls linearly."""


def spliced(chunk: Tensor, forecast: Tensor, delay: Tensor) -> Tensor:
    """Return a late chunk ``[*B, P, d_a]`` as it is executed: its first ``delay`` actions from the forecast.

    The forecast is the previous chunk at the same control steps, ``[*B, P, d_a]``; the delay is ``[*B, 1]``.
    """
    late = torch.arange(chunk.shape[-2], device=chunk.device) < delay
    return torch.where(late.unsqueeze(-1), forecast.to(chunk.dtype), chunk)


@dataclass(frozen=True)
class RealTimeChunking(GuidanceOptions):
    r"""The guidance of `Real-Time Chunking <https://arxiv.org/abs/2506.07339>`_, for any source.

    While a chunk is computed, the old one is executed for ``d`` more control steps (the delay), and the new
    one should continue it. Velocities are corrected towards its forecast :math:`Y` of the same steps, with
    :math:`\hat a = a_t + (1-t)\,v(t, a_t)` and :math:`J = \partial \hat a / \partial a_t`:

    .. math::
        v' = v + \min\!\big(g(t), \beta\big)\; J^\top W (Y - \hat a), \qquad
        g(t) = \sigma^2\, \frac{1-t}{t} + \frac{t}{1-t}.

    :math:`g` is exact for a source :math:`N(\mu, \sigma^2)` and Gaussian data of standard deviation 1
    (docs/real_time_chunking.md derives it). :math:`\sigma = 1` is the published weight,
    :math:`\frac{1-t}{t} \cdot \frac{t^2 + (1-t)^2}{(1-t)^2}`. It assumes straight paths
    (:class:`~warmprior.LinearInterpolant`). :math:`W` is 1 on the first ``d`` positions, at which the old
    chunk is executed, then falls as ``schedule`` says, and is 0 from ``execution_horizon`` on.

    Its arguments are those of :class:`~warmprior.options.guidance.GuidanceOptions`.

    Raises:
        ValueError: if the schedule is unknown, or a number is out of range.

    Examples:
        >>> import torch
        >>> from warmprior import RealTimeChunking
        >>> rtc = RealTimeChunking(schedule="linear")
        >>> (10 * rtc.weights(torch.tensor(2), torch.tensor(6), 8)).round().tolist()  # 6 of 8 are left
        [10.0, 10.0, 8.0, 6.0, 4.0, 2.0, 0.0, 0.0]
        >>> rtc.guidance_weight(torch.tensor([0.0, 0.5, 0.75])).tolist()
        [5.0, 2.0, 3.33...]
    """

    def check_reach(self, delay: int, forecast_steps: int) -> None:
        """Raise ValueError if the delay exceeds the execution horizon, or the steps of the old chunk."""
        if not 0 <= delay <= forecast_steps:
            raise ValueError(
                f"a delay of {delay} control steps needs as many actions of the old chunk, but only "
                f"{forecast_steps} are left: execute fewer actions per decision, or predict longer chunks"
            )
        if self.execution_horizon is not None and self.execution_horizon < delay:
            raise ValueError(
                f"the guidance ends at execution_horizon={self.execution_horizon}, before the delay of "
                f"{delay} control steps ends: set execution_horizon >= delay, or None for all "
                f"{forecast_steps} actions that are left"
            )

    def weights(
        self, delay: Tensor, forecast_steps: Tensor, length: int, dtype: torch.dtype | None = None
    ) -> Tensor:
        """Return the weights :math:`W` ``[*B, P]`` for a delay and steps of the forecast, int64 ``[*B]``."""
        i = torch.arange(length, device=delay.device)
        last = self.execution_horizon
        end = forecast_steps if last is None else forecast_steps.clamp(max=last)
        end = end.unsqueeze(-1)
        start = torch.minimum(delay.unsqueeze(-1), end)
        linear = ((start - 1 - i).to(dtype or torch.get_default_dtype()) / (end - start + 1) + 1).clamp(0, 1)
        return torch.where(i < end, SCHEDULES[self.schedule](linear), 0.0)

    def guidance_weight(self, t: Tensor, sigma: Tensor | float = 1.0) -> Tensor:
        r"""Return :math:`\min(g(t), \beta)` at times in [0, 1]; the source's deviation broadcasts to them."""
        if self.sigma is not None:
            sigma = self.sigma
        tiny = torch.finfo(t.dtype).tiny
        source = sigma**2 * ((1 - t) / t.clamp(min=tiny))
        data = t / (1 - t).clamp(min=tiny)
        return (source + data).clamp(max=self.max_guidance_weight)

    def guided(
        self,
        velocity: Velocity,
        forecast: Tensor,
        forecast_steps: Tensor,
        delay: Tensor,
        sigma: Tensor | float = 1.0,
    ) -> Velocity:
        """Return a velocity that makes chunks continue the forecast, or ``velocity`` if no row has one.

        It works under ``torch.no_grad()``, and its result is detached.

        Args:
            velocity: the field ``(t [B], a_t [B, P, d_a]) -> [B, P, d_a]``.
            forecast: ``Y``, ``[B, P, d_a]``, at the positions of the new chunk.
            forecast_steps: number of its first positions that count, int64 ``[B, 1]``. Rows with 0 are not
                guided.
            delay: ``d``, int64 ``[B, 1]``.
            sigma: standard deviation of the source, broadcastable to ``[B, P, d_a]``.

        Raises:
            ValueError: if the shapes do not fit, or the delay is too long (:meth:`check_reach`).
            RuntimeError: (when called) with the Jacobian, under ``torch.inference_mode()``.
        """
        rows, length = forecast.shape[:2]
        check_shape("forecast_steps", forecast_steps, (rows, 1))
        check_shape("delay", delay, (rows, 1))
        steps, delay = forecast_steps.squeeze(1), delay.squeeze(1)
        if not steps.any():
            return velocity
        for late, count in torch.stack([delay, steps], 1)[steps > 0].unique(dim=0).tolist():
            self.check_reach(late, count)
        weights = self.weights(delay, steps, length, forecast.dtype).unsqueeze(-1)

        def corrected(t: Tensor, a: Tensor) -> Tensor:
            remaining = (1 - t)[:, None, None]
            if not self.jacobian:
                v = velocity(t, a)
                correction = weights * (forecast - (a + remaining * v))
            else:
                if torch.is_inference_mode_enabled():
                    raise RuntimeError(
                        "RealTimeChunking needs gradients, which torch.inference_mode() rules out: use "
                        "torch.no_grad(), or jacobian=False"
                    )
                with torch.enable_grad():
                    point = a.detach().requires_grad_(True)
                    v = velocity(t, point)
                    clean = point + remaining * v
                    error = (weights * (forecast - clean)).detach()
                    (correction,) = torch.autograd.grad(clean, point, error)
            v = v.detach()
            return v + self.guidance_weight(t[:, None, None], sigma) * correction

        return corrected
