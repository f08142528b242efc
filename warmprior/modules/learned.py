"""Sources that learn from the demonstrations before the flow does."""

from __future__ import annotations

from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from warmprior.modules.checks import check_finite_numbers, check_whole_numbers
from warmprior.modules.priors import PastPrior

__all__ = ["A2APrior", "CVAEPrior", "ForecastPrior", "LeapPrior", "LearnedPrior", "StepPrior"]

SCALE_FLOOR = 0.02
"""Smallest standard deviation of a learned Gaussian source, calibrated, in normalised action units and
before ``sigma`` multiplies it."""


class LearnedPrior(PastPrior, nn.Module):
    r"""Base class of priors with a network :math:`f_\phi(o, \mu)` of observation and last ``H`` actions.

    It learns by a loss of its own, on the windows that the flow will be trained on
    (:func:`~warmprior.training.learn_prior`), and is fixed from then on: the flow, and the moments that it
    is preconditioned with, see one and the same source. The mean that it starts from,
    :math:`\mu`, is that of :class:`PastPrior`. Subclasses make their networks in :meth:`build`, and override
    :meth:`learning_loss` and :meth:`distribution` (or :meth:`sample`). Observations are single tensors.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        action_dim: ``d_a``; like the other widths it is filled in by :meth:`sized`.
        observation_dim: ``d_o``.
        observation_steps: ``To``.
        hidden_dim: width of the network's two hidden layers.
        sigma: see the subclass.
        cold_probability: see :class:`Prior`.

    Raises:
        ValueError: if only some of the widths are given, or one is no whole number of at least 1.

    Examples:
        >>> import torch
        >>> from torch import nn
        >>> class Shifted(LearnedPrior):  # the last chunk, with a learned shift
        ...     name = "shifted"
        ...     def build(self):
        ...         self.shift = nn.Parameter(torch.zeros(self.action_dim))
        ...     def distribution(self, loc, warm, observation=None):
        ...         return super().distribution(loc + self.shift, warm, observation)
        ...     def learning_loss(self, a1, counted, loc, warm, observation, generator=None):
        ...         return ((a1 - loc - self.shift).square() * (warm & counted)).mean()
        >>> prior = Shifted(4, sigma=0.1)
        >>> prior.is_sized, prior.sized(action_dim=2, observation_dim=3, observation_steps=1).shift
        (False, Parameter containing: tensor([0., 0.]))
    """

    sees_history: ClassVar[bool] = True
    """Whether the network is given the last actions."""
    sees_observation: ClassVar[bool] = True
    """Whether the network is given the observation."""
    untold = PastPrior.untold | {"action_dim", "observation_dim", "observation_steps"}
    action_dim: int
    observation_dim: int
    observation_steps: int

    def __init__(
        self,
        chunk_length: int,
        *,
        action_dim: int | None = None,
        observation_dim: int | None = None,
        observation_steps: int | None = None,
        hidden_dim: int = 256,
        sigma: float | None = None,
        cold_probability: float = 0.0,
    ) -> None:
        nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma, cold_probability=cold_probability)
        given = (action_dim, observation_dim, observation_steps)
        widths = [width for width in given if width is not None]
        if len(widths) not in (0, 3):
            raise ValueError(
                f"{type(self).__name__} needs action_dim, observation_dim and observation_steps, or none of "
                f"them, got {given}"
            )
        check_whole_numbers(hidden_dim=hidden_dim)
        if widths:
            check_whole_numbers(
                action_dim=action_dim,
                observation_dim=observation_dim,
                observation_steps=observation_steps,
            )
        self.hidden_dim, self.is_sized = hidden_dim, bool(widths)
        if self.is_sized:
            self.action_dim, self.observation_dim, self.observation_steps = widths
            self.build()
            self.requires_grad_(False)

    @property
    def chunk_dim(self) -> int:
        """Numbers in a chunk, ``P d_a``."""
        return self.prediction_length * self.action_dim

    @property
    def seen_dim(self) -> int:
        """Numbers that the network is given.

        Raises:
            ValueError: if the widths are not known.
        """
        self._check_sized()
        history = self.chunk_length * self.action_dim + 1
        observed = self.observation_steps * self.observation_dim
        return self.sees_history * history + self.sees_observation * observed

    def build(self) -> None:
        """Make the networks, once the widths are known."""
        raise NotImplementedError

    def mlp(self, inputs: int, outputs: int) -> MLP:
        """A network of the prior's width.

        Args:
            inputs: its number of inputs.
            outputs: its number of outputs.
        """
        return MLP(inputs, outputs, num_cells=[self.hidden_dim] * 2, activation_class=nn.GELU)

    def sized(self, action_dim: int, observation_dim: int, observation_steps: int) -> Self:
        """The prior with fresh networks for data of these widths; itself if it has them already."""
        widths: dict[str, Any] = {
            "action_dim": action_dim,
            "observation_dim": observation_dim,
            "observation_steps": observation_steps,
        }
        if self.is_sized:
            mine = {name: getattr(self, name) for name in widths}
            if mine != widths:
                raise ValueError(f"{self.name} was built for {mine}, but the data have {widths}")
            return self
        return type(self)(**(self._resolved() | widths))

    def seen(self, loc: Tensor, warm: Tensor, observation: Tensor | None) -> Tensor:
        """What the network is given, ``[*B, seen_dim]``.

        Raises:
            ValueError: if there is no observation or a nested one, or the networks were not built.
        """
        self._check_sized()
        parts = []
        if self.sees_observation:
            if observation is None:
                raise ValueError(
                    f"{self.name} needs the observation: give the sampler its observation_key"
                )
            if not isinstance(observation, Tensor):
                raise ValueError(
                    f"{self.name} takes one tensor [*B, To, d_o] as the observation, and no nested one: "
                    "concatenate its entries, or use a prior that sees none"
                )
            parts.append(observation.flatten(-2))
        if self.sees_history:
            known = warm[..., 0, :].to(loc.dtype)
            parts += [torch.where(warm, loc, 0.0).flatten(-2), known]
        return torch.cat(parts, -1)

    def _check_sized(self) -> None:
        if not self.is_sized:
            raise ValueError(
                f"{self.name} has no networks yet: take prior.sized(d_a, d_o, To), and learn_prior to "
                "train it"
            )

    def learning_loss(
        self,
        a1: Tensor,
        counted: Tensor,
        loc: Tensor,
        warm: Tensor,
        observation: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """What the prior's networks minimise.

        Args:
            a1: targets, ``[B, P, d_a]``.
            counted: positions inside the episode, bool ``[B, P, 1]``.
            loc: mean of :class:`PastPrior`, ``[B, P, d_a]``.
            warm: bool ``[B, P, 1]``.
            observation: ``[B, To, d_o]``.
            generator: source of randomness on their device.

        Returns:
            A scalar.
        """
        raise NotImplementedError

    def calibrate(
        self, a1: Tensor, counted: Tensor, loc: Tensor, warm: Tensor, observation: Tensor
    ) -> None:
        """Correct the source by its error on windows that it did not learn from; nothing by default.

        Args:
            a1: see :meth:`learning_loss`.
            counted: see :meth:`learning_loss`.
            loc: see :meth:`learning_loss`.
            warm: see :meth:`learning_loss`.
            observation: see :meth:`learning_loss`.
        """


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Mean over the coordinates inside the episode."""
    counted = counted.expand_as(values)
    return (values * counted).sum() / counted.sum().clamp_min(1)


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
    color = "#7b3294"
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
        self,
        a1: Tensor,
        counted: Tensor,
        loc: Tensor,
        warm: Tensor,
        observation: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Negative log-likelihood per coordinate, without its constant."""
        mean, scale = self._gaussian(loc, warm, observation)
        return _mean(scale.log() + 0.5 * ((a1 - mean) / scale).square(), counted)

    def calibrate(
        self, a1: Tensor, counted: Tensor, loc: Tensor, warm: Tensor, observation: Tensor
    ) -> None:
        """Scale by the root mean square of the standardised error, and note what scale that gives."""
        mean, scale = self._gaussian(loc, warm, observation)
        squared = ((a1 - mean) / scale).square() * counted
        known = counted.sum(0).clamp_min(1)
        found = torch.where(counted.any(0), squared.sum(0) / known, 1.0)
        self.calibration.copy_(found.sqrt())
        self.typical_scale.copy_(_mean(self._calibrated(scale).square(), counted).sqrt())


class LeapPrior(ForecastPrior):
    """A learnable prior: the Gaussian source of :class:`ForecastPrior` from the observation alone.

    Args:
        chunk_length: ``H``.

    Examples:
        >>> import torch
        >>> prior = LeapPrior(4).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.rand(5, 4, 2), torch.ones(5, 4, 1, dtype=torch.bool)
        >>> mean, _ = prior.distribution(loc, warm, torch.zeros(5, 1, 3))
        >>> bool((mean == mean[0]).all())  # the last actions play no role
        True
    """

    name = "leap"
    label = "Learnable prior"
    color = "#b8a9c9"
    sees_history = False


class PointForecastPrior(LearnedPrior):
    r"""Base class of learned priors whose network forecasts the chunk, by mean squared error."""

    always_warm = True

    def build(self) -> None:
        """The forecaster."""
        self.network = self.mlp(self.seen_dim, self.chunk_dim)

    def forecast(self, loc: Tensor, warm: Tensor, observation: Tensor | None) -> Tensor:
        """The forecast chunk, ``[*B, P, d_a]``."""
        seen = self.seen(loc, warm, observation)
        return self.network(seen).unflatten(-1, (self.prediction_length, self.action_dim))

    def learning_loss(
        self,
        a1: Tensor,
        counted: Tensor,
        loc: Tensor,
        warm: Tensor,
        observation: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Mean squared error."""
        return _mean((a1 - self.forecast(loc, warm, observation)).square(), counted)


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
    color = "#bf812d"
    default_sigma = 0.0
    sees_observation = False

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The encoded history, and ``sigma`` around it, 0 by default."""
        mean = self.forecast(loc, warm, observation)
        return mean, torch.full_like(mean[..., :1], self.sigma)


class CVAEPrior(LearnedPrior):
    r"""BRIDGER's learned source: the decoder of a conditional variational autoencoder.

    .. math::
        a_0 = g_\phi(o, z) + \sigma \varepsilon, \quad z \sim N(0, I), \qquad
        \min_\phi E\left[\frac{1}{D} \|a_1 - g_\phi(o, z)\|^2
        + \beta \frac{d_z}{D} \, KL(q_\phi(z | o, a_1) \| N(0, I))\right]

    with :math:`D = P d_a` coordinates of a chunk and :math:`d_z` of ``z``; the first term is the mean over
    the coordinates inside the episode (Chen et al., 2024). The flow from it is that of every other prior;
    BRIDGER's own path adds noise between the ends and is sampled as a stochastic differential equation.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        latent_dim: width of ``z``.
        beta: weight of the divergence.
        action_dim: see :class:`LearnedPrior`.
        observation_dim: likewise.
        observation_steps: likewise.
        hidden_dim: likewise.
        sigma: noise of the source around the decoder's output.
        cold_probability: see :class:`Prior`.

    Raises:
        ValueError: if ``latent_dim`` is no whole number of at least 1, or ``beta`` no finite number > 0.

    Examples:
        >>> import torch
        >>> prior = CVAEPrior(4, latent_dim=2).sized(action_dim=2, observation_dim=3, observation_steps=1)
        >>> loc, warm = torch.zeros(5, 4, 2), torch.zeros(5, 4, 1, dtype=torch.bool)
        >>> prior.sample(loc, warm, observation=torch.zeros(5, 1, 3)).shape
        torch.Size([5, 4, 2])
    """

    name = "cvae"
    label = "CVAE source"
    color = "#c51b7d"
    default_sigma = 0.1
    sees_history = False
    latent_dim: int
    beta: float

    def __init__(
        self,
        chunk_length: int,
        *,
        latent_dim: int = 8,
        beta: float = 0.01,
        action_dim: int | None = None,
        observation_dim: int | None = None,
        observation_steps: int | None = None,
        hidden_dim: int = 256,
        sigma: float | None = None,
        cold_probability: float = 0.0,
    ) -> None:
        check_whole_numbers(latent_dim=latent_dim)
        check_finite_numbers(beta=beta)
        if beta <= 0:
            raise ValueError(f"beta must be a finite number > 0, got {beta}")
        self.__dict__.update(latent_dim=latent_dim, beta=beta)
        super().__init__(
            chunk_length,
            action_dim=action_dim,
            observation_dim=observation_dim,
            observation_steps=observation_steps,
            hidden_dim=hidden_dim,
            sigma=sigma,
            cold_probability=cold_probability,
        )

    def build(self) -> None:
        """Encoder and decoder."""
        self.encoder = self.mlp(self.seen_dim + self.chunk_dim, 2 * self.latent_dim)
        self.decoder = self.mlp(self.seen_dim + self.latent_dim, self.chunk_dim)

    @property
    def moves_source(self) -> bool:
        """No: the source is no Gaussian, and an agent searches around zero."""
        return False

    def _decode(self, seen: Tensor, z: Tensor) -> Tensor:
        out = self.decoder(torch.cat([seen, z], -1))
        return out.unflatten(-1, (self.prediction_length, self.action_dim))

    def sample(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Decode a draw of ``z``, and add noise."""
        seen = self.seen(loc, warm, observation)
        like: dict[str, Any] = {"dtype": loc.dtype, "device": loc.device}
        z = torch.randn(*seen.shape[:-1], self.latent_dim, generator=generator, **like)
        eps = torch.randn(loc.shape, generator=generator, **like)
        return self._decode(seen, z) + self.sigma * eps

    def learning_loss(
        self,
        a1: Tensor,
        counted: Tensor,
        loc: Tensor,
        warm: Tensor,
        observation: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Mean squared error of the reconstruction, and divergence of the code."""
        seen = self.seen(loc, warm, observation)
        found = self.encoder(torch.cat([seen, (a1 * counted).flatten(-2)], -1))
        mean, log_variance = found.chunk(2, -1)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        z = mean + (0.5 * log_variance).exp() * eps
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        error = _mean((a1 - self._decode(seen, z)).square(), counted)
        return error + self.beta * divergence / self.chunk_dim * self.latent_dim


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
    color = "#35978f"
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
