"""Integration from the source to the action chunk, and its options: NFE, solver, grid, clip, temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from warmprior import keys
from warmprior.checks import (
    check_choice,
    check_keys,
    check_not_negative,
    check_positive,
    check_share,
    check_whole_numbers,
    given,
)
from warmprior.modules.network import network_observation, velocity_field
from warmprior.modules.real_time_chunking import RealTimeChunking, Velocity
from warmprior.options.evaluation import DEFAULT_NFE

JUMP = 0.5
"""The end of the dense steps of ``dense-jump``; Chen et al. saw fields pull to training actions after it."""


def grid_parts(grid: str, steps: int, *, start_time: float = 0.0) -> list[tuple[float, float, int]]:
    """Return the parts of a grid as (begin, end, number of steps), each with steps of equal length.

    - ``"uniform"``: one part.
    - ``"dense-jump"``: all steps but one up to :math:`t_j`, and the last from there to ``t = 1`` (Dense-Jump
      Flow Matching, Chen et al., 2025, arXiv:2509.13574). It avoids late steps, which pull towards actions of
      the training data, and is meant for networks trained at ``u-shaped`` times. :math:`t_j` is half way from
      ``start_time`` to 1; ``"dense-jump:0.7"`` moves it.

    A single step is the same on every grid. Raises ValueError at an unknown grid, or a jump outside (0, 1).

    Examples:
        >>> from warmprior.modules.ode import grid_parts
        >>> grid_parts("dense-jump:0.75", 4), grid_parts("dense-jump", 1)
        ([(0.0, 0.75, 3), (0.75, 1.0, 1)], [(0.0, 1.0, 1)])
    """
    share = _jump(grid)
    if share is None or steps == 1:
        return [(start_time, 1.0, steps)]
    jump = start_time + share * (1.0 - start_time)
    return [(start_time, jump, steps - 1), (jump, 1.0, 1)]


def _jump(grid: str) -> float | None:
    """Return the share of the way before a grid's jump, or ``None`` without one."""
    if grid == "uniform":
        return None
    name, colon, number = str(grid).partition(":")
    try:
        share = float(number) if colon else JUMP
    except ValueError:
        share = float("nan")
    if name != "dense-jump" or not 0.0 < share < 1.0:
        raise ValueError(
            f"grid must be uniform, dense-jump, or dense-jump:TIME with a time in (0, 1), got {grid!r}"
        )
    return share


MAX_NFE = 10_000
"""The largest ``nfe``: more would take minutes per chunk, and look like a process that hangs."""

SOLVERS: dict[str, tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]] = {
    "euler": (((),), (1.0,)),
    "midpoint": (((), (0.5,)), (0.0, 1.0)),
    "heun": (((), (1.0,)), (0.5, 0.5)),
    "rk4": (((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6)),
}
"""Explicit Runge-Kutta methods: rows below the diagonal, whose sums are the nodes, and weights."""

Solver = Literal["euler", "midpoint", "heun", "rk4"]


def _steps(nfe: int, solver: str) -> int:
    check_choice("solver", solver, SOLVERS)
    stages = len(SOLVERS[solver][0])
    if not isinstance(nfe, Integral) or not 0 < nfe <= MAX_NFE or nfe % stages:
        raise ValueError(
            f"nfe is the number of network evaluations: it must be at most {MAX_NFE} and a "
            f"positive multiple of {stages} for the {solver} solver, got {nfe!r}"
        )
    return nfe // stages


def _combine(a: Tensor, h: float, weights: tuple[float, ...], slopes: list[Tensor]) -> Tensor:
    for weight, slope in zip(weights, slopes, strict=False):
        if weight:
            a = a + (slope if h * weight == 1.0 else (h * weight) * slope)
    return a


def integrate(
    velocity: Velocity,
    a0: Tensor,
    *,
    nfe: int,
    solver: Solver = "euler",
    grid: str = "uniform",
    start_time: float = 0.0,
    return_path: bool = False,
) -> Tensor:
    r"""Solve :math:`\dot a_t = v(t, a_t)` from ``t=0`` to ``t=1``.

    Args:
        velocity: the field ``(t [B], a_t [B, ...]) -> [B, ...]``.
        a0: the source sample, ``[B, ...]``.
        nfe: calls of ``velocity``, a multiple of the solver's stages (Euler 1, midpoint and Heun 2, RK4 4).
        solver: ``"euler"`` (the paper's), ``"midpoint"``, ``"heun"`` or ``"rk4"``.
        grid: where the steps lie, see :func:`~warmprior.modules.ode.grid_parts`.
        start_time: the time to start from, in [0, 1).
        return_path: True returns every grid point instead of the last.

    Returns:
        ``a_1`` ``[B, ...]``, or the path ``[B, steps + 1, ...]`` from ``a_0`` to ``a_1``.

    Raises:
        ValueError: if an option is unknown or out of range.

    Examples:
        >>> import torch
        >>> from warmprior import integrate
        >>> float(integrate(lambda t, a: a, torch.ones(1, 1), nfe=4, solver="rk4"))  # e = 2.71828...
        2.7083...
    """
    steps = _steps(nfe, solver)
    check_share(start_time=start_time)
    rows, weights = SOLVERS[solver]
    a = a0
    path = [a0]
    for begin, end, count in grid_parts(grid, steps, start_time=start_time):
        h = (end - begin) / count
        for step in range(count):
            slopes: list[Tensor] = []
            for row in rows:
                time = begin + (step + sum(row)) * h
                t = torch.full(a.shape[:1], time, dtype=a.dtype, device=a.device)
                slopes.append(velocity(t, _combine(a, h, row, slopes)))
            a = _combine(a, h, weights, slopes)
            if return_path:
                path.append(a)
    return torch.stack(path, dim=1) if return_path else a


@dataclass(frozen=True)
class Sampling:
    """The options for drawing a chunk: the noise of the source, and the integration of the flow.

    Attributes:
        nfe: network evaluations per chunk; by default 3, or what ``max_nfe`` and the solver allow.
        max_nfe: the largest ``nfe`` that the training allows: 1 for a network trained at ``t = 0`` only.
        solver: see :func:`integrate`.
        grid: see :func:`integrate`.
        clip: bound of the chunk, which is clamped to ``[-clip, clip]``; one for all action dimensions or one
            for each. Set it to the range of the normalised data, such as 1, so that the environment executes
            exactly the actions that the prior remembers.
        temperature: factor on the source's noise at decisions, ``a_0 = mu + temperature * sigma * eps``. By
            default 1, and 0 under ``ExplorationType.DETERMINISTIC``, ``MEAN``, ``MEDIAN`` or ``MODE``: the
            flow then starts at the source's mean.

    Raises:
        ValueError: if an option is unknown, out of range, or not supported by the network's training.

    Examples:
        >>> from warmprior import Sampling
        >>> Sampling().evaluations(), Sampling(max_nfe=4).evaluations(), Sampling(solver="rk4").evaluations()
        (3, 3, 4)
    """

    nfe: int | None = None
    max_nfe: int | None = None
    solver: Solver = "euler"
    grid: str = "uniform"
    clip: float | Sequence[float] | None = None
    temperature: float | None = None

    def __post_init__(self) -> None:
        check_whole_numbers(**given(nfe=self.nfe, max_nfe=self.max_nfe))
        check_choice("solver", self.solver, SOLVERS)
        self.evaluations()
        _jump(self.grid)  # raises at an unknown grid
        if isinstance(self.clip, Sequence):
            object.__setattr__(self, "clip", tuple(self.clip))
            if not self.clip:
                raise ValueError("clip must be a bound >= 0 per action dimension, got none")
            for bound in self.clip:
                check_not_negative(clip=bound)
        else:
            check_positive(**given(clip=self.clip))
        check_not_negative(**given(temperature=self.temperature))

    def evaluations(self, nfe: int | None = None) -> int:
        """Return ``nfe`` or its default; raise ValueError unless solver and network support that many."""
        nfe = self.nfe if nfe is None else nfe
        if nfe is None:
            nfe = DEFAULT_NFE if self.max_nfe is None else min(DEFAULT_NFE, self.max_nfe)
            stages = len(SOLVERS[self.solver][0])  # the default is rounded down to a multiple of these
            nfe = max(nfe - nfe % stages, stages)
        _steps(nfe, self.solver)
        if self.max_nfe is not None and nfe > self.max_nfe:
            raise ValueError(
                f"the network is trained for at most {self.max_nfe} network evaluation(s) per chunk, got "
                f"nfe={nfe}"
            )
        return nfe

    def clamped(self, chunk: Tensor) -> Tensor:
        """Return a chunk ``[*B, P, d_a]`` clamped to its bounds."""
        if isinstance(self.clip, Sequence):
            bound = torch.tensor(self.clip, dtype=chunk.dtype, device=chunk.device)
            return chunk.clamp(-bound, bound)
        return chunk if self.clip is None else chunk.clamp(-self.clip, self.clip)


class ODEActor(TensorDictModuleBase):
    """A module that integrates the source sample to an action chunk: ``(noise, observation) -> chunk``.

    Args:
        network: velocity network ``(t [B], a_t [B, P, d_a], observation [B, To, d_o]) -> [B, P, d_a]``. An
            observation of several entries, nested under its key, arrives as a tensordict ``[B]``.
        start_time: where integration starts, see :func:`integrate`.
        guidance: makes chunks continue the one being executed. It reads the history's
            ``"forecast"`` and ``"forecast_steps"``, what is left of that chunk, and the delay.
        observation_key: key of the observation, ``[*B, To, d_o]``.
        history_key: key of the history, which guidance reads.
        source_key: parent key of the source sample, ``(source_key, "noise")``, ``[*B, P, d_a]``.
        chunk_key: where to write the chunk, ``[*B, P, d_a]``.
        **sampling: options of :class:`Sampling`; ``nfe`` can also be set per call: ``actor(data, nfe=3)``.

    Raises:
        ValueError: if an option is unknown, out of range, or not supported by the network's training.
        KeyError: if an input key is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ODEActor, VelocityMLP
        >>> actor = ODEActor(VelocityMLP(action_dim=2, observation_dim=3, prediction_length=4), nfe=9)
        >>> noise, observation = torch.randn(5, 4, 2), torch.zeros(5, 2, 3)
        >>> data = TensorDict({"observation": observation, ("prior", "noise"): noise}, [5])
        >>> chunk = actor(data, nfe=1)["vla_action", "chunk"]
        >>> bool((chunk == actor(prior_noise=noise, observation=observation, nfe=1)).all()), chunk.shape
        (True, torch.Size([5, 4, 2]))
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        start_time: float = 0.0,
        guidance: RealTimeChunking | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
        history_key: NestedKey = keys.HISTORY,
        source_key: NestedKey = keys.SOURCE,
        chunk_key: NestedKey = keys.CHUNK,
        **sampling: Any,
    ) -> None:
        super().__init__()
        check_share(start_time=start_time)
        self.sampling = Sampling(**sampling)
        clip, width = self.sampling.clip, getattr(network, "action_dim", None)
        if isinstance(clip, tuple) and width not in (None, len(clip)):
            raise ValueError(f"clip has {len(clip)} bounds, but the network has {width} action dimensions")
        if guidance is not None and self.sampling.max_nfe == 1:
            raise ValueError(
                "the network is trained at t = 0 alone, which is no flow to guide: leave the guidance out"
            )
        self.network, self.start_time, self.guidance = network, start_time, guidance
        self.observation_key = observation_key
        self.in_keys = [unravel_key((source_key, "noise")), observation_key]
        if guidance is not None:
            forecast = [unravel_key((history_key, name)) for name in ("forecast", "forecast_steps")]
            self.in_keys += [*forecast, keys.DELAY]
        self.out_keys = [chunk_key]

    @dispatch(auto_batch_size=False)
    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, sigma: Tensor | None = None
    ) -> TensorDictBase:
        """Write the chunk; ``sigma``, 1 by default, is the source's deviation, which guidance uses."""
        values: list[Any] = [tensordict.get(key, None) for key in self.in_keys]
        if any(value is None for value in values):
            check_keys(tensordict, self.in_keys[:2], "ODEActor")
            writers = (
                ". The delay is written by InferenceDelay in an environment, as by policy_transforms(prior, "
                "delay=0), and by AsyncExecutor on a robot"
            )
            check_keys(tensordict, self.in_keys[2:], "ODEActor", writers)
        a0, observation, *guiding = values
        velocity = velocity_field(self.network, network_observation(observation, a0.shape[:-2]))
        if self.guidance is not None:
            forecast, forecast_steps, delay = guiding
            scale = torch.ones_like(a0) if sigma is None else sigma.expand_as(a0)
            velocity = self.guidance.guided(
                velocity,
                forecast.reshape(-1, *a0.shape[-2:]).to(a0.dtype),
                forecast_steps.reshape(-1, 1),
                delay.reshape(-1, 1),
                scale.reshape(-1, *a0.shape[-2:]),
            )
        chunk = integrate(
            velocity,
            a0.reshape(-1, *a0.shape[-2:]),
            nfe=self.sampling.evaluations(nfe),
            solver=self.sampling.solver,
            grid=self.sampling.grid,
            start_time=self.start_time,
        )
        return tensordict.set(self.out_keys[0], self.sampling.clamped(chunk.reshape(a0.shape)))
