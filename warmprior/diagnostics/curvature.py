"""Paths of a policy's flow: how straight they are (Table 2), and how far they branch (Theorem B.1)."""

from __future__ import annotations

import math
import warnings

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_keys, check_whole_numbers
from warmprior.diagnostics.flow import (
    SPLIT,
    RunningVariance,
    check_flow,
    check_not_empty,
    evaluation_mode,
    flat_windows,
    unpadded,
)
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.interpolant import LinearInterpolant
from warmprior.modules.network import velocity_field
from warmprior.modules.ode import integrate
from warmprior.modules.prior import Prior
from warmprior.modules.source import Source


def branching_cost(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    *,
    draws: int = 8,
    generator: torch.Generator | None = None,
) -> TensorDict:
    r"""Velocity error of a policy on data: the branching cost, if its field is optimal.

    The branching cost (Theorem B.1) is the smallest possible flow-matching loss,

    .. math::
        B(o) = \int_0^1 E\left[\|A_1 - A_0 - E[A_1 - A_0 \mid A_t, o]\|^2 \mid o\right] dt,

    here with the policy's :math:`v(t, A_t, o)` in place of the conditional expectation, which overestimates
    it on average over the data. Sums run over coordinates inside the episode, in squared normalised action
    units.

    Args:
        policy: the policy.
        batch: windows ``[*B]`` of its own prior with a target, see :func:`~warmprior.window_replay_buffer`.
        draws: samples of source and time per window; the times are stratified.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        TensorDict ``[*B]`` with ``"cost"`` (all coordinates), ``"cost_warm"``, ``"cost_executed"`` (the first
        ``H`` positions), and ``"still"``, ``"still_executed"``: the same for a field that is 0 everywhere.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: for bad batches or options, or a policy that is no flow.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor, window_replay_buffer
        >>> from warmprior.diagnostics import branching_cost
        >>> data = TensorDict({"observation": torch.zeros(50, 3), "action": torch.zeros(50, 2),
        ...                    "episode": torch.arange(50) // 25}, [50])
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 8), PastPrior(8))
        >>> batch = window_replay_buffer(data, actor.prior, batch_size=16).sample()
        >>> branching_cost(actor, batch)["cost"].shape
        torch.Size([16])
    """
    check_flow(policy, 2)
    check_whole_numbers(draws=draws)
    windows = flat_windows(policy, batch, target_needed=True)
    n, steps = len(windows), policy.prior.chunk_length
    rows = windows.repeat(draws)
    path = getattr(policy.network, "interpolant", LinearInterpolant())
    generator = policy.sampler.chosen_generator(generator)
    with evaluation_mode(policy):
        a0 = policy.sampler.source(rows).sample(generator)
        within = torch.rand(n, generator=generator, dtype=a0.dtype, device=a0.device)
        stratum = torch.arange(draws, dtype=a0.dtype, device=a0.device).repeat_interleave(n)
        t = (stratum + within.repeat(draws)) / draws
        a_t, velocity = path(a0, rows[keys.CHUNK], t, generator)
        slices = [slice(i, i + SPLIT) for i in range(0, n * draws, SPLIT)]
        predicted = torch.cat(
            [velocity_field(policy.network, rows[policy.observation_key][s])(t[s], a_t[s]) for s in slices]
        )
    error = (predicted - velocity).square() * rows["counted"]
    still = velocity.square() * rows["counted"]

    def total(x: Tensor) -> Tensor:
        return x.sum((-1, -2)).view(draws, *batch.batch_size).mean(0)

    return TensorDict(
        {
            "cost": total(error),
            "cost_warm": total(error * rows[keys.WARM]),
            "cost_executed": total(error[:, :steps]),
            "still": total(still),
            "still_executed": total(still[:, :steps]),
        },
        batch_size=batch.batch_size,
    )


def branching_bound(batch: TensorDictBase, prior: Prior) -> TensorDict:
    r"""Upper bound of the branching cost from data alone (Proposition B.2).

    .. math::
        B_W \le E\|P_W(A_1 - \mu)\|^2 + \sigma^2 d_W

    on the warm coordinates inside the episode. ``"total"`` is the same on all coordinates, with ``mu = 0``
    and ``sigma = 1`` on cold ones: compare priors by that. The branching cost itself may be far below.

    Args:
        batch: windows ``[*B]`` of the prior's lengths, see :func:`~warmprior.window_replay_buffer`.
        prior: the source distribution.

    Returns:
        TensorDict ``[*B]`` with ``"mismatch"`` (first term), ``"noise"`` (second term), ``"warm"`` (their
        sum), ``"total"`` and ``"total_executed"`` (the first ``H`` positions alone, to compare priors of
        different prediction lengths), in squared normalised action units.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: if the batch is empty or the source is not Gaussian.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ActionWindow, PastPrior
        >>> from warmprior.diagnostics import branching_bound
        >>> data = TensorDict({"observation": torch.zeros(9, 1), "action": torch.arange(9.0)[:, None],
        ...                    "episode": torch.zeros(9, dtype=torch.int64)}, [9])
        >>> windows = ActionWindow(data, 2)(TensorDict({"frame": torch.tensor([4])}, [1]))
        >>> bound = branching_bound(windows, PastPrior(2, sigma=0.5))
        >>> float(bound["mismatch"]), float(bound["noise"])  # both actions are 2 ahead of the mean
        (8.0, 0.5)
    """
    check_keys(batch, (keys.CHUNK, keys.HISTORY), "branching_bound")
    check_not_empty(batch)
    with torch.no_grad():
        source = prior.distribution(batch.get(keys.HISTORY), batch.get(keys.OBSERVATION, None))
    if type(source) is not Source:
        raise ValueError(f"the bound needs a Gaussian source, and {prior} has another one")
    target, warm = batch.get(keys.CHUNK), source.warm
    counted = unpadded(batch, warm)
    squared = (target - source.loc).square()
    variance = source.scale.square().expand_as(target)
    mismatch, noise = ((value * (warm & counted)).sum((-1, -2)) for value in (squared, variance))
    per_position = ((squared + variance) * counted).sum(-1)
    return TensorDict(
        {
            "mismatch": mismatch,
            "noise": noise,
            "warm": mismatch + noise,
            "total": per_position.sum(-1),
            "total_executed": per_position[..., : prior.chunk_length].sum(-1),
        },
        batch_size=batch.batch_size,
    )


NO_MOTION = 0.95
"""The share of a zero field's loss from which on a field counts as not having learnt to move."""


def curvature(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    n_steps: int = 100,
    *,
    draws: int = 1,
    generator: torch.Generator | None = None,
) -> TensorDict:
    r"""Pathwise curvature of the learned flow per observation,

    .. math::
        \kappa(o) = \int_0^1 \|\dot a_t - \bar v\|^2 dt, \qquad \bar v = \int_0^1 \dot a_t dt,

    along the Euler sampler with ``n_steps`` steps, summed over coordinates. It shrinks with the length of the
    path, and a source nearer to the data has shorter paths: compare ``"relative"``, which divides by
    :math:`\|\bar v\|^2`. The paper does not say whether a prediction of ``2H`` counts whole;
    ``"..._executed"`` counts the first ``H`` positions.

    A field that predicts no motion is not straight, though its curvature is tiny. So curvatures are NaN, with
    a warning, where the mean velocity is below 1e-4 per coordinate. In windows, which have targets, all are
    NaN if the field's loss is at least 0.95 of that of a zero field. Positions past an episode's end do not
    count.

    Args:
        policy: the policy; its ``nfe`` and solver play no role.
        batch: ``[*B]`` with observation and history: windows of the policy's own lengths or a rollout. In
            windows WP-Preview's mean is the target itself; see :meth:`SharedObservations.deployed` for
            deployment.
        n_steps: Euler steps.
        draws: source samples per observation, averaged.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        TensorDict ``[*B]`` on the policy's device: ``"kappa"``, ``"speed"`` (:math:`\|\bar v\|^2`),
        ``"relative"`` (their ratio), ``"one_step_error"`` (root mean square distance per coordinate between
        one Euler step and the end of the path), and each with ``"_executed"``. Squared normalised action
        units; the error in normalised ones.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: for bad batches or options, or a policy that is no flow.
        FloatingPointError: if a path becomes NaN or infinite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import curvature
        >>> from warmprior.history import cold_history
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 8), GaussianPrior(8))
        >>> batch = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...                     "history": cold_history([5], 8, 8, action_dim=2)}, [5])
        >>> curvature(actor, batch)["kappa"].shape
        torch.Size([5])
    """
    check_whole_numbers(2, n_steps=n_steps)
    check_whole_numbers(draws=draws)
    check_flow(policy, n_steps)
    windows = flat_windows(policy, batch)
    rows = windows.repeat(draws)
    parts = []
    with evaluation_mode(policy):
        # All sources are drawn at once, so that splitting the batch does not change them.
        a0 = policy.sampler.source(rows).sample(policy.sampler.chosen_generator(generator))
        for i in range(0, len(rows), SPLIT):
            s = slice(i, i + SPLIT)
            parts.append(_measure(policy, a0[s], rows[policy.observation_key][s], n_steps))
    deviations, mean, gap = (torch.cat(part) for part in zip(*parts, strict=True))
    bad = ~torch.isfinite(deviations).flatten(1).all(1)
    if bad.any():
        row = int(bad.nonzero()[0]) % len(windows)
        raise FloatingPointError(
            f"{int(bad.sum())} of {len(rows)} paths are NaN or infinite: observation {row}"
        )
    out = TensorDict({}, batch_size=batch.batch_size, device=a0.device)
    for suffix, end in (("", policy.prior.prediction_length), ("_executed", policy.prior.chunk_length)):
        counted = rows["counted"][:, :end].expand_as(mean[:, :end])

        def total(x: Tensor, counted: Tensor = counted, end: int = end) -> Tensor:
            return (x[:, :end] * counted).sum((-1, -2)).view(draws, *batch.batch_size).mean(0)

        count = total(torch.ones_like(mean))
        kappa, speed = total(deviations), total(mean.square())
        still = speed <= 1e-8 * count
        out["kappa" + suffix] = kappa.masked_fill(still, math.nan)
        out["speed" + suffix] = speed
        out["relative" + suffix] = (kappa / speed).masked_fill(still, math.nan)
        out["one_step_error" + suffix] = (total(gap.square()) / count).sqrt()
    _flag_no_motion(out, policy, batch)
    return out


def flow_paths(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    n_steps: int = 100,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Return integration paths of a policy's flow, from its source at ``t = 0`` on, for plots (Fig. 4).

    A policy with a :class:`~warmprior.StartPoint` takes other paths than these.

    Args:
        policy: the policy.
        batch: ``[*B]``, as in :func:`curvature`.
        n_steps: Euler steps.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        The paths ``[*B, n_steps + 1, P, d_a]`` in normalised action units.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: for bad batches or options, or a policy that is no flow.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import flow_paths
        >>> from warmprior.history import cold_history
        >>> batch = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...                     "history": cold_history([5], 8, 8, action_dim=2)}, [5])
        >>> flow_paths(WarmPriorActor(VelocityMLP(2, 3, 8), GaussianPrior(8)), batch, n_steps=20).shape
        torch.Size([5, 21, 8, 2])
    """
    check_flow(policy, n_steps)
    windows = flat_windows(policy, batch)
    with evaluation_mode(policy):
        a0 = policy.sampler.source(windows).sample(policy.sampler.chosen_generator(generator))
        field = velocity_field(policy.network, windows[policy.observation_key])
        path = integrate(field, a0, nfe=n_steps, return_path=True)
    return path.view(*batch.batch_size, *path.shape[1:])


def _measure(
    policy: WarmPriorActor, a0: Tensor, observation: Tensor, n_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return squared deviation and mean of the velocity, and the one-step error, each ``[n, P, d_a]``."""
    field, track = velocity_field(policy.network, observation), RunningVariance()
    end = integrate(lambda t, a: track.add(field(t, a)), a0, nfe=n_steps)
    one = a0 + field(torch.zeros_like(a0[:, 0, 0]), a0)
    return track.variance(), track.mean, one - end


def _flag_no_motion(out: TensorDict, policy: WarmPriorActor, batch: TensorDictBase) -> None:
    scopes = [suffix for suffix in ("", "_executed") if out["kappa" + suffix].isnan().any()]
    if scopes:
        warnings.warn(
            f"{int(out['kappa' + scopes[0]].isnan().sum())} of {out.numel()} paths do not move: their "
            "curvature is NaN",
            stacklevel=3,
        )
    # In a rollout the chunk is the policy's own prediction.
    if batch.get(keys.CHUNK, None) is None or batch.get(keys.NOISE, None) is not None:
        return
    # A separate generator, so that the check does not advance the caller's.
    generator = torch.Generator(out.device).manual_seed(0)
    cost = branching_cost(policy, batch, generator=generator)
    for suffix in ("", "_executed"):
        share = float(cost["cost" + suffix].sum() / cost["still" + suffix].sum())
        if share >= NO_MOTION:
            where = "the executed positions" if suffix else "the prediction"
            warnings.warn(
                f"on {where} the field's loss is {share:.2f} of that of a field that is 0 everywhere: "
                "it has not learnt to move, and its curvature is NaN",
                stacklevel=3,
            )
            for name in ("kappa", "relative"):
                out[name + suffix] = torch.full_like(out[name + suffix], math.nan)
