"""What is measured of a policy on the data that it was trained on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

from warmprior.diagnostics.flow import allowed_nfes, encoded_windows, sees_history
from warmprior.diagnostics.mean_error import mean_error
from warmprior.diagnostics.memory_gain import memory_gain
from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.diagnostics.source_leak import source_leak
from warmprior.experiments.straightness import flow_measures
from warmprior.modules.actor import WarmPriorActor

__all__ = ["Measures", "measure"]

MEASURED_WINDOWS = 512
"""Observations of the training data on which source leak and flow of every policy are measured."""


Measures = dict[int, dict[str, float | None]]
"""What is measured of a policy, by NFE and name, as rows tell it."""


def measure(
    policy: WarmPriorActor,
    data: TensorDictBase,
    nfes: Sequence[int],
    *,
    chunk_length: int,
    observation_steps: int,
    coupled: bool = False,
) -> Measures:
    """Measure a policy on the same observations, and by the same draws, as all others.

    Args:
        policy: on the CPU.
        data: contiguous steps in normalised units, see :class:`~warmprior.ActionWindow`.
        nfes: numbers of network evaluations, where the policy's field allows them.

    Keyword Args:
        chunk_length: ``H``.
        observation_steps: ``To``.
        coupled: whether the training pairs sources and targets, see :func:`flow_measures`.

    Returns:
        By NFE: the error of the policy's mean, its memory gain, its source leak (``None`` where no two
        episodes have steps to compare), and what holds at any NFE, of its flow and source.
    """
    shared = SharedObservations(data.to("cpu"), chunk_length, observation_steps=observation_steps)
    drawn = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
    shared = shared.subset(drawn[:MEASURED_WINDOWS].sort()[0])
    leaks = {}
    windows = shared.windows(policy.prior, see_history=sees_history(policy))
    seen = encoded_windows(policy, windows)
    if len(shared.episodes.unique()) > 1:  # two episodes with steps to compare
        leaks = source_leak(policy, seen, nfes=nfes, episodes=shared.episodes)
    generator = torch.Generator().manual_seed(0)
    met = shared.met(policy, generator=generator)
    allowed = allowed_nfes(policy, nfes)
    means = {nfe: mean_error(policy, met, nfe=nfe) for nfe in allowed}
    shifted = windows if sees_history(policy) else seen
    gains = memory_gain(policy, shifted, nfes=nfes)
    flow = flow_measures(policy, met, coupled=coupled, generator=generator)

    def told(nfe: int) -> dict[str, float | None]:
        leak, mean = leaks.get(nfe), means[nfe]
        return {
            "mean_error": mean.target,
            "mean_revision_data": mean.revision,
            "source_leak": None if leak is None else leak.leak,
            "inner_step_ratio": None if leak is None else leak.inner_step_ratio,
            "memory_gain": gains[nfe],
            **flow,
        }

    return {nfe: told(nfe) for nfe in allowed}
