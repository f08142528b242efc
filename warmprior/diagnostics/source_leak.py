"""Source leak: how much of the source's noise a policy lets through to the actions it executes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import (
    RunningVariance,
    allowed_nfes,
    drawn,
    evaluation_mode,
    judged,
    observed,
    predict,
)
from warmprior.modules.actor import WarmPriorActor

__all__ = ["INNER_STEP_BOUND", "LEAK_BOUND", "SourceLeak", "source_leak"]

LEAK_BOUND = 1.0
"""Largest leak of a sampler that spreads like the data; a larger one adds noise."""

INNER_STEP_BOUND = 1.3
"""Largest inner step ratio of a sound policy, which is near 1 or, at few steps, below."""

DISTANCES = 2**22
"""Distances between observations held at a time: 16 MiB in single precision."""


@dataclass(frozen=True)
class SourceLeak:
    """How the source's noise shows in the executed actions, in normalised action units.

    Attributes:
        nfe: network evaluations per chunk.
        spread: standard deviation of predictions over draws of the source at fixed observation and mean, root
            mean square over windows, positions and dimensions.
        data_spread: the same for the targets at similar observations.
        ratio_to_last: ``spread`` over that at the largest ``nfe`` measured.
        inner_step: mean distance between consecutive actions inside predicted chunks; NaN at ``H = 1``.
        data_inner_step: the same of the targets.

    Examples:
        >>> from warmprior.diagnostics import SourceLeak
        >>> found = SourceLeak(nfe=1, spread=0.3, data_spread=0.2, ratio_to_last=1.5,
        ...                    inner_step=0.11, data_inner_step=0.1)
        >>> round(found.leak, 2), round(found.inner_step_ratio, 2)
        (1.5, 1.1)
        >>> found.warning
        "at NFE 1 the actions carry noise of the source: their spread is 1.50 times the data's (bound 1)"
    """

    nfe: int
    spread: float
    data_spread: float
    ratio_to_last: float
    inner_step: float
    data_inner_step: float

    @property
    def leak(self) -> float:
        """Spread over the data's; NaN where the data do not spread."""
        return _ratio(self.spread, self.data_spread)

    @property
    def inner_step_ratio(self) -> float:
        """Inner step over the data's; NaN where the data do not move."""
        return _ratio(self.inner_step, self.data_inner_step)

    @property
    def warning(self) -> str | None:
        """A sentence that names the exceeded bounds, or ``None``."""
        signs = (
            ("spread is", self.leak, LEAK_BOUND),
            ("steps inside chunks are", self.inner_step_ratio, INNER_STEP_BOUND),
        )
        exceeded = [
            f"their {what} {ratio:.2f} times the data's (bound {bound:g})"
            for what, ratio, bound in signs
            if ratio > bound
        ]
        if not exceeded:
            return None
        return f"at NFE {self.nfe} the actions carry noise of the source: {', '.join(exceeded)}"


def source_leak(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfes: Sequence[int] = (1, 9),
    draws: int = 8,
    episodes: Tensor | None = None,
) -> dict[int, SourceLeak]:
    r"""How far predictions spread over draws of the source, relative to the data.

    An exact sampler spreads at most like the targets at the same observation, so the leak is at most 1. A
    velocity network that has not learnt to ignore the noise at ``t = 0`` passes it on to the actions, most of
    all at few steps. With one step an exact field returns :math:`E[a_1 \mid a_0, o]`, whose spread is 0 for a
    standard normal source, and at most the data's for a warm one, by the law of total variance.

    The data's variance is half the mean squared difference between a window's target and that at the nearest
    observation (Euclidean, all ``To`` steps) of another episode. It is conditioned on the observation alone
    for every prior, because WP-Preview's training mean is cut from the target, and therefore errs upwards.
    Several modes at one observation spread far enough to hide a leak, but noise between the actions of one
    chunk still shows, as steps inside chunks that are longer than the data's. Positions past the first ``H``
    or past an episode's end do not count.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior with observations ``[*B, To, d_o]`` and targets ``[*B, P,
            d_a]``, normalised, see :meth:`SharedObservations.windows`.
        nfes: network evaluations per chunk to measure at; those beyond the policy's maximum are skipped.
        draws: samples of the source per window, at least 2, the same ones for every NFE.
        episodes: each window's episode, ``[*B]``, such as :attr:`SharedObservations.episodes`; by default
            ``"episode"`` in the windows; without it every window counts as an episode.

    Returns:
        The measures by NFE, in ascending order.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: for bad windows or options, or a single episode.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, source_leak
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), PastPrior(4))
        >>> leak = source_leak(untrained, shared.windows(untrained.prior), episodes=shared.episodes)[1]
        >>> leak.inner_step_ratio > 2, leak.warning is None  # noise, to smooth demonstrations
        (True, False)
    """
    if draws < 2:
        raise ValueError(f"need draws >= 2, got {draws}")
    prior, allowed = policy.prior, allowed_nfes(policy, nfes)
    flat, target, rows, generator = judged(policy, windows)
    n, device, chunk_length = len(flat), flat.loc.device, prior.chunk_length
    if episodes is None:
        episodes = windows.get(keys.EPISODE, None)
    episodes = torch.arange(n) if episodes is None else episodes.flatten()
    if len(episodes) != n:
        raise ValueError(f"each of the {n} windows needs its episode, got {len(episodes)}")
    if len(episodes.unique()) < 2:
        raise ValueError("each window is compared with one of another episode, and all are of one")
    target, counted = target[:, :chunk_length], flat.counted[:, :chunk_length, 0]
    moments = {nfe: RunningVariance() for nfe in allowed}
    steps = {nfe: 0.0 for nfe in allowed}
    with evaluation_mode(policy):
        observation = observed(policy, windows).reshape(n, -1).to(device)
        data_spread = _data_spread(observation, target, counted, episodes.to(device))
        for _ in range(draws):
            a0 = drawn(policy, rows, generator)
            for nfe in allowed:
                chunk = predict(policy, rows, a0, nfe)
                chunk = moments[nfe].add(chunk[:, :chunk_length])
                steps[nfe] += _inner_step(chunk, counted) / draws
    spread = {
        nfe: math.sqrt(float(moment.variance(unbiased=True)[counted].mean()))
        for nfe, moment in moments.items()
    }
    return {
        nfe: SourceLeak(
            nfe=nfe,
            spread=spread[nfe],
            data_spread=data_spread,
            ratio_to_last=_ratio(spread[nfe], spread[allowed[-1]]),
            inner_step=steps[nfe],
            data_inner_step=_inner_step(target, counted),
        )
        for nfe in allowed
    }


def _data_spread(observation: Tensor, target: Tensor, counted: Tensor, episodes: Tensor) -> float:
    size = max(DISTANCES // len(observation), 1)
    squares = []
    for i in range(0, len(observation), size):
        s = slice(i, i + size)
        # The faster form by matrix products loses small distances, which matter here.
        distance = torch.cdist(observation[s], observation, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = distance.masked_fill_(episodes[s, None] == episodes, math.inf).argmin(1)
        difference = (target[s] - target[nearest]).square()
        squares.append(difference[counted[s] & counted[nearest]])
    return math.sqrt(float(torch.cat(squares).mean()) / 2)


def _inner_step(chunk: Tensor, counted: Tensor) -> float:
    step = torch.linalg.vector_norm(chunk.diff(dim=1), dim=-1)
    return float(step[counted[:, 1:] & counted[:, :-1]].mean())


def _ratio(value: float, reference: float) -> float:
    return value / reference if reference else math.nan
