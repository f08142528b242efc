"""BRIDGER's source: the decoder of a conditional variational autoencoder."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from warmprior.modules.checks import check_finite_numbers, check_whole_numbers
from warmprior.modules.learned import LearnedPrior
from warmprior.modules.learning_windows import LearningWindows

__all__ = ["CVAEPrior"]


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
        cold_probability: without effect, since the networks are given no last actions.

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
        self, windows: LearningWindows, generator: torch.Generator | None = None
    ) -> Tensor:
        """Mean squared error of the reconstruction, and divergence of the code."""
        seen = self.seen(windows.loc, windows.warm, windows.observation)
        found = self.encoder(torch.cat([seen, (windows.a1 * windows.counted).flatten(-2)], -1))
        mean, log_variance = found.chunk(2, -1)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        z = mean + (0.5 * log_variance).exp() * eps
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        error = windows.mean((windows.a1 - self._decode(seen, z)).square())
        return error + self.beta * divergence / self.chunk_dim * self.latent_dim
