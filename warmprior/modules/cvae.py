"""The decoder of a conditional variational autoencoder as a source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.modules import MLP

from warmprior import keys
from warmprior.checks import check_positive, check_shape, check_whole_numbers, given
from warmprior.modules.learning import inside_mean, minimise, widths_of
from warmprior.modules.prior import GaussianPrior, Prior
from warmprior.modules.source import Source


@dataclass(frozen=True, kw_only=True)
class _Decoded(Source):
    """A source that decodes a new latent for every sample; it is Gaussian given the latent."""

    prior: CVAEPrior
    inputs: Tensor

    def sample(self, generator: torch.Generator | None = None, temperature: float = 1.0) -> Tensor:
        inputs, prior = self.inputs, self.prior
        like = {"dtype": inputs.dtype, "device": inputs.device, **given(generator=generator)}
        z = torch.randn((*inputs.shape[:-1], prior.latent_dim), **like)
        loc = prior.decode(inputs, z if temperature == 1.0 else temperature * z).to(self.loc.dtype)
        return Source(loc, loc.new_full((), prior.sigma), self.warm).sample(generator, temperature)


class CVAEPrior(Prior, nn.Module):
    r"""BRIDGER's learned source: the decoder of a conditional variational autoencoder.

    .. math::
        a_0 = g_\phi(o, z) + \sigma \varepsilon, \quad z \sim N(0, I), \qquad
        \min_\phi E\left[\frac{1}{D} \|a_1 - g_\phi(o, z)\|^2
        + \beta \frac{d_z}{D} \, KL(q_\phi(z | o, a_1) \| N(0, I))\right]

    with :math:`D = P d_a` coordinates of a chunk and :math:`d_z` of ``z``; the first term is the mean over
    the coordinates inside the episode (`Chen et al., 2024 <https://arxiv.org/abs/2402.16075>`_). The flow is
    the same as for other priors, while BRIDGER's path adds noise between the ends and is sampled as a
    stochastic differential equation. :func:`~warmprior.training.train_policy` trains it before the flow.

    The source is not Gaussian and has no mean, so agents search around zero. It reads observations that are
    vectors, and no history.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.
        latent_dim: width of ``z``.
        beta: weight of the divergence, per coordinate of ``z``.
        hidden_dim: width of both hidden layers of encoder and decoder.
        widths: ``d_a``, ``d_o`` and ``To``, which :meth:`fit` sets.
        sigma: standard deviation around a decoded chunk, 0.1 by default.

    Raises:
        ValueError: if a number is out of range; by :meth:`fit` if the observations are images; by
            :meth:`distribution` if it is not trained yet, or the observation has another shape.

    Examples:
        >>> from warmprior import CVAEPrior
        >>> from warmprior.envs import navigation_demonstrations
        >>> from warmprior.training import TrainingConfig, train_policy
        >>> recipe = TrainingConfig(iterations=4)  # 10,000 by default
        >>> actor = train_policy(navigation_demonstrations(), CVAEPrior(8), training=recipe, description=None)
        >>> actor.prior
        CVAEPrior(chunk_length=8, latent_dim=8, beta=0.01, hidden_dim=256, widths=[1, 9, 2], sigma=0.1)
    """

    name = "cvae"
    default_sigma = 0.1

    def __init__(
        self,
        chunk_length: int,
        *,
        latent_dim: int = 8,
        beta: float = 0.01,
        hidden_dim: int = 256,
        widths: Sequence[int] | None = None,
        sigma: float | None = None,
    ) -> None:
        nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma)
        check_whole_numbers(latent_dim=latent_dim, hidden_dim=hidden_dim)
        check_positive(beta=beta)
        self.latent_dim, self.beta, self.hidden_dim = latent_dim, beta, hidden_dim
        self.widths: list[int] | None = None
        if widths is not None:
            self._build(list(widths))
            self.requires_grad_(False)

    def _build(self, widths: list[int]) -> None:
        """Make the networks, with fresh weights."""
        self.widths = widths
        chunk, read = self.chunk_length * widths[0], self.input_dim(*widths)
        layers: dict[str, Any] = {"num_cells": [self.hidden_dim] * 2, "activation_class": nn.GELU}
        self.encoder = MLP(read + chunk, 2 * self.latent_dim, **layers)
        self.decoder = MLP(read + self.latent_dim, chunk, **layers)

    def input_dim(self, action_dim: int, observation_dim: int, observation_steps: int) -> int:
        """Return the width of :meth:`network_input`."""
        return observation_steps * observation_dim

    def network_input(self, history: TensorDictBase | None, observation: Tensor) -> Tensor:
        """Return what encoder and decoder read: the observation ``[*B, To, d_o]`` as ``[*B, To d_o]``."""
        return observation.flatten(-2).to(self.decoder[0].weight.dtype)

    mean = GaussianPrior.mean  # cold everywhere

    def distribution(self, history: TensorDictBase, observation: Any = None) -> Source:
        """Return the source; its mean and scale, those of N(0, I), are for agents."""
        if self.widths is None or observation is None:
            raise ValueError("CVAEPrior reads the observation, and learns before the flow: see train_policy")
        source = super().distribution(history, observation)
        _, width, steps = self.widths
        check_shape("the observation of CVAEPrior", observation, (*source.loc.shape[:-2], steps, width))
        inputs = self.network_input(history, observation)
        return _Decoded(source.loc, source.scale, source.warm, prior=self, inputs=inputs)

    def decode(self, inputs: Tensor, z: Tensor) -> Tensor:
        """Return the chunks ``[*B, P, d_a]`` of :meth:`network_input` and latents ``[*B, d_z]``."""
        return self.decoder(torch.cat([inputs, z], -1)).unflatten(-1, (self.chunk_length, -1))

    def fit(
        self,
        windows: ReplayBuffer,
        held_out: ReplayBuffer,
        *,
        iterations: int,
        generator: torch.Generator,
    ) -> None:
        """Train encoder and decoder; ``held_out`` is not read."""
        self._build(widths_of(windows, self))
        minimise(self.learning_loss, self, windows, iterations=iterations, generator=generator)

    def learning_loss(self, windows: TensorDictBase, generator: torch.Generator | None = None) -> Tensor:
        """Return the loss above on windows."""
        inputs = self.network_input(windows.get(keys.HISTORY, None), windows[keys.OBSERVATION])
        target = windows[keys.CHUNK].to(inputs.dtype)
        inside = ~windows[keys.IS_PAD].unsqueeze(-1)
        encoded = self.encoder(torch.cat([inputs, (target * inside).flatten(-2)], -1))
        mean, log_variance = encoded.chunk(2, -1)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        z = mean + (0.5 * log_variance).exp() * eps
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        error = inside_mean(windows, (target - self.decode(inputs, z)).square())
        return error + self.beta * divergence / target[0].numel() * self.latent_dim
