"""Calibration: whether a source is as wide as its distance from the data."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase

from warmprior.diagnostics.flow import evaluation_mode, flat_windows
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Source

__all__ = ["source_coverage"]


def source_coverage(policy: WarmPriorActor, windows: TensorDictBase, *, level: float = 0.9) -> float:
    r"""Share of the target's coordinates inside the central interval of a Gaussian source.

    A calibrated source covers ``level``. One that covers less trusts its mean too much; one that covers
    everything is too wide, as N(0, I) is around normalised actions.

    Args:
        policy: the policy, whose prior gives the source (:meth:`Prior.distribution`).
        windows: ``[*B]`` of its prior with targets, see :meth:`SharedObservations.met`; held-out ones for a
            learned source.

    Keyword Args:
        level: of the interval :math:`\mu \pm z s`.

    Returns:
        Over the executed positions inside the episode; NaN for sources that are not Gaussian.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: for bad windows, or a ``level`` outside (0, 1).

    Examples:
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, source_coverage
        >>> from warmprior.envs import navigation_demonstrations
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), GaussianPrior(4))
        >>> source_coverage(actor, SharedObservations(navigation_demonstrations(), 4).windows(actor.prior))
        1.0
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level}")
    flat, prior = flat_windows(policy, windows, target_needed=True), policy.prior
    assert flat.target is not None
    with evaluation_mode(policy):
        source = prior.distribution(flat.history, flat.observation)
    if type(source) is not Source:
        return math.nan
    z = math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    inside = (flat.target - source.loc).abs() <= z * source.scale
    executed = slice(prior.chunk_length)
    return float(
        inside[:, executed][flat.counted[:, executed].expand_as(inside[:, executed])].double().mean()
    )
