"""Distance of the source's mean from the right actions, and from the policy's prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import drawn, evaluation_mode, judged, predict
from warmprior.modules.actor import WarmPriorActor

__all__ = ["MeanError", "mean_error", "mean_revision"]


@dataclass(frozen=True)
class MeanError:
    """Root mean squares over warm positions inside the episode and dimensions; NaN if the source has no mean.

    Attributes:
        target: distance of the mean from the demonstrated actions.
        revision: distance of the mean from the policy's prediction.

    See Also:
        :func:`~warmprior.diagnostics.mean_error`: measures it.

    Examples:
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, mean_error
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> def measured(prior):
        ...     actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1, hidden_dim=8), prior)
        ...     return mean_error(actor, shared.windows(prior))
        >>> round(measured(PastPrior(4)).target, 2), measured(GaussianPrior(4))
        (0.17, MeanError(target=nan, revision=nan))
    """

    target: float
    revision: float


def mean_error(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfe: int | None = None,
) -> MeanError:
    """Error of the mean at demonstrated states.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior, with the mean at deployment
            (:meth:`SharedObservations.deployed`); WP-Preview's training mean has no error.

    Keyword Args:
        nfe: network evaluations of the prediction; the policy's own by default.

    Returns:
        In normalised action units.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: if they are empty, hold NaN or Inf, or belong to another prediction length.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import PreviewPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, mean_error
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1), PreviewPrior(4))
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> mean_error(untrained, shared.windows(untrained.prior)).target  # the target itself
        0.0
    """
    flat, target, rows, generator = judged(policy, windows)
    with evaluation_mode(policy):
        nfe = policy.ode.nfe if nfe is None else nfe
        chunk = predict(policy, rows, drawn(policy, rows, generator), nfe)
    mean, known = flat.loc, (flat.warm & flat.counted).expand_as(flat.loc)
    return MeanError(_rms((mean - target)[known]), _rms((mean - chunk)[known]))


def mean_revision(rollout: TensorDictBase) -> float:
    """Distance of the mean from the policy's next prediction, along rollouts.

    If it is larger than at demonstrated states (:attr:`MeanError.revision`), forecasts age worse in the
    states that the policy reaches than in the demonstrations.

    Args:
        rollout: ``[D]`` decisions with what the policy wrote, see :class:`~warmprior.training.Episode`.

    Returns:
        Root mean square over warm positions and dimensions, in normalised action units; NaN if no
        decision's mean is warm.

    Raises:
        KeyError: if a key is missing.

    Examples:
        >>> from warmprior.diagnostics import mean_revision
        >>> import torch
        >>> from tensordict import TensorDict
        >>> rollout = TensorDict({  # forecasts 2, 3, then predicts 2, 5
        ...     "vla_action": {"chunk": torch.tensor([[2.0, 5, 0, 0]])[..., None]},
        ...     "prior": {"loc": torch.tensor([[2.0, 3, 0, 0]])[..., None],
        ...               "warm": torch.tensor([[True, True, False, False]])[..., None]}}, [1])
        >>> round(mean_revision(rollout), 3)
        1.414
    """
    found = [rollout.get(key, None) for key in (keys.CHUNK, keys.LOC, keys.WARM)]
    if any(value is None for value in found):
        raise KeyError(f"the rollout lacks {keys.CHUNK}, {keys.LOC} or {keys.WARM}: let a policy write them")
    chunk, loc, warm = found
    return _rms((chunk - loc)[warm.expand_as(loc)])


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt()) if values.numel() else math.nan
