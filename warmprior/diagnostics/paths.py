"""Paths of a policy's flow, and the history at deployment."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import check_flow, drawn, evaluation_mode, field_of, flat_windows
from warmprior.history import advance
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.ode import integrate

__all__ = ["deployed_history", "flow_paths"]


def flow_paths(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    n_steps: int = 100,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Integration paths of a policy's flow, from its source at ``t = 0`` on, for plots (Fig. 4).

    A policy with a :class:`~warmprior.StartPoint` takes other paths than these.

    Args:
        policy: the policy.
        batch: ``[*B]``, as in :func:`curvature`.
        n_steps: Euler steps.

    Keyword Args:
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        ``[*B, n_steps + 1, P, d_a]``, normalised action units.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: for bad batches or options, or a policy that is no flow.

    Examples:
        >>> from warmprior.diagnostics import flow_paths
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.history import cold_history
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 8), GaussianPrior(8))
        >>> batch = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...                     "history": cold_history([5], 8, 8, action_dim=2)}, [5])
        >>> flow_paths(actor, batch, n_steps=20).shape
        torch.Size([5, 21, 8, 2])
    """
    check_flow(policy, n_steps)
    windows = flat_windows(policy, batch)
    with evaluation_mode(policy):
        generator = policy.sampler.generator if generator is None else generator
        a0 = policy.prior.sample(windows.history, windows.observation, generator)
        field = field_of(policy, windows.observation)
        path = integrate(field, a0, nfe=n_steps, return_path=True)
    return path.view(*windows.shape, *path.shape[1:])


def deployed_history(
    policy: WarmPriorActor,
    previous: TensorDictBase,
    *,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """The history at deployment, from the policy's own prediction one decision earlier.

    ``previous`` are windows ``[*B]``, ``H`` steps before those of interest in the same episodes, with the
    history of the training. Returns ``[*B]`` with ``"history"``.
    """
    windows = flat_windows(policy, previous)
    data = previous.select(*policy.in_keys).to(windows.loc.device)
    with evaluation_mode(policy):
        data.set(keys.NOISE, drawn(policy, data, generator))
        chunk = policy.integrate(data).get(keys.CHUNK)
        steps = torch.full((*data.batch_size, 1), policy.prior.chunk_length, device=chunk.device)
        history = advance(data[keys.HISTORY], chunk, steps)
    return TensorDict({keys.HISTORY: history}, batch_size=data.batch_size, device=chunk.device)
