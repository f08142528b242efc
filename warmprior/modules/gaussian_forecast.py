"""Learned Gaussian sources: mean and scale, calibrated on episodes that were held out."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from warmprior.modules.learned import LearnedPrior
from warmprior.modules.learning_windows import LearningWindows

__all__ = ["ForecastPrior", "LeapPrior"]

SCALE_FLOOR = 0.02
"""Smallest standard deviation of a learned Gaussian source, calibrated, in normalised action units and
before ``sigma`` multiplies it."""


class ForecastPrior(LearnedPrior):
    r"""A learned Gaussian source: mean and scale from observation and last actions, calibrated.

    .. math::
        a_0 = \mu_\phi(o, h) + s_\phi(o, h) \varepsilon, \qquad
        \min_\phi E\left[\log s_\phi + \tfrac12 (a_1 - \mu_\phi)^2 / s_\phi^2\right],

    per position and dimension. Afterwards :math:`s_\phi` is multiplied, per position and dimension, by the
    root mean square of :math:`(a_1 - \mu_\phi) / s_\phi` on episodes that were held out: a source that errs
    more than it thinks is widened until it errs as it says, and one that errs less is narrowed, down to 0.02.
    ``sigma`` multiplies the result.

    Args:
        chunk_length: ``H``.

    See Also:
        - :class:`~warmprior.LeapPrior`: the same from the observation alone.
        - :func:`~warmprior.training.learn_prior`: fits a learned prior before the policy.

    Examples:
        >>> import torch
        >>> prior = ForecastPrior(4).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.zeros(5, 4, 2), torch.ones(5, 4, 1, dtype=torch.bool)
        >>> mean, scale = prior.distribution(loc, warm, torch.zeros(5, 1, 3))
        >>> mean.shape, bool((scale > 0).all())
        (torch.Size([5, 4, 2]), True)
    """

    name = "forecast"
    label = "WP-Forecast"
    color = "#d62728"
    default_sigma = 1.0
    always_warm = True
    calibration: Tensor
    typical_scale: Tensor

    def build(self) -> None:
        """One network for mean and scale, the calibration, and the typical scale that it finds."""
        self.network = self.mlp(self.seen_dim, 2 * self.chunk_dim)
        shape = (self.prediction_length, self.action_dim)
        self.register_buffer("calibration", torch.ones(shape))
        self.register_buffer("typical_scale", torch.ones(()))

    @property
    def residual_sigma(self) -> float:
        """``sigma`` times the root mean square of the scale on the windows of the calibration, 1 before it.

        Raises:
            ValueError: if the networks were not built.
        """
        self._check_sized()
        return self.sigma * float(self.typical_scale)

    def _calibrated(self, scale: Tensor) -> Tensor:
        return (self.calibration * scale).clamp_min(SCALE_FLOOR)

    def _gaussian(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Mean and scale before the calibration."""
        seen = self.seen(loc, warm, observation)
        out = self.network(seen)
        mean, raw = out.unflatten(-1, (2, self.prediction_length, self.action_dim)).unbind(-3)
        return mean, SCALE_FLOOR + nn.functional.softplus(raw)

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The learned mean and the calibrated scale."""
        mean, scale = self._gaussian(loc, warm, observation)
        return mean, self.sigma * self._calibrated(scale)

    def learning_loss(
        self, windows: LearningWindows, generator: torch.Generator | None = None
    ) -> Tensor:
        """Negative log-likelihood per coordinate, without its constant."""
        mean, scale = self._gaussian(windows.loc, windows.warm, windows.observation)
        return windows.mean(scale.log() + 0.5 * ((windows.a1 - mean) / scale).square())

    def calibrate(self, windows: LearningWindows) -> None:
        """Scale by the root mean square of the standardised error, and note what scale that gives."""
        mean, scale = self._gaussian(windows.loc, windows.warm, windows.observation)
        counted = windows.counted
        squared = ((windows.a1 - mean) / scale).square() * counted
        known = counted.sum(0).clamp_min(1)
        found = torch.where(counted.any(0), squared.sum(0) / known, 1.0)
        self.calibration.copy_(found.sqrt())
        self.typical_scale.copy_(windows.mean(self._calibrated(scale).square()).sqrt())


class LeapPrior(ForecastPrior):
    """A learnable prior: the Gaussian source of :class:`ForecastPrior` from the observation alone.

    Args:
        chunk_length: ``H``.

    Examples:
        >>> import torch
        >>> prior = LeapPrior(4).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> warm, seen = torch.ones(5, 4, 1, dtype=torch.bool), torch.rand(5, 1, 3)
        >>> means = [prior.distribution(torch.rand(5, 4, 2), warm, seen)[0] for _ in range(2)]
        >>> torch.allclose(*means, atol=1e-6)  # the last actions play no role
        True
    """

    name = "leap"
    label = "Learnable prior"
    color = "#b8a9c9"
    sees_history = False
