"""Paths of a policy's flow, and the mean from which they start at deployment."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior.diagnostics.branching import executed_positions
from warmprior.diagnostics.flow import check_flow, evaluation_mode, field_of, flat_windows
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.ode import integrate

__all__ = ["flow_paths", "forecast_mean"]


def flow_paths(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    n_steps: int = 100,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Integration paths of a policy, from source to prediction, for plots (Fig. 4).

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
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 8), GaussianPrior(8))
        >>> batch = TensorDict({"observation": torch.zeros(5, 2, 3), "prior": {
        ...     "loc": torch.zeros(5, 8, 2), "warm": torch.zeros(5, 8, 1, dtype=torch.bool)}}, [5])
        >>> flow_paths(actor, batch, n_steps=20).shape
        torch.Size([5, 21, 8, 2])
    """
    check_flow(policy, n_steps)
    windows = flat_windows(policy, batch)
    with evaluation_mode(policy):
        generator = policy.sampler.generator if generator is None else generator
        a0 = policy.prior.sample(windows.loc, windows.warm, generator, windows.observation)
        field = field_of(policy, windows.observation)
        path = integrate(field, a0, nfe=n_steps, return_path=True)
    return path.view(*windows.shape, *path.shape[1:])


def forecast_mean(
    policy: WarmPriorActor,
    previous: TensorDictBase,
    *,
    executed: int | None = None,
    nfe: int | None = None,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """The mean that deployment meets: made from the policy's own prediction one decision earlier.

    ``batch.update(forecast_mean(policy, previous))`` replaces the training mean of windows by it (and
    :class:`~warmprior.MeanObservation` makes the observation of a conditioned network anew).

    Args:
        policy: the policy.
        previous: windows ``[*B]`` of the decision before each window of interest, that is ``executed``
            steps earlier in the same episode. Their own mean is the training one.

    Keyword Args:
        executed: actions executed between the two; ``H`` by default.
        nfe: network evaluations of the prediction; the policy's own by default.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        TensorDict ``[*B]`` with ``loc`` ``[*B, P, d_a]`` and ``warm`` ``[*B, P, 1]`` under the policy's
        keys.

    Raises:
        KeyError: if the batch lacks a key.
        ValueError: for bad batches or options.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PreviewPrior, VelocityMLP, WarmPriorActor
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 16), PreviewPrior(8))
        >>> previous = TensorDict({"observation": torch.zeros(5, 2, 3), "prior": {
        ...     "loc": torch.zeros(5, 16, 2), "warm": torch.zeros(5, 16, 1, dtype=torch.bool)}}, [5])
        >>> forecast_mean(actor, previous)["prior", "warm"][0].flatten().sum()
        tensor(8)
    """
    windows = flat_windows(policy, previous)
    prior = policy.prior
    k = executed_positions(prior, executed)
    if k > prior.chunk_length:
        raise ValueError(f"at most H = {prior.chunk_length} actions are executed, got {k}")
    _, loc_key, warm_key = policy.in_keys[:3]
    data = previous.select(*policy.in_keys).to(windows.loc.device)
    with evaluation_mode(policy):
        a0 = prior.start(
            data.get(loc_key),
            data.get(warm_key),
            policy.sampler.generator if generator is None else generator,
            data.get(policy.in_keys[0]),
        )
        data.set(policy.ode.in_keys[0], a0)
        chunk = policy.integrate(data, nfe).get(policy.chunk_key)
        steps = torch.full((*data.batch_size, 1), k, device=chunk.device)
        # A decision whose own mean is warm lies at least H actions after the reset.
        elapsed = steps + prior.chunk_length * data.get(warm_key).any(-2)
        loc, warm = prior.next_mean(data.get(loc_key), chunk, steps, elapsed)
    result = TensorDict({}, batch_size=data.batch_size, device=chunk.device)
    return result.set(loc_key, loc).set(warm_key, warm)
