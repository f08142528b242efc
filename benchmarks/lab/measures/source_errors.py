"""Distances of a source from demonstrated actions, and from its policy's predictions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import Source, WarmPriorActor, keys
from warmprior.checks import check_keys
from warmprior.diagnostics.flow import drawn, evaluation_mode, flat_windows, inputs_and_targets, predict


@dataclass(frozen=True)
class MeanError:
    """Root mean square errors of a source's mean over warm positions inside the episode; NaN without any.

    Attributes:
        target: distance of the mean from the demonstrated actions.
        revision: distance of the mean from the policy's prediction.

    Examples:
        >>> from lab.measures.source_errors import MeanError
        >>> MeanError(target=0.17, revision=0.2)  # see mean_error
        MeanError(target=0.17, revision=0.2)
    """

    target: float
    revision: float


def mean_error(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfe: int | None = None,
) -> MeanError:
    """Measure the error of the mean at demonstrated states, in normalised action units.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior, with the history of deployment
            (:meth:`SharedObservations.deployed`); in training WP-Preview's mean is the target itself.
        nfe: network evaluations of the prediction; the policy's own by default.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: for bad windows.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import PreviewPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.source_errors import mean_error
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1), PreviewPrior(4))
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> mean_error(untrained, shared.windows(untrained.prior)).target  # the target itself
        0.0
    """
    flat, target, chunk = _predicted(policy, windows, nfe)
    mean = flat[keys.LOC]
    warm = (flat[keys.WARM] & flat["counted"]).expand_as(mean)
    return MeanError(_rms((mean - target)[warm]), _rms((mean - chunk)[warm]))


def _predicted(
    policy: WarmPriorActor, windows: TensorDictBase, nfe: int | None
) -> tuple[TensorDictBase, Tensor, Tensor]:
    """Return windows, targets and the policy's chunks, from draws of a fixed seed."""
    flat, target, rows, generator = inputs_and_targets(policy, windows)
    with evaluation_mode(policy):
        noise = drawn(policy, rows, generator)
        return flat, target, predict(policy, rows, noise, policy.sampling.evaluations(nfe))


def error_by_position(
    policy: WarmPriorActor, windows: TensorDictBase, *, nfe: int | None = None
) -> tuple[list[float], list[float]]:
    """Measure how far the source's mean, and the policy's chunk, are from the demonstrated actions.

    Args:
        policy: the policy; its state stays as it is.
        windows: as of :func:`mean_error`.
        nfe: network evaluations of the chunk; the policy's own by default.

    Returns:
        Two lists of root mean squares over windows and dimensions, one entry per executed position, in
        normalised action units.

    Examples:
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.source_errors import error_by_position
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), GaussianPrior(4))
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> [len(errors) for errors in error_by_position(untrained, shared.windows(untrained.prior), nfe=1)]
        [4, 4]
    """
    flat, target, chunk = _predicted(policy, windows, nfe)
    counted = flat["counted"].squeeze(-1)
    executed = range(policy.prior.chunk_length)
    mean, prediction = (
        [_rms((actions - target)[:, k][counted[:, k]]) for k in executed]
        for actions in (flat[keys.LOC], chunk)
    )
    return mean, prediction


def mean_revision(rollout: TensorDictBase) -> float:
    """Measure the distance of the mean from the policy's next prediction, along rollouts.

    If it is larger than at demonstrated states (:attr:`MeanError.revision`), forecasts are worse in the
    states that the policy reaches than in the demonstrations.

    Args:
        rollout: ``[D]`` decisions with what the policy wrote, see :class:`~warmprior.evaluation.Episode`.

    Returns:
        Root mean square over warm positions and dimensions, in normalised action units; NaN if none is warm.

    Raises:
        KeyError: if a key is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from lab.measures.source_errors import mean_revision
        >>> rollout = TensorDict({  # forecasts 2, 3, then predicts 2, 5
        ...     "vla_action": {"chunk": torch.tensor([[2.0, 5, 0, 0]])[..., None]},
        ...     "prior": {"loc": torch.tensor([[2.0, 3, 0, 0]])[..., None],
        ...               "warm": torch.tensor([[True, True, False, False]])[..., None]}}, [1])
        >>> round(mean_revision(rollout), 3)
        1.414
    """
    needed = (keys.CHUNK, keys.LOC, keys.WARM)
    check_keys(rollout, needed, "mean_revision", ": let a policy write them")
    chunk, loc, warm = (rollout.get(key) for key in needed)
    return _rms((chunk - loc)[warm.expand_as(loc)])


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt()) if values.numel() else math.nan


def source_coverage(policy: WarmPriorActor, windows: TensorDictBase, *, level: float = 0.9) -> float:
    r"""Return the share of the target's coordinates inside the central interval of a Gaussian source.

    A calibrated source covers ``level``. One that covers less trusts its mean too much; one that covers
    everything is too wide, as N(0, I) is for normalised actions.

    Args:
        policy: the policy, whose prior gives the source (:meth:`Prior.distribution`).
        windows: ``[*B]`` of its prior with targets, see :meth:`SharedObservations.deployed`; held-out ones
            for a learned source.
        level: probability of the interval :math:`\mu \pm z s`.

    Returns:
        The share over executed positions inside the episode; NaN for sources that are not Gaussian.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: for bad windows, or a ``level`` outside (0, 1).

    Examples:
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.source_errors import source_coverage
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), GaussianPrior(4))
        >>> source_coverage(actor, SharedObservations(navigation_demonstrations(), 4).windows(actor.prior))
        1.0
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level}")
    flat, prior = flat_windows(policy, windows, target_needed=True), policy.prior
    with evaluation_mode(policy):
        source = prior.distribution(flat[keys.HISTORY], flat[policy.observation_key])
    if type(source) is not Source:
        return math.nan
    z = math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    inside = (flat[keys.CHUNK] - source.loc).abs() <= z * source.scale
    inside = inside[:, : prior.chunk_length]
    counted = flat["counted"][:, : prior.chunk_length].expand_as(inside)
    return float(inside[counted].double().mean())
