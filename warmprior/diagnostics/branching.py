"""Branching cost: the part of the flow-matching loss that no network can remove, and its bound."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import SPLIT, check_flow, evaluation_mode, field_of, flat_windows
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.checks import check_whole_numbers
from warmprior.modules.interpolant import LinearInterpolant
from warmprior.modules.prior import Prior, Source

__all__ = ["branching_bound", "branching_cost"]


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
    generator = policy.sampler.generator if generator is None else generator
    assert rows.target is not None
    with evaluation_mode(policy):
        a0 = policy.prior.sample(rows.history, rows.observation, generator)
        within = torch.rand(n, generator=generator, dtype=a0.dtype, device=a0.device)
        stratum = torch.arange(draws, dtype=a0.dtype, device=a0.device).repeat_interleave(n)
        t = (stratum + within.repeat(draws)) / draws
        a_t, velocity = path(a0, rows.target, t)
        slices = [slice(i, i + SPLIT) for i in range(0, n * draws, SPLIT)]
        predicted = torch.cat([field_of(policy, rows.observation[s])(t[s], a_t[s]) for s in slices])
    error = (predicted - velocity).square() * rows.counted
    still = velocity.square() * rows.counted

    def total(x: Tensor) -> Tensor:
        return x.sum((-1, -2)).view(draws, *windows.shape).mean(0)

    return TensorDict(
        {
            "cost": total(error),
            "cost_warm": total(error * rows.warm),
            "cost_executed": total(error[:, :steps]),
            "still": total(still),
            "still_executed": total(still[:, :steps]),
        },
        batch_size=windows.shape,
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
    needed = (keys.CHUNK, keys.HISTORY)
    missing = [key for key in needed if batch.get(key, None) is None]
    if missing:
        raise KeyError(f"branching_bound needs the keys {list(needed)}; missing: {missing}")
    if batch.batch_size.numel() == 0:
        raise ValueError("the batch holds no window")
    with torch.no_grad():
        source = prior.distribution(batch.get(keys.HISTORY), batch.get(keys.OBSERVATION, None))
    if type(source) is not Source:
        raise ValueError(f"the bound needs a Gaussian source, and {prior} has another one")
    target, warm = batch.get(keys.CHUNK), source.warm
    pad = batch.get(keys.IS_PAD, None)
    counted = torch.ones_like(warm) if pad is None else ~pad.unsqueeze(-1)
    warm = (warm & counted).expand_as(target)
    cold = counted.expand_as(target) & ~warm
    squared = (target - source.loc).square() * warm
    variance = source.scale.square() * warm
    unknown = ((target - source.loc).square() + source.scale.square()) * cold
    mismatch, noise = squared.sum((-1, -2)), variance.sum((-1, -2))
    rest = unknown.sum((-1, -2))
    per_position = (squared + variance + unknown).sum(-1)
    return TensorDict(
        {
            "mismatch": mismatch,
            "noise": noise,
            "warm": mismatch + noise,
            "total": mismatch + noise + rest,
            "total_executed": per_position[..., : prior.chunk_length].sum(-1),
        },
        batch_size=batch.batch_size,
    )
