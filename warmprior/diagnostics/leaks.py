"""Measures of the source's noise, and of errors of the past, in the actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_not_negative, check_shape, check_whole_numbers
from warmprior.diagnostics.flow import (
    RunningVariance,
    allowed_nfes,
    drawn,
    evaluation_mode,
    inputs_and_targets,
    observe_history,
    predict,
)
from warmprior.diagnostics.statistics import ratio
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.generator import Drawing

LEAK_BOUND = 1.0
"""The largest leak of a sampler that spreads like the data; a larger one adds noise."""

INNER_STEP_BOUND = 1.3
"""The largest inner step ratio of a sound policy, whose ratio is near 1 or, at few steps, below."""

DISTANCES = 2**22
"""The number of distances between observations held at a time: 16 MiB in single precision."""


@dataclass(frozen=True)
class SourceLeak:
    """The noise of the source in the executed actions, in normalised action units.

    Attributes:
        nfe: network evaluations per chunk.
        spread: standard deviation of predictions over draws of the source at fixed observation and mean, root
            mean square over windows, positions and dimensions.
        data_spread: standard deviation of the targets at similar observations, averaged in the same way.
        inner_step: mean distance between consecutive actions inside predicted chunks; NaN at ``H = 1``.
        data_inner_step: mean distance between consecutive actions inside the targets.

    Examples:
        >>> from warmprior.diagnostics import SourceLeak
        >>> leak = SourceLeak(nfe=1, spread=0.3, data_spread=0.2, inner_step=0.11, data_inner_step=0.1)
        >>> round(leak.leak, 2), round(leak.inner_step_ratio, 2)
        (1.5, 1.1)
        >>> leak.warning
        "at NFE 1 the actions carry noise of the source: their spread is 1.50 times the data's (bound 1)"
    """

    nfe: int
    spread: float
    data_spread: float
    inner_step: float
    data_inner_step: float

    @property
    def leak(self) -> float:
        """The ratio of the spread to the data's; infinite if the data alone do not spread."""
        return ratio(self.spread, self.data_spread)

    @property
    def inner_step_ratio(self) -> float:
        """The ratio of the inner step to the data's; infinite if the data alone do not move."""
        return ratio(self.inner_step, self.data_inner_step)

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
    r"""Measure how far predictions spread over draws of the source, relative to the data.

    An exact sampler spreads at most like the targets at the same observation, so the leak is at most 1. A
    velocity network that has not learnt to ignore the noise at ``t = 0`` passes it on to the actions, most of
    all at few steps. With one step an exact field returns :math:`E[a_1 \mid a_0, o]`, whose spread is 0 for a
    standard normal source, and at most the data's for a warm one, by the law of total variance.

    The data's variance is half the mean squared difference between a window's target and that at the nearest
    observation (Euclidean, all ``To`` steps) of another episode. It is conditioned on the observation alone
    for every prior, because WP-Preview's training mean is cut from the target; so it errs upwards. Several
    modes at one observation can hide a leak. Noise between the actions of one chunk still shows: the steps
    inside chunks are then longer than the data's. Positions past the first ``H`` or past an episode's end do
    not count.

    Args:
        policy: the policy; its state does not change.
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
        ValueError: if the windows or options are invalid, or there is a single episode.
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
    check_whole_numbers(2, draws=draws)
    prior, allowed = policy.prior, allowed_nfes(policy, nfes)
    flat, target, rows, generator = inputs_and_targets(policy, windows)
    n, device, chunk_length = len(flat), flat.device, prior.chunk_length
    if episodes is None:
        episodes = windows.get(keys.EPISODE, None)
    episodes = torch.arange(n) if episodes is None else episodes.flatten()
    check_shape("episodes of the windows", episodes, (n,))
    if len(episodes.unique()) < 2:
        raise ValueError("each window is compared with one from another episode: at least 2 are needed")
    target, counted = target[:, :chunk_length], flat["counted"][:, :chunk_length, 0]
    moments = {nfe: RunningVariance() for nfe in allowed}
    steps = {nfe: 0.0 for nfe in allowed}
    with evaluation_mode(policy):
        bare = policy.sees_history and isinstance(windows.get(keys.OBSERVATION), Tensor)
        observation = windows.get(keys.OBSERVATION if bare else policy.observation_key)
        observation = observation.reshape(n, -1).to(device)  # without the last actions, if it can be
        data_spread = _data_spread(observation, target, counted, episodes.to(device))
        for _ in range(draws):
            a0 = drawn(policy, rows, generator)
            for nfe in allowed:
                chunk = predict(policy, rows, a0, nfe)
                chunk = moments[nfe].add(chunk[:, :chunk_length])
                steps[nfe] += _inner_step(chunk, counted) / draws
    return {
        nfe: SourceLeak(
            nfe=nfe,
            spread=math.sqrt(float(moments[nfe].variance(unbiased=True)[counted].mean())),
            data_spread=data_spread,
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


def shifted(history: TensorDictBase, by: Tensor) -> TensorDictBase:
    """Return a history with real actions and forecast moved by ``[*B, n, d_a]``; empty entries stay zero."""
    moved = history.copy()
    for name, from_end in (("actions", True), ("forecast", False)):
        entry, steps = history[name], history["steps" if from_end else "forecast_steps"]
        position = torch.arange(entry.shape[-2], device=entry.device)
        real = position >= len(position) - steps if from_end else position < steps
        moved[name] = entry + real.unsqueeze(-1) * by[..., : len(position), :]
    return moved


class HistoryShift(Drawing, TensorDictModuleBase):
    """A policy with normal noise on the history that it reads, actions and forecast, at every decision.

    The environment's own history does not change.

    Args:
        policy: the policy.
        std: deviation of the noise, in normalised action units.
        generator: source of randomness; PyTorch's global one by default.

    Raises:
        ValueError: if ``std < 0``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import HistoryShift
        >>> from warmprior.history import window_history
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4, observation_steps=1), PastPrior(4, sigma=0.0))
        >>> zeros, steps = torch.zeros(5, 4, 2), torch.full((5, 1), 4)
        >>> data = TensorDict({"observation": torch.zeros(5, 1, 3),
        ...                    "history": window_history(zeros, steps, zeros, chunk_length=4)}, [5])
        >>> shifted = HistoryShift(actor, 0.1)(data)["prior", "loc"]
        >>> bool(shifted.any()), bool(data["history", "actions"].any())
        (True, False)
    """

    def __init__(
        self, policy: WarmPriorActor, std: float, *, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        check_not_negative(std=std)
        self.policy, self.std, self.generator = policy, std, generator
        # What the policy sees of the last actions is made anew from the plain observation.
        self.in_keys = [keys.OBSERVATION if key == keys.CONDITIONED else key for key in policy.in_keys]
        self.out_keys = policy.out_keys

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Disturb the history and act."""
        history = tensordict[keys.HISTORY]
        longest = max(history[name].shape[-2] for name in ("actions", "forecast"))
        actions = history["actions"]
        like = {"dtype": actions.dtype, "device": actions.device, "generator": self.chosen_generator()}
        noise = torch.randn((*actions.shape[:-2], longest, actions.shape[-1]), **like)
        disturbed = tensordict.copy().set(keys.HISTORY, shifted(history, self.std * noise))
        out = self.policy(observe_history(self.policy, disturbed))
        return tensordict.update(out.select(*self.out_keys))
