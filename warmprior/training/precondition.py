"""What is known of a source and demonstrations before any training."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from warmprior.modules.network import VelocityNetwork
from warmprior.modules.ode import Interpolant
from warmprior.modules.preconditioning import PoseTrend, PreconditionedNetwork, RestingAction, SourceMoments
from warmprior.modules.prior import Prior
from warmprior.objectives.couplings import Coupling
from warmprior.transforms.window import window_replay_buffer, without_images

__all__ = ["precondition"]

TREND_BATCHES = 16
"""Of 1,024 windows, to which a :class:`PoseTrend` is fitted."""


def precondition(
    network: VelocityNetwork,
    data: TensorDictBase,
    prior: Prior,
    *,
    observation_steps: int = 2,
    coupling: Coupling | None = None,
    withhold: float = 0.0,
    rest: RestingAction | None = None,
    interpolant: Interpolant | None = None,
) -> PreconditionedNetwork:
    """Wrap a network in what is known of a prior's source and the demonstrations before any training.

    Args:
        network: the network to wrap.
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`.
        prior: the source distribution.

    Keyword Args:
        observation_steps: ``To``.
        coupling: how the training pairs sources and targets; as they come by default.
        withhold: share of the windows whose history is withheld.
        rest: for absolute actions, to take off what follows from where the grippers are.
        interpolant: the path, that of the loss; linear by default.

    Returns:
        The preconditioned network; the same for the same data and prior.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> from warmprior.envs import navigation_demonstrations
        >>> from warmprior.training import precondition
        >>> network = VelocityMLP(1, 9, prediction_length=4, observation_steps=1, hidden_dim=8)
        >>> demos = navigation_demonstrations()
        >>> type(precondition(network, demos, PastPrior(4), observation_steps=1)).__name__
        'PreconditionedNetwork'
    """
    generator = torch.Generator(data.device or "cpu").manual_seed(0)
    if coupling is None:  # which may look at them
        data = without_images(data)
    windows = window_replay_buffer(
        data,
        prior,
        batch_size=1024,
        observation_steps=observation_steps,
        withhold=withhold,
        generator=generator,
    )
    trend = None
    if rest is not None:
        batch = torch.cat([windows.sample() for _ in range(TREND_BATCHES)])
        trend = PoseTrend.fit(batch, prior, rest, generator=generator)
    moments = SourceMoments.fit(windows, prior, coupling=coupling, trend=trend, generator=generator)
    return PreconditionedNetwork(network, moments=moments, trend=trend, interpolant=interpolant)
