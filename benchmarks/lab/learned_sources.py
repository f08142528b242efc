"""Sources of other papers that are trained on the demonstrations before the flow, and their training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import AdamW
from torchrl.data import TensorDictReplayBuffer
from torchrl.modules import MLP

from warmprior import keys
from warmprior.checks import check_finite_numbers, check_positive, check_whole_numbers
from warmprior.modules.actor import StartPoint
from warmprior.modules.prior import GaussianPrior, PastPrior, Source
from warmprior.modules.schedule import warmup_cosine
from warmprior.transforms.window import window_replay_buffer, without_images

# Smallest calibrated standard deviation of a learned Gaussian source, in normalised action units.
SCALE_FLOOR = 0.02
CALIBRATION_WINDOWS = 4_096


class Learner(nn.Module):
    r"""A network :math:`f_\phi(o, h)` of observation and last ``H`` actions with a loss of its own.

    It is trained on the windows of the flow (:func:`learn`), and fixed afterwards. The last actions are read
    once there are ``H`` of them. Subclasses are also sources or start points. Observations are single
    tensors.
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
            self.action_dim, self.observation_dim, self.observation_steps = widths
            self.chunk_dim = self.chunk_length * self.action_dim
            observed = self.sees_observation * self.observation_steps * self.observation_dim
            self.input_dim = self.sees_history * (self.chunk_dim + 1) + observed
            self.build()
            self.requires_grad_(False)

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
            full = history["steps"] >= self.chunk_length
            actions = history["actions"][..., -self.chunk_length :, :]
            parts.append(torch.where(full.unsqueeze(-1), actions, 0.0).flatten(-2))
            parts.append(full.to(actions.dtype))
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


@dataclass(frozen=True)
class Drawn(Source):
    """A source with its own way of sampling."""

    by: Any = None  # a function of a generator and the temperature

    def sample(self, generator: torch.Generator | None = None, temperature: float = 1.0) -> Tensor:
        return self.by(generator, temperature)


class CVAEPrior(LearnedPrior):
    r"""BRIDGER's learned source: the decoder of a conditional variational autoencoder.

    .. math::
        a_0 = g_\phi(o, z) + \sigma \varepsilon, \quad z \sim N(0, I), \qquad
        \min_\phi E\left[\frac{1}{D} \|a_1 - g_\phi(o, z)\|^2
        + \beta \frac{d_z}{D} \, KL(q_\phi(z | o, a_1) \| N(0, I))\right]

    with :math:`D = P d_a` coordinates of a chunk and :math:`d_z` of ``z``; the first term is the mean over
    the coordinates inside the episode (Chen et al., 2024). The flow is the same as for other priors, while
    BRIDGER's path adds noise between the ends and is sampled as a stochastic differential equation. The
    source is not Gaussian and has no mean, so agents search around zero. `latent_dim` is the width of ``z``.
    """

    name = "cvae"
    default_sigma = 0.1
    sees_history = False

    def __init__(
        self,
        chunk_length: int,
        *,
        latent_dim: int = 8,
        beta: float = 0.01,
        widths: Sequence[int] | None = None,
        hidden_dim: int = 256,
        sigma: float | None = None,
    ) -> None:
        check_whole_numbers(latent_dim=latent_dim)
        check_positive(beta=beta)
        self.latent_dim, self.beta = latent_dim, beta
        super().__init__(chunk_length, widths=widths, hidden_dim=hidden_dim, sigma=sigma)

    def build(self) -> None:
        self.encoder = self.mlp(self.input_dim + self.chunk_dim, 2 * self.latent_dim)
        self.decoder = self.mlp(self.input_dim + self.latent_dim, self.chunk_dim)

    def decode(self, inputs: Tensor, z: Tensor) -> Tensor:
        return self.decoder(torch.cat([inputs, z], -1)).unflatten(-1, (-1, self.action_dim))

    mean = GaussianPrior.mean  # cold everywhere

    def distribution(self, history: TensorDictBase, observation: Any = None) -> Source:
        """Return a source that decodes a new latent for every sample; it is Gaussian given the latent."""
        source, inputs = super().distribution(history, observation), self.network_input(history, observation)

        def decoded(generator: torch.Generator | None, temperature: float) -> Tensor:
            like: dict[str, Any] = {"dtype": source.loc.dtype, "device": source.loc.device}
            z = torch.randn((*inputs.shape[:-1], self.latent_dim), generator=generator, **like)
            loc = self.decode(inputs, z if temperature == 1.0 else temperature * z)
            return replace(source, loc=loc, scale=loc.new_tensor(self.sigma)).sample(generator, temperature)

        return Drawn(source.loc, source.scale, source.warm, by=decoded)

    def learning_loss(self, windows: TensorDictBase, generator: torch.Generator | None = None) -> Tensor:
        inputs = self.network_input(windows[keys.HISTORY], windows[keys.OBSERVATION])
        inside = ~windows[keys.IS_PAD].unsqueeze(-1)
        encoded = self.encoder(torch.cat([inputs, (windows[keys.CHUNK] * inside).flatten(-2)], -1))
        mean, log_variance = encoded.chunk(2, -1)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        z = mean + (0.5 * log_variance).exp() * eps
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        error = inside_mean(windows, (windows[keys.CHUNK] - self.decode(inputs, z)).square())
        return error + self.beta * divergence / self.chunk_dim * self.latent_dim


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


def inside_mean(windows: TensorDictBase, values: Tensor) -> Tensor:
    """Return the mean over the coordinates of a chunk inside the episode; 0 if none is inside."""
    counted = (~windows[keys.IS_PAD]).unsqueeze(-1).expand_as(values)
    return (values * counted).sum() / counted.sum().clamp_min(1)


def learn(
    learner: Learner,
    data: TensorDictBase,
    *,
    iterations: int,
    learning_rate: float = 1e-3,
    observation_steps: int = 2,
    withhold: float = 0.0,
    seed: int = 0,
) -> None:
    """Train the networks of a learner in place, and calibrate it on held-out episodes.

    Every tenth episode is held out; with fewer than ten episodes, the second.
    """
    data = without_images(data)  # learners see no images
    episodes = data[keys.EPISODE].flatten()
    number = episodes.unique(return_inverse=True)[1]
    is_held_out = number % 10 == 9 if int(number.max()) >= 9 else number == 1
    device = data.device or torch.device("cpu")
    generator = torch.Generator(device).manual_seed(seed)

    def windows(part: TensorDictBase, size: int) -> TensorDictReplayBuffer:
        return window_replay_buffer(
            part,
            GaussianPrior(learner.chunk_length),
            batch_size=size,
            observation_steps=observation_steps,
            withhold=withhold,
            generator=generator,
        )

    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        learner.build()
        learner.to(device)
    buffer = windows(data[~is_held_out], 256)
    learner.requires_grad_(True).train()
    optimizer = AdamW(learner.parameters(), lr=learning_rate, weight_decay=1e-2, fused=True)
    schedule = warmup_cosine(optimizer, iterations, 0.1)
    for _ in range(iterations):
        loss = learner.learning_loss(buffer.sample(), generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    learner.requires_grad_(False).eval()
    if not all(bool(torch.isfinite(p).all()) for p in learner.parameters()):
        raise FloatingPointError(
            f"the networks of {type(learner).__name__} became NaN or infinite: lower the learning rate"
        )
    held_out = data[is_held_out] if bool(is_held_out.any()) else data
    with torch.no_grad():
        learner.calibrate(windows(held_out, CALIBRATION_WINDOWS).sample())
