"""How far a policy follows its past, and a policy whose past is slightly wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import (
    allowed_nfes,
    drawn,
    encoded_windows,
    evaluation_mode,
    flat_windows,
    predict,
    seen_anew,
    sees_history,
)
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.checks import check_positive

__all__ = ["HistoryShift", "memory_gain"]


def memory_gain(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfes: Sequence[int] = (1, 9),
    shift: float = 0.05,
) -> dict[int, float]:
    r"""How much of a shift of the history reappears in the executed actions.

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

    Windows without a history do not count. Actions beyond the policy's ``clip`` count as 0. The leftover that
    guides a policy stays as it is.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior, normalised, see :meth:`SharedObservations.windows`.
            Images may be encoded, unless the network sees the history.
        nfes: network evaluations per chunk to measure at; those beyond the policy's maximum are skipped.
        shift: :math:`\delta`, in normalised action units.

    Returns:
        By NFE, ascending; 0 if no window has a history, NaN if no position is inside an episode.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: for bad windows or options, or if the observation's last actions differ from the
            history's.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, memory_gain
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
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
    device, n = flat.loc.device, len(flat)
    # A network that sees the last actions encodes them together with the images.
    plain = (windows if sees_history(policy) else encoded).to(device)
    _check_seen(policy, plain)
    generator = torch.Generator(device).manual_seed(0)
    normal = torch.randn(n, 1, flat.loc.shape[-1], generator=generator, dtype=flat.loc.dtype, device=device)
    direction = torch.nn.functional.normalize(normal, dim=-1)
    state = generator.get_state()
    history = flat.history

    def predicted(shift: float) -> dict[int, Tensor]:
        generator.set_state(state)  # the same noise on both sides
        rows = seen_anew(
            policy, plain.clone(recurse=False).set(keys.HISTORY, shifted(history, shift * direction))
        )
        rows = encoded_windows(policy, rows).select(*policy.in_keys)
        a0 = drawn(policy, rows, generator)
        return {nfe: predict(policy, rows, a0, nfe) for nfe in allowed}

    with evaluation_mode(policy):
        up, down = predicted(shift), predicted(-shift)
    executed = slice(prior.chunk_length)
    counted = flat.counted[:, executed, 0]
    followed = counted & ((history["steps"] > 0) | (history["forecast_steps"] > 0))
    cold = 0.0 if counted.any() else math.nan
    gains = {}
    for nfe in allowed:
        along = ((up[nfe] - down[nfe])[:, executed] * direction).sum(-1) / (2 * shift)
        gains[nfe] = float(along[followed].mean()) if followed.any() else cold
    return gains


def shifted(history: TensorDictBase, by: Tensor) -> TensorDictBase:
    """A history with its real actions and forecast moved by ``[*B, n, d_a]``; empty entries stay zero."""
    moved = history.copy()
    for name, from_end in (("actions", True), ("forecast", False)):
        entry, steps = history[name], history["steps" if from_end else "forecast_steps"]
        position = torch.arange(entry.shape[-2], device=entry.device)
        real = position >= len(position) - steps if from_end else position < steps
        moved[name] = entry + real.unsqueeze(-1) * by[..., : len(position), :]
    return moved


def _check_seen(policy: WarmPriorActor, windows: TensorDictBase) -> None:
    if not sees_history(policy):
        return
    key = policy.in_keys[0]
    given, made = windows.get(key), seen_anew(policy, windows.copy()).get(key)
    if isinstance(given, TensorDictBase):
        given, made = given.get(keys.STATE), made.get(keys.STATE)
    if given.shape != made.shape or not torch.allclose(given.to(made.dtype), made):
        raise ValueError(
            f"{key!r} does not end in the windows' last actions, as HistoryObservation writes them: pass "
            "windows with images as they are, not encoded"
        )


class HistoryShift(TensorDictModuleBase):
    """Adds normal noise of deviation ``std`` to a policy's history, actions and forecast, at every decision.

    The environment's own history stays as it is. A ``ValueError`` if ``std < 0``.
    """

    def __init__(
        self, policy: WarmPriorActor, std: float, *, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        if not std >= 0:
            raise ValueError(f"std must be >= 0, got {std}")
        self.policy, self.std, self.generator = policy, std, generator
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Disturb the history and act."""
        history = tensordict[keys.HISTORY]
        longest = max(history[name].shape[-2] for name in ("actions", "forecast"))
        actions = history["actions"]
        noise = torch.randn(
            (*actions.shape[:-2], longest, actions.shape[-1]),
            generator=self.generator,
            dtype=actions.dtype,
            device=actions.device,
        )
        seen = tensordict.clone(recurse=False)
        seen.set(keys.HISTORY, shifted(history, self.std * noise))
        out = self.policy(seen_anew(self.policy, seen))
        return tensordict.update(out.select(*self.out_keys))
