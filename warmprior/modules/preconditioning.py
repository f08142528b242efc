"""Preconditioning of velocity networks by second moments of source and targets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from warmprior import keys
from warmprior.checks import check_positions, check_shape, check_whole_numbers
from warmprior.modules.interpolant import Interpolant, LinearInterpolant
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.prior import Prior
from warmprior.modules.registry import from_config
from warmprior.modules.trend import VARIANCE_FLOOR, RestingTrend

CORRELATION_LIMIT = 1 - 1e-6
"""The largest correlation; above it source and target determine each other."""


class SourceMoments(nn.Module):
    """The means, variances and covariance of the source :math:`a_0` and the target :math:`a_1`.

    There is one set per chunk position and action dimension, each ``[P, d_a]`` in normalised units. Variances
    are at least :data:`VARIANCE_FLOOR` and correlations at most :data:`CORRELATION_LIMIT`, so that constant
    dimensions, positions that are always padded and deterministic sources cause no division by zero.

    Args:
        source_mean: :math:`m_0`.
        target_mean: :math:`m_1`.
        source_variance: :math:`v_0`.
        target_variance: :math:`v_1`.
        covariance: :math:`c = Cov(a_0, a_1)`.

    Raises:
        ValueError: if the shapes differ, or an entry is NaN or infinite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PreviewPrior, SourceMoments, window_replay_buffer
        >>> data = TensorDict({"observation": torch.zeros(999, 3), "action": torch.randn(999, 2),
        ...                    "episode": torch.arange(999) // 333}, [999])
        >>> prior = PreviewPrior(4)
        >>> windows = window_replay_buffer(data, prior, batch_size=256)
        >>> moments = SourceMoments.fit(windows, prior, generator=torch.Generator().manual_seed(0))
        >>> (moments.covariance.mean(1) > 0.5).tolist()  # the first half is warm, the second cold
        [True, True, True, True, False, False, False, False]
    """

    positive = ("source_variance", "target_variance", "conditional_deviation")
    """The names of the buffers that are scales."""

    def __init__(
        self,
        source_mean: Tensor,
        target_mean: Tensor,
        source_variance: Tensor,
        target_variance: Tensor,
        covariance: Tensor,
    ) -> None:
        super().__init__()
        moments = (source_mean, target_mean, source_variance, target_variance, covariance)
        shapes = [tuple(value.shape) for value in moments]
        if len(set(shapes)) > 1 or source_mean.ndim != 2:
            raise ValueError(f"all moments must have one shape [P, d_a], got {shapes}")
        if not all(bool(torch.isfinite(value).all()) for value in moments):
            raise ValueError("the moments hold NaN or infinity: check the actions they come from")
        # Copies, so that a tensor given twice does not become one buffer under two names.
        self.source_mean, self.target_mean = (nn.Buffer(mean.clone()) for mean in moments[:2])
        v0, v1 = (value.double().clamp_min(VARIANCE_FLOOR) for value in (source_variance, target_variance))
        limit = CORRELATION_LIMIT * (v0 * v1).sqrt()
        c = covariance.double().clamp(-limit, limit)
        # The target's deviation given the source, in float64: lower precisions would lose the difference.
        q = (v1 - c.square() / v0).sqrt()
        self.source_variance, self.target_variance, self.covariance, self.conditional_deviation = (
            nn.Buffer(value.to(source_mean.dtype)) for value in (v0, v1, c, q)
        )

    def config(self) -> None:
        """Return nothing, because the values are buffers."""

    @classmethod
    def identity(cls, prediction_length: int, action_dim: int) -> SourceMoments:
        """Return moments of independent standard normal ends, to be replaced by loading a state dict."""
        zero, one = (f(prediction_length, action_dim) for f in (torch.zeros, torch.ones))
        return cls(zero, zero, one, one, zero)

    @classmethod
    @torch.no_grad()
    def fit(
        cls,
        windows: ReplayBuffer | TensorDictBase,
        prior: Prior,
        *,
        coupling: Callable[..., tuple[Tensor, Tensor]] | None = None,
        samples: int = 16_384,
        trend: RestingTrend | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
        generator: torch.Generator | None = None,
    ) -> SourceMoments:
        """Estimate moments from unpadded positions of training windows and draws of the prior.

        A position that is padded in all windows gets the moments of independent standard normal ends; no loss
        reads it.

        Args:
            windows: a buffer of :func:`~warmprior.window_replay_buffer`, or windows ``[*B]``, used once each.
            prior: the source distribution.
            coupling: how the training pairs sources and targets, see :data:`~warmprior.Coupling`.
            samples: how many windows to draw from a buffer.
            trend: trend of the pose; the moments are those of the remainder.
            observation_key: key of the policy's observation, which the prior, coupling or trend may read.
            generator: draws the source samples, on the windows' device.

        Raises:
            ValueError: if there are fewer than two windows, or their lengths do not fit the prior.
        """
        if isinstance(windows, TensorDictBase):
            batches = [windows]
        else:
            check_whole_numbers(2, samples=samples)
            batches = []
            while sum(map(len, batches)) < samples:
                batches.append(windows.sample())
        batch = TensorDict.cat([batch.reshape(-1) for batch in batches])
        if len(batch) < 2:
            raise ValueError(f"moments need at least 2 windows, got {len(batch)}")
        check_positions(keys.CHUNK, batch[keys.CHUNK], prior)
        observation = batch.get(observation_key, None)
        source = prior.distribution(batch[keys.HISTORY], observation)
        a0, a1 = source.sample(generator), batch[keys.CHUNK]
        if coupling is not None:
            sizes = [part.numel() for part in batches]  # it pairs within a batch
            parts = zip(
                a0.split(sizes),
                a1.split(sizes),
                [None] * len(sizes) if observation is None else observation.split(sizes),
                strict=True,
            )
            a0, a1 = map(torch.cat, zip(*(coupling(*part) for part in parts), strict=True))
        a0, a1 = a0.double(), a1.double()
        if trend is not None:
            source_trend, target_trend = trend(observation.float())
            a0, a1 = a0 - source_trend, a1 - target_trend
        weight = batch[keys.IS_PAD].logical_not().unsqueeze(-1).double()
        count = weight.sum(0)

        def mean(values: Tensor) -> Tensor:
            return (weight * values).sum(0) / count.clamp_min(1)

        m0, m1 = mean(a0), mean(a1)
        a0, a1 = a0 - m0, a1 - m1
        v0, v1 = (torch.where((count > 0).expand_as(m0), mean(a.square()), 1.0) for a in (a0, a1))
        moments = (m0, m1, v0, v1, mean(a0 * a1))
        return cls(*(value.to(torch.get_default_dtype()) for value in moments))


class PreconditionedNetwork(VelocityNetwork):
    r"""A velocity network that learns only the remainder of the best linear prediction.

    With :math:`a_t = \alpha a_0 + \beta a_1`, the velocity :math:`u_t = \dot\alpha a_0 + \dot\beta a_1` and
    the moments of :math:`(a_0, a_1)`, per chunk position and action dimension,

    .. math::
        v_\theta(t, a_t, o) = E[u_t] + \frac{Cov(u_t, a_t)}{Var(a_t)} (a_t - E[a_t])
        + \sqrt{Var(u_t) - \frac{Cov(u_t, a_t)^2}{Var(a_t)}} \;
        F_\theta\Big(t, \frac{a_t - E[a_t]}{\sqrt{Var(a_t)}}, o\Big).

    The first two terms predict the velocity linearly from :math:`a_t`; the input and the target of :math:`F`
    have mean 0 and variance 1 at every time and for every source. :math:`F = 0` is optimal if
    :math:`(a_0, a_1)` is jointly Gaussian and independent of the observation. This generalises EDM (Karras et
    al., 2022, Eq. 7), whose constants assume zero means and an independent source.

    Variance and scale are computed without subtractions, which would lose precision. With the source's
    standard deviation :math:`s_0`, the covariance :math:`c` of source and target, and the standard deviation
    :math:`q` of the target given the source, :math:`Var(a_t) = (\alpha s_0 + \beta c / s_0)^2 + (\beta q)^2`.
    The scale of :math:`F` is :math:`|\alpha\dot\beta - \dot\alpha\beta| \, s_0 q / \sqrt{Var(a_t)}`.

    Args:
        network: the network :math:`F`, or its ``config()``.
        moments: the moments of the prior's source and the targets; by default those of an independent
            standard normal source and target; loading a state dict replaces them.
        trend: the trend of the resting action, or its ``config()``. It gives :math:`E[a_0 | o]` and
            :math:`E[a_1 | o]` in place of the means above; the moments are then those of the remainder.
        interpolant: the path of the loss, or its ``config()``; linear by default.

    Raises:
        ValueError: if the shapes of the moments or the trend differ from the network's, or the path has no
            finite velocity at its ends.

    See Also:
        :func:`~warmprior.training.precondition`: estimates the moments and wraps a network.

    Examples:
        >>> import torch
        >>> from warmprior import PreconditionedNetwork, SourceMoments, VelocityMLP
        >>> one, zero = torch.ones(8, 7), torch.zeros(8, 7)
        >>> moments = SourceMoments(zero, one, one, 0.25 * one, zero)
        >>> network = PreconditionedNetwork(VelocityMLP(7, 23, 8), moments=moments)
        >>> network(torch.rand(4), torch.randn(4, 8, 7), torch.randn(4, 2, 23)).shape
        torch.Size([4, 8, 7])
    """

    def __init__(
        self,
        network: VelocityNetwork | dict[str, Any],
        *,
        moments: SourceMoments | None = None,
        trend: RestingTrend | dict[str, Any] | None = None,
        interpolant: Interpolant | dict[str, Any] | None = None,
    ) -> None:
        if isinstance(network, dict):
            network = from_config(VelocityNetwork, network)
        if isinstance(interpolant, dict):
            interpolant = from_config(Interpolant, interpolant)
        super().__init__(
            network.action_dim, network.observation_dim, network.prediction_length, network.observation_steps
        )
        self.network = network
        self.encodes = getattr(network, "encodes", False)
        self.interpolant = LinearInterpolant() if interpolant is None else interpolant
        ends = self.interpolant.coefficients(torch.tensor([0.0, 1.0]))
        if not all(bool(torch.isfinite(value).all()) for value in ends):
            raise ValueError(
                f"the path {self.interpolant.config()} has no finite velocity at its ends, where samplers "
                "evaluate it: choose another interpolant"
            )
        shape = (network.prediction_length, network.action_dim)
        self.moments = SourceMoments.identity(*shape) if moments is None else moments
        self.trend = RestingTrend.zero(**trend) if isinstance(trend, dict) else trend
        check_shape("a moment for the network's chunks", self.moments.covariance, shape)
        if self.trend is not None:
            check_shape("the trend for the network's chunks", self.trend.target, shape)

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """Encode an observation with the network inside."""
        return self.network.encode(observation) if self.encodes else observation

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        """Return the parameter groups of the network inside."""
        return self.network.parameter_groups(weight_decay)

    def remainder(self, t: Tensor) -> Tensor:
        """Return the unit of ``F`` at times ``[B]``: the remainder's standard deviation, ``[B, P, d_a]``."""
        return self._deviations(*self.interpolant.coefficients(t[:, None, None]))[1]

    def _deviations(
        self, alpha: Tensor, beta: Tensor, d_alpha: Tensor, d_beta: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return one over the point's deviation, and the unit of ``F``."""
        moments = self.moments
        s0, q = moments.source_variance.sqrt(), moments.conditional_deviation
        # a_t = E[a_t] + along z_0 + across z_1 with z ~ N(0, I).
        along, across = _combination(s0, alpha, moments.covariance / s0, beta), beta * q
        scale = torch.addcmul(along * along, across, across).rsqrt()
        return scale, (alpha * d_beta - d_alpha * beta).abs() * (s0 * q) * scale

    def forward(self, t: Tensor, a: Tensor, observation: Tensor) -> Tensor:
        """Return the velocity ``[B, P, d_a]`` at times ``t`` ``[B]`` and points ``a`` ``[B, P, d_a]``."""
        self.check_chunk(a)
        alpha, beta, d_alpha, d_beta = self.interpolant.coefficients(t[:, None, None])
        moments = self.moments
        m0, m1 = moments.source_mean, moments.target_mean
        if self.trend is not None:
            source, target = self.trend(observation)
            m0, m1 = m0 + source, m1 + target
        scale, unit = self._deviations(alpha, beta, d_alpha, d_beta)
        covariance = _combination(
            moments.source_variance, alpha * d_alpha, moments.target_variance, beta * d_beta
        )
        covariance = torch.addcmul(covariance, alpha * d_beta + d_alpha * beta, moments.covariance)
        slope = covariance * scale * scale
        centred = torch.addcmul(torch.addcmul(a, alpha, m0, value=-1), beta, m1, value=-1)
        learnt = self.network(t, centred * scale, observation)
        velocity = torch.addcmul(slope * centred, unit, learnt)
        return velocity + _combination(m0, d_alpha, m1, d_beta)


def _combination(x: Tensor, x_weight: Tensor, y: Tensor, y_weight: Tensor) -> Tensor:
    return torch.addcmul(x_weight * x, y_weight, y)
