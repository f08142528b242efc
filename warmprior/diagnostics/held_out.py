"""Errors of actions on held-out demonstrations, beside those that need no policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.action_error import action_error
from warmprior.diagnostics.flow import encoded_windows
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.trend import RestingAction, vector_of
from warmprior.transforms.window import window_transforms

MOST = 4096
"""The number of windows from which an error is measured; they are spread evenly over longer data."""


def held_out_errors(
    policy: WarmPriorActor,
    data: TensorDictBase,
    nfes: Sequence[int],
    mean: Tensor,
    rest: RestingAction | None = None,
) -> tuple[dict[int, float], dict[str, float]]:
    """Return the errors of a policy's actions by NFE, and those of actions that need no policy, by name.

    These are the mean action, and with a resting action staying where the robot is, with the mean where an
    action is no position target.

    Args:
        policy: the policy; its state does not change.
        data: contiguous held-out steps ``[N]``, normalised.
        nfes: see :func:`action_error`, which says what an error is.
        mean: the mean action of the training's demonstrations ``[d_a]``, normalised.
        rest: the resting action of the task, for absolute targets.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics.held_out import held_out_errors
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), PastPrior(4))
        >>> by_nfe, others = held_out_errors(untrained, navigation_demonstrations(), [1], torch.zeros(1))
        >>> list(by_nfe), list(others)
        ([1], ['always the mean action'])
    """
    network: Any = policy.network
    windows = window_transforms(data, policy.prior, observation_steps=network.observation_steps)
    frames = torch.linspace(0, len(data) - 1, min(len(data), MOST)).round().long()
    batch = windows(TensorDict({keys.FRAME: frames}, [len(frames)]))
    known = {"always the mean action": mean}
    if rest is not None:
        resting = torch.where(rest.is_target, rest(vector_of(batch[keys.OBSERVATION])[:, -1]), mean)
        known["staying where the robot is"] = resting.unsqueeze(1)
    executed = slice(None, policy.prior.chunk_length)
    target, inside = batch[keys.CHUNK][:, executed], ~batch[keys.IS_PAD][:, executed]
    others = {name: float((target - action).square()[inside].mean()) for name, action in known.items()}
    return action_error(policy, encoded_windows(policy, batch), nfes=nfes), others
