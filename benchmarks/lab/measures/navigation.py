"""Rollouts and measures of policies on the one-dimensional navigation toy (the paper's Fig. 5)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from warmprior import keys
from warmprior.diagnostics.leaks import HistoryShift
from warmprior.diagnostics.smoothness import executed_actions, smoothness
from warmprior.envs.navigation1d import NavigationEnv, navigation_metrics
from warmprior.modules.actor import WarmPriorActor
from warmprior.transforms import policy_transforms

SHIFT = 0.15
"""Standard deviation of the history shift, a third of the narrowest gap between the sides."""


def play_navigation(
    actor: WarmPriorActor,
    seed: int,
    *,
    nfe: int,
    rollouts: int = 256,
    shift: float = 0.0,
    make_env: Callable[..., EnvBase] = NavigationEnv,
) -> TensorDictBase:
    """Roll a policy out on the toy, :class:`~warmprior.envs.NavigationEnv`; ``[rollouts, decisions]``.

    Args:
        actor: the policy.
        seed: seed of the source samples and of the history shift.

    Keyword Args:
        nfe: network evaluations per chunk.
        rollouts: number of rollouts.
        shift: standard deviation of the noise on the remembered mean.
        make_env: makes the toy with the policy's observations, as its :class:`Task` does.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.navigation import play_navigation
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1, hidden_dim=8), PastPrior(4))
        >>> play_navigation(actor, seed=0, nfe=1, rollouts=2).shape  # 64 steps, four per decision
        torch.Size([2, 16])
    """
    generator = torch.Generator().manual_seed(seed)
    transforms = policy_transforms(actor.prior, observation_steps=1, see_history=actor.sees_history)
    env = TransformedEnv(make_env(batch_size=[rollouts]), transforms)
    player = actor.replace(nfe=nfe, generator=generator)
    policy = HistoryShift(player, shift, generator=generator) if shift else player
    with torch.no_grad():
        return env.rollout(1_000, policy)


def judge_navigation(
    actor: WarmPriorActor,
    seed: int,
    *,
    nfe: int,
    rollouts: int = 256,
    make_env: Callable[..., EnvBase] = NavigationEnv,
) -> dict[str, Any]:
    """Play a policy on the toy (:func:`play_navigation`), and return its measures.

    They are metrics of the rollouts (:class:`~warmprior.envs.NavigationMetrics`), ``jump_ratio`` and ``jerk``
    (:class:`~warmprior.diagnostics.Smoothness`), and some metrics under history shift (``"shifted_..."``). A
    policy whose actions become NaN or infinite counts as colliding, and its other metrics are NaN.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from lab.measures.navigation import judge_navigation
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 16, 1, hidden_dim=8), PastPrior(16))
        >>> 0.0 <= judge_navigation(actor, 0, nfe=1, rollouts=8)["collision_rate"] <= 1.0
        True
    """
    row: dict[str, Any] = {}
    for prefix, shift in (("", 0.0), ("shifted_", SHIFT)):
        played = play_navigation(actor, seed, nfe=nfe, rollouts=rollouts, shift=shift, make_env=make_env)
        if _diverged(played):
            row[f"{prefix}collision_rate"] = 1.0
            continue
        heights = executed_actions(played)[0].squeeze(-1)
        metrics = asdict(navigation_metrics(heights, actor.prior.chunk_length))
        if shift:
            kept = ("switch_rate", "collision_rate", "distance")
            row |= {prefix + name: metrics[name] for name in kept}
        else:
            smooth = smoothness(played)
            row |= metrics | {"jump_ratio": smooth.jump_ratio, "jerk": smooth.jerk}
    names = ("switch_rate", "distance", "shifted_switch_rate", "shifted_distance", "jump_ratio")
    return {name: math.nan for name in names} | row


def _diverged(rollout: TensorDictBase) -> bool:
    """Return True if an executed action is NaN or infinite."""
    chunk = rollout[keys.CHUNK]
    executed = torch.arange(chunk.shape[-2]) < rollout["next", keys.EXECUTED]
    return not bool(torch.isfinite(chunk[executed]).all())
