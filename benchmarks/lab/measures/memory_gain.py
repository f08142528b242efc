"""Memory gain: how far the executed actions follow the last ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import WarmPriorActor, keys
from warmprior.checks import check_positive
from warmprior.diagnostics.flow import (
    allowed_nfes,
    drawn,
    encoded_windows,
    evaluation_mode,
    flat_windows,
    observe_history,
    predict,
)
from warmprior.diagnostics.leaks import shifted


def memory_gain(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfes: Sequence[int] = (1, 9),
    shift: float = 0.05,
) -> dict[int, float]:
    r"""Measure how far executed actions move when the history is shifted: 0 = ignored, 1 = copied.

    At the same observation and source noise, all actions of the history and its forecast are moved by
    :math:`\pm\delta e`, with a random unit direction :math:`e` per window. The gain is

    .. math::
        E\,\Big[e \cdot \frac{a_\tau(\mu + \delta e) - a_\tau(\mu - \delta e)}{2\delta}\Big]

    over windows, directions and the executed positions :math:`\tau` inside the episode: the slope of actions
    by the mean, averaged over the dimensions. It is 0 for a policy that ignores its past, 1 for one that
    repeats it, and negative for one that undoes it. A gain is not a fault, since the mean may know what the
    observation does not show. But a wrong action of the policy's own, which demonstrations never contain, is
    carried on as well.

    The source's noise lowers the gain. If past and next actions are one height, which varies by :math:`s` at
    an observation, and the noise's average over the chunk has the variance :math:`V = \sigma^2 (\rho + (1 -
    \rho)/H)`, with a ``correlation`` of :math:`\rho`, the gain of an exact flow is :math:`s^2 / (s^2 + V)` at
    one Euler step, and :math:`s / \sqrt{s^2 + V}` at infinitely many.

    Windows without a history do not count. Actions beyond the policy's ``clip`` count as 0. The forecast
    that guides a policy is not shifted.

    Args:
        policy: the policy; its state does not change.
        windows: ``[*B]`` of the policy's own prior, normalised, see :meth:`SharedObservations.windows`.
            Images may be encoded, unless the network sees the history.
        nfes: network evaluations per chunk to measure at; those beyond the policy's maximum are skipped.
        shift: :math:`\delta`, in normalised action units.

    Returns:
        The gain by NFE, ascending; 0 if no window has a history, NaN if no position is inside an episode.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: if the windows or options are invalid, or the observation's last actions differ from the
            history's.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> import torch
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.memory_gain import memory_gain
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared, _ = SharedObservations(navigation_demonstrations(), 4), torch.manual_seed(0)
        >>> def measured(prior):
        ...     untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), prior)
        ...     return memory_gain(untrained, shared.windows(prior))[1]
        >>> measured(PastPrior(4)) > 0.5, measured(GaussianPrior(4))
        (True, 0.0)
    """
    check_positive(shift=shift)
    prior, allowed = policy.prior, allowed_nfes(policy, nfes)
    windows = windows.reshape(windows.batch_size.numel())
    encoded = encoded_windows(policy, windows)
    flat = flat_windows(policy, encoded)
    loc, device = flat[keys.LOC], flat.device
    # A network that sees the last actions encodes them together with the images.
    plain = (windows if policy.sees_history else encoded).to(device)
    _check_seen(policy, plain)
    generator = torch.Generator(device).manual_seed(0)
    normal = torch.randn(len(flat), 1, loc.shape[-1], generator=generator, dtype=loc.dtype, device=device)
    direction = torch.nn.functional.normalize(normal, dim=-1)
    state = generator.get_state()
    history = flat[keys.HISTORY]

    def predicted(shift: float) -> dict[int, Tensor]:
        generator.set_state(state)  # the same noise on both sides
        rows = observe_history(
            policy, plain.clone(recurse=False).set(keys.HISTORY, shifted(history, shift * direction))
        )
        rows = encoded_windows(policy, rows).select(*policy.in_keys)
        a0 = drawn(policy, rows, generator)
        return {nfe: predict(policy, rows, a0, nfe) for nfe in allowed}

    with evaluation_mode(policy):
        up, down = predicted(shift), predicted(-shift)
    executed = slice(prior.chunk_length)
    counted = flat["counted"][:, executed, 0]
    followed = counted & ((history["steps"] > 0) | (history["forecast_steps"] > 0))
    cold = 0.0 if counted.any() else math.nan
    gains = {}
    for nfe in allowed:
        along = ((up[nfe] - down[nfe])[:, executed] * direction).sum(-1) / (2 * shift)
        gains[nfe] = float(along[followed].mean()) if followed.any() else cold
    return gains


def _check_seen(policy: WarmPriorActor, windows: TensorDictBase) -> None:
    if not policy.sees_history:
        return
    key = policy.observation_key
    stored, updated = windows.get(key), observe_history(policy, windows.copy()).get(key)
    if isinstance(stored, TensorDictBase):
        stored, updated = stored.get(keys.STATE), updated.get(keys.STATE)
    if stored.shape != updated.shape or not torch.allclose(stored.to(updated.dtype), updated):
        raise ValueError(f"{key!r} does not end in the windows' last actions: do not encode images before")
