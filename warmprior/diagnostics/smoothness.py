"""The smoothness of executed actions across chunk boundaries."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_finite_steps, check_keys
from warmprior.diagnostics.statistics import ratio
from warmprior.transforms.delay import executed_chunk


@dataclass(frozen=True)
class Smoothness:
    """The smoothness of executed actions; NaN where there was nothing to measure.

    Attributes:
        boundary_jump: mean distance between the last action of a chunk and the first of the next.
        inner_jump: mean distance between consecutive actions inside chunks.
        jerk: mean norm of the third difference of the executed actions, per step cubed.
        boundaries: number of boundaries.

    Examples:
        >>> from warmprior.diagnostics import Smoothness
        >>> Smoothness(boundary_jump=3.0, inner_jump=1.5, jerk=0.1, boundaries=1).jump_ratio
        2.0
    """

    boundary_jump: float
    inner_jump: float
    jerk: float
    boundaries: int

    @property
    def jump_ratio(self) -> float:
        """The ratio of boundary jump to inner jump; 1 if chunk ends make no difference."""
        return ratio(self.boundary_jump, self.inner_jump)


def executed_actions(rollout: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    """Return the executed actions, in order, from the chunks of a rollout.

    Args:
        rollout: decisions ``[*B, D]``, time last, with ``("vla_action", "chunk")`` ``[*B, D, P, d_a]``,
            ``("next", "executed_steps")`` ``[*B, D, 1]`` and, if episodes end inside, ``("next", "done")``;
            if chunks take effect late, also the delay that :class:`InferenceDelay` writes. Rows of a
            collector may be joined, since it numbers episodes. Decisions that ``break_when_all_done`` repeats
            in ended rows, which are equal in every entry, are left out.

    Returns:
        The actions ``[*B, T, d_a]``, padded with NaN where a row executed fewer than the longest; the index
        of the decision that predicted each, int64 ``[*B, T]``, and the index of its episode, int64
        ``[*B, T]``, both -1 where padded.

    Raises:
        KeyError: if a key is missing.
        ValueError: if there is no time dimension, or an executed action is NaN or infinite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior.diagnostics import executed_actions
        >>> rollout = TensorDict({"vla_action": {"chunk": torch.arange(6.0).view(2, 3, 1)},
        ...                       "next": {"executed_steps": torch.tensor([[2], [3]])}}, [2])
        >>> actions, decision, _ = executed_actions(rollout)
        >>> actions.flatten().tolist(), decision.tolist()
        ([0.0, 1.0, 3.0, 4.0, 5.0], [0, 0, 1, 1, 1])
    """
    needed = (keys.CHUNK, ("next", keys.EXECUTED))
    check_keys(rollout, needed, "executed_actions", ": roll out a chunk policy with ChunkStep")
    steps = rollout.get(needed[1])
    if rollout.ndim < 1 or rollout.batch_size.numel() == 0:
        raise ValueError(f"a rollout is [*B, D] with D > 0 decisions, got {tuple(rollout.shape)}")
    done = rollout.get(("next", "done"), torch.zeros_like(steps, dtype=torch.bool))
    longest = int(steps.max())
    chunk = executed_chunk(rollout)[..., :longest, :]
    position = torch.arange(longest, device=chunk.device)
    kept = position < steps  # [*B, D, K]
    decision = torch.arange(rollout.shape[-1], device=chunk.device)[:, None].expand_as(kept)
    delay = rollout.get(keys.DELAY, None)
    if delay is not None:  # actions before a chunk took effect belong to the decision before
        decision = decision - (position < delay).long()
    # TorchRL's `break_when_all_done` copies an ended row's last decision until the longest row ends.
    copied = (done[..., 1:, :] & done[..., :-1, :]).squeeze(-1)
    copied[copied.clone()] = _equal(rollout[..., 1:][copied], rollout[..., :-1][copied])
    kept[..., 1:, :] &= ~copied.unsqueeze(-1)
    ended = done.squeeze(-1).clone()
    if (number := rollout.get(("collector", "traj_ids"), None)) is not None:  # rows may have been joined
        ended[..., :-1] |= number.reshape(ended.shape).diff(dim=-1) != 0
    episode = (ended.cumsum(-1) - ended.long()).unsqueeze(-1).expand_as(kept)
    kept = kept.flatten(-2)
    # Stable sorting brings the executed actions of every row to its front, in order.
    order = (~kept).long().argsort(dim=-1, stable=True)[..., : int(kept.sum(-1).max())]
    valid = kept.gather(-1, order)
    flat = chunk.flatten(-3, -2)
    actions = flat.gather(-2, order.unsqueeze(-1).expand(*order.shape, flat.shape[-1]))
    check_finite_steps("executed actions", actions[valid])
    return (
        actions.masked_fill(~valid.unsqueeze(-1), math.nan),
        decision.flatten(-2).gather(-1, order).masked_fill(~valid, -1),
        episode.flatten(-2).gather(-1, order).masked_fill(~valid, -1),
    )


def _equal(decisions: TensorDictBase, others: TensorDictBase) -> Tensor:
    """Return which decisions ``[N]`` are equal in every entry, bool ``[N]``."""
    equal = torch.ones(decisions.shape, dtype=torch.bool, device=decisions.get(keys.CHUNK).device)
    for key, value in decisions.items(True, True):
        other = others.get(key)
        same = (value == other) | (value != value) & (other != other)  # NaN is equal to NaN here
        equal &= same.unsqueeze(-1).flatten(1).all(1).to(equal.device)
    return equal


def smoothness(rollout: TensorDictBase) -> Smoothness:
    """Measure jumps at chunk boundaries and inside chunks, and jerk, of a rollout.

    They are means over all boundaries, steps and rows, in normalised action units, of the actions from
    :func:`executed_actions`.

    Raises:
        KeyError: if a key is missing.
        ValueError: if the rollout has no chunk boundary, or actions are NaN or infinite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior.diagnostics import smoothness
        >>> rollout = TensorDict({
        ...     "vla_action": {"chunk": torch.tensor([[[1.0], [1.5]], [[-1.0], [-1.5]]])},
        ...     "next": {"executed_steps": torch.tensor([[2], [2]])}}, [2])
        >>> smoothness(rollout)
        Smoothness(boundary_jump=2.5, inner_jump=0.5, jerk=..., boundaries=1)
    """
    actions, decision, episode = executed_actions(rollout)
    together = (episode[..., 1:] == episode[..., :-1]) & (episode[..., 1:] >= 0)
    boundary = together & (decision[..., 1:] != decision[..., :-1])
    if not boundary.any():
        raise ValueError("the rollout has no chunk boundary: it needs two decisions in one episode")
    jump = torch.linalg.vector_norm(actions.diff(dim=-2), dim=-1)
    third = torch.linalg.vector_norm(actions.diff(n=3, dim=-2), dim=-1)
    return Smoothness(
        boundary_jump=_mean(jump, boundary),
        inner_jump=_mean(jump, together & ~boundary),
        jerk=_mean(third, together[..., 2:] & together[..., 1:-1] & together[..., :-2]),
        boundaries=int(boundary.sum()),
    )


def _mean(values: Tensor, mask: Tensor) -> float:
    return float(values[mask].mean()) if mask.any() else math.nan
