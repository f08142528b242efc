"""How far the mean that a decision starts from is from what was right, and from what is decided."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import evaluation_mode, flat_windows, predict
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.transforms.delay import executed_chunk

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
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP
        >>> from warmprior.diagnostics import SharedObservations
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
    split: int = 4096,
    generator: torch.Generator | None = None,
) -> MeanError:
    """Error of the mean at demonstrated states.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior, with the mean that decisions meet
            (:meth:`SharedObservations.deployed`); that of the training has no error for WP-Preview.

    Keyword Args:
        nfe: network evaluations of the prediction; the policy's own by default.
        split: network batch size, for bounded memory; it changes nothing else.
        generator: source of randomness on the policy's device; by default one of its own with a fixed
            seed.

    Returns:
        In normalised action units.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: if they are empty, hold NaN or Inf, or belong to another prediction length.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import PreviewPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 8, observation_steps=1), PreviewPrior(4))
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> mean_error(untrained, shared.windows(untrained.prior)).target  # the target itself
        0.0
    """
    flat = flat_windows(policy, windows, target_needed=True)
    assert flat.target is not None
    if generator is None:
        generator = torch.Generator(flat.loc.device).manual_seed(0)
    rows = windows.select(*policy.in_keys).reshape(len(flat)).to(flat.loc.device)
    with evaluation_mode(policy):
        start = policy.prior.start(flat.loc, flat.warm, generator, flat.observation)
        nfe = policy.ode.nfe if nfe is None else nfe
        chunk = predict(policy, rows, start, nfe=nfe, split=split)
        mean, _ = policy.prior.distribution(flat.loc, flat.warm, flat.observation)
    # STEP's source has no mean: its forecast enters the flow later.
    has_mean = policy.prior.moves_source and policy.prior.start_time == 0.0
    known = (flat.warm | policy.prior.always_warm) & flat.counted & has_mean
    known = known.expand_as(mean)
    return MeanError(_rms((mean - flat.target)[known]), _rms((mean - chunk)[known]))


def mean_revision(rollout: TensorDictBase, prior: Prior) -> float:
    """Distance of the carried mean from what is then predicted, along rollouts.

    Where it is larger than at demonstrated states (:attr:`MeanError.revision`), forecasts age worse where
    the policy brings itself than where the demonstrations are.

    Args:
        rollout: ``[D]`` decisions, see :func:`~warmprior.diagnostics.executed_actions`.
        prior: of the policy.

    Returns:
        Root mean square over warm positions and dimensions, in normalised action units; NaN if no
        decision's mean is warm, or if the source is centred elsewhere (a learned one, for which rollouts
        would have to keep the observations).

    Raises:
        KeyError: if a key is missing.
        ValueError: if the rollout has other dimensions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PreviewPrior
        >>> rollout = TensorDict({  # forecasts 2, 3, then predicts 2, 5
        ...     "vla_action": {"chunk": torch.tensor([[0.0, 1, 2, 3], [2.0, 5, 0, 0]])[..., None]},
        ...     "next": {"executed_steps": torch.tensor([[2], [2]])}}, [2])
        >>> round(mean_revision(rollout, PreviewPrior(2)), 3)
        1.414
    """
    chunk, steps = rollout.get(keys.CHUNK, None), rollout.get(("next", keys.EXECUTED), None)
    if chunk is None or steps is None:
        raise KeyError(f"the rollout lacks {keys.CHUNK} or ('next', '{keys.EXECUTED}')")
    if rollout.ndim != 1:
        raise ValueError(f"need decisions [D] of one environment, got {tuple(rollout.shape)}")
    if type(prior).distribution is not Prior.distribution or not prior.moves_source:
        return math.nan
    done = rollout.get(("next", "done"), torch.zeros_like(steps, dtype=torch.bool))
    nothing = torch.zeros_like(chunk[0]), torch.zeros_like(chunk[0, :, :1], dtype=torch.bool)
    (loc, warm), elapsed = nothing, torch.zeros_like(steps[0])
    differences = []
    taken = executed_chunk(rollout)
    for predicted, played, executed, ended in zip(chunk, taken, steps, done, strict=True):
        differences.append((predicted - loc)[warm.expand_as(loc)])
        elapsed = elapsed + executed
        loc, warm = prior.next_mean(loc, played, executed, elapsed)
        if bool(ended):
            (loc, warm), elapsed = nothing, torch.zeros_like(elapsed)
    return _rms(torch.cat(differences))


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt()) if values.numel() else math.nan
