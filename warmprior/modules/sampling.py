"""Options for drawing a chunk: network evaluations, solver, grid, clip and temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal

import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from warmprior.checks import check_choice, check_not_negative, check_positive, check_whole_numbers, given
from warmprior.options.defaults import DEFAULT_NFE

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
        >>> from warmprior.modules.sampling import grid_parts
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


def steps_of(nfe: int, solver: str) -> int:
    """Return the number of steps; raise ValueError at an unknown solver or a number that does not fit it."""
    check_choice("solver", solver, SOLVERS)
    stages = len(SOLVERS[solver][0])
    if not isinstance(nfe, Integral) or not 0 < nfe <= MAX_NFE or nfe % stages:
        raise ValueError(
            f"nfe is the number of network evaluations: it must be at most {MAX_NFE} and a "
            f"positive multiple of {stages} for the {solver} solver, got {nfe!r}"
        )
    return nfe // stages


def effective_temperature(temperature: float | None) -> float:
    """Return a decision's temperature: by default 1, or 0 while TorchRL explores deterministically."""
    if temperature is not None:
        return temperature
    return 1.0 if exploration_type() in (None, ExplorationType.RANDOM) else 0.0


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
        steps_of(nfe, self.solver)
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
