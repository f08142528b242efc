"""Sources of other papers that learn from the demonstrations before the flow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.modules import MLP

from warmprior import keys
from warmprior.checks import check_finite_numbers, check_whole_numbers
from warmprior.modules.actor import StartPoint
from warmprior.modules.cvae import CVAEPrior
from warmprior.modules.learning import inside_mean, minimise, widths_of
from warmprior.modules.prior import PastPrior
from warmprior.modules.source import Source

# Smallest calibrated standard deviation of a learned Gaussian source, in normalised action units.
SCALE_FLOOR = 0.02


def last_chunk(history: TensorDictBase, length: int) -> Tensor:
    """Return the last actions, ``[*B, length d_a + 1]``: zeros until there are so many, with a 1 after."""
    full = (history["steps"] >= length).unsqueeze(-1)
    actions = history["actions"][..., -length:, :]
    return torch.cat([torch.where(full, actions, 0.0).flatten(-2), full[..., 0].to(actions.dtype)], -1)


class Learner(nn.Module):
    r"""A network :math:`f_\phi(o, h)` of observation and last ``H`` actions with a loss of its own.

    It is trained on the windows of the flow, and fixed afterwards. The last actions are read once there are
    ``H`` of them. Subclasses are also sources or start points, whose :meth:`Prior.fit` it replaces.
    Observations are single tensors.
    """

    sees_history: ClassVar[bool] = True
    sees_observation: ClassVar[bool] = True
    heads: ClassVar[int] = 1  # number of chunks that the network predicts
    chunk_length: int
    chunk_dim: int  # numbers in a chunk, H d_a
    input_dim: int  # numbers in the network's input

    def _set_widths(self, widths: Sequence[int] | None, hidden_dim: int) -> None:
        """Set the widths and make the networks; without widths, only note the width of hidden layers."""
        check_whole_numbers(hidden_dim=hidden_dim)
        self.widths, self.hidden_dim = widths, hidden_dim
        if widths is not None:
            self.action_dim, observation_dim, observation_steps = widths
            self.chunk_dim = self.chunk_length * self.action_dim
            observed = self.sees_observation * observation_steps * observation_dim
            self.input_dim = self.sees_history * (self.chunk_dim + 1) + observed
            self.build()
            self.requires_grad_(False)

    def fit(
        self,
        windows: ReplayBuffer,
        held_out: ReplayBuffer,
        *,
        iterations: int,
        generator: torch.Generator,
    ) -> None:
        """Train the networks, and calibrate them on held-out episodes."""
        self._set_widths(widths_of(windows, self if self.sees_observation else None), self.hidden_dim)
        minimise(self.learning_loss, self, windows, iterations=iterations, generator=generator)
        with torch.no_grad():
            self.calibrate(held_out.sample())

    def build(self) -> None:
        self.network = self.mlp(self.input_dim, self.heads * self.chunk_dim)

    def learning_loss(self, windows: TensorDictBase, generator: torch.Generator | None = None) -> Tensor:
        """Return the loss of the networks on windows; by default the mean squared error."""
        predicted = self.predicted(windows[keys.HISTORY], windows[keys.OBSERVATION])
        return inside_mean(windows, (windows[keys.CHUNK] - predicted).square())

    def calibrate(self, windows: TensorDictBase) -> None:
        """Correct the source by its error on held-out windows; by default do nothing."""

    def mlp(self, inputs: int, outputs: int) -> MLP:
        return MLP(inputs, outputs, num_cells=[self.hidden_dim] * 2, activation_class=nn.GELU)

    def network_input(self, history: TensorDictBase, observation: Any) -> Tensor:
        """Return the input of the network, ``[*B, input_dim]``."""
        parts = [observation.flatten(-2)] if self.sees_observation else []
        if self.sees_history:
            parts.append(last_chunk(history, self.chunk_length))
        return torch.cat(parts, -1)

    def predicted(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return the predicted chunks, ``[*B, H, d_a]``, with several heads ``[*B, heads H, d_a]``."""
        return self.network(self.network_input(history, observation)).unflatten(-1, (-1, self.action_dim))


class LearnedPrior(PastPrior, Learner, abstract=True):
    """Base class of learned sources around which agents can search; all positions are warm.

    `widths` are ``d_a``, ``d_o`` and ``To``, known once there are data; `hidden_dim` is the width of both
    hidden layers.
    """

    def __init__(
        self,
        chunk_length: int,
        *,
        widths: Sequence[int] | None = None,
        hidden_dim: int = 256,
        sigma: float | None = None,
    ) -> None:
        nn.Module.__init__(self)
        PastPrior.__init__(self, chunk_length, sigma=sigma)
        self._set_widths(widths, hidden_dim)

    fit = Learner.fit

    def _everywhere(self, loc: Tensor, scale: Tensor) -> Source:
        return Source(loc, scale, torch.ones_like(loc[..., :1], dtype=torch.bool))


class ForecastPrior(LearnedPrior):
    r"""A learned Gaussian source: mean and scale from observation and last actions, calibrated.

    .. math::
        a_0 = \mu_\phi(o, h) + s_\phi(o, h) \varepsilon, \qquad
        \min_\phi E\left[\log s_\phi + \tfrac12 (a_1 - \mu_\phi)^2 / s_\phi^2\right],

    per position and dimension. Afterwards :math:`s_\phi` is multiplied, per position and dimension, by the
    root mean square of :math:`(a_1 - \mu_\phi) / s_\phi` on held-out episodes: a scale smaller than the error
    is widened, and one larger than the error is narrowed, down to 0.02. ``sigma`` multiplies the result.
    """

    calibration: Tensor
    typical_scale: Tensor
    name = "forecast"
    default_sigma = 1.0
    heads = 2  # mean and scale

    def build(self) -> None:
        super().build()
        self.register_buffer("calibration", torch.ones(self.chunk_length, self.action_dim))
        self.register_buffer("typical_scale", torch.ones(()))

    def _calibrated(self, scale: Tensor) -> Tensor:
        return (self.calibration * scale).clamp_min(SCALE_FLOOR)

    def _gaussian(self, history: TensorDictBase, observation: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return mean and scale before the calibration."""
        mean, raw = self.predicted(history, observation).chunk(2, -2)
        return mean, SCALE_FLOOR + nn.functional.softplus(raw)

    def distribution(self, history: TensorDictBase, observation: Any = None) -> Source:
        mean, scale = self._gaussian(history, observation)
        return self._everywhere(mean, self.sigma * self._calibrated(scale))

    def learning_loss(self, windows: TensorDictBase, generator: torch.Generator | None = None) -> Tensor:
        mean, scale = self._gaussian(windows[keys.HISTORY], windows[keys.OBSERVATION])
        return inside_mean(windows, scale.log() + 0.5 * ((windows[keys.CHUNK] - mean) / scale).square())

    def calibrate(self, windows: TensorDictBase) -> None:
        """Set the calibration to the RMS of the standardised error, and note the resulting scale."""
        mean, scale = self._gaussian(windows[keys.HISTORY], windows[keys.OBSERVATION])
        counted = ~windows[keys.IS_PAD].unsqueeze(-1)
        squared = ((windows[keys.CHUNK] - mean) / scale).square() * counted
        count = counted.sum(0).clamp_min(1)
        variance = torch.where(counted.any(0), squared.sum(0) / count, 1.0)
        self.calibration.copy_(variance.sqrt())
        self.typical_scale.copy_(inside_mean(windows, self._calibrated(scale).square()).sqrt())


class LeapPrior(ForecastPrior):
    """LeaP (arXiv:2606.17408): the Gaussian source of :class:`ForecastPrior` from the observation alone."""

    name = "leap"
    sees_history = False


class A2APrior(LearnedPrior):
    r"""A2A in action space: a deterministic source :math:`a_0 = f_\phi(h)` from the last actions alone.

    A2A (Jia et al., 2026) encodes a history into the source of a flow between latent codes of chunks, without
    any noise. Here the code of a chunk is the chunk itself, the history is that of WP-Past, and
    :math:`f_\phi` is trained to predict the target by mean squared error before the flow is trained.
    """

    name = "a2a"
    default_sigma = 0.0
    sees_observation = False

    def distribution(self, history: TensorDictBase, observation: Any = None) -> Source:
        mean = self.predicted(history, observation)
        return self._everywhere(mean, torch.full_like(mean[..., :1], self.sigma))


class CVAEHistoryPrior(CVAEPrior):
    """The source of :class:`CVAEPrior` from the observation and the last ``H`` actions."""

    name = "cvae-history"
    sees_history: ClassVar[bool] = True

    def input_dim(self, action_dim: int, observation_dim: int, observation_steps: int) -> int:
        observed = super().input_dim(action_dim, observation_dim, observation_steps)
        return observed + self.chunk_length * action_dim + 1

    def network_input(self, history: Any, observation: Tensor) -> Tensor:
        observed = super().network_input(history, observation)
        return torch.cat([observed, last_chunk(history, self.chunk_length).to(observed.dtype)], -1)


class ForecastStart(StartPoint, Learner):
    r"""STEP: a forecast enters the flow of a standard normal source at an intermediate time.

    The flow is trained as usual, from N(0, I). At decisions a forecaster :math:`f_\phi(o, h)`, trained by
    mean squared error, gives

    .. math::
        a_{t_s} = (1 - t_s) \varepsilon + t_s f_\phi(o, h),

    from which the flow is integrated to ``t = 1`` (Li et al., 2026). If the forecast hardly differs from the
    last chunk (root mean square distance per coordinate below ``stall``, in normalised action units), the
    robot may be stuck, and the noise is multiplied by ``1 + stall_noise`` (velocity-aware noise).
    """

    name = "step"

    def __init__(
        self,
        chunk_length: int,
        *,
        start_time: float = 0.5,
        stall: float = 0.02,
        stall_noise: float = 0.1,
        widths: Sequence[int] | None = None,
        hidden_dim: int = 256,
    ) -> None:
        check_finite_numbers(start_time=start_time, stall=stall, stall_noise=stall_noise)
        if not 0.0 < start_time < 1.0 or stall < 0:
            raise ValueError(f"need 0 < start_time < 1 and stall >= 0, got {start_time} and {stall}")
        nn.Module.__init__(self)
        self.chunk_length = chunk_length
        self.start_time = self.time = start_time
        self.noise_share = 1.0 - start_time
        self.stall, self.stall_noise = stall, stall_noise
        self._set_widths(widths, hidden_dim)

    fit = Learner.fit

    def centre(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return the forecast times the start time."""
        return self.time * self.predicted(history, observation)

    def forward(self, noise: Tensor, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return noise and forecast, mixed as on the path at ``start_time``."""
        forecast = self.predicted(history, observation)
        last = history["actions"][..., -self.chunk_length :, :]
        moved = (forecast - last).square().mean((-1, -2), keepdim=True).sqrt()
        full = (history["steps"] >= self.chunk_length).unsqueeze(-1)
        noise = torch.where(full & (moved < self.stall), (1 + self.stall_noise) * noise, noise)
        return (1 - self.time) * noise + self.time * forecast
