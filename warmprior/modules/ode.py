"""The path from the source to the action chunk, and the integration of a velocity network along it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior import keys
from warmprior.modules.checks import check_finite_numbers, check_keys
from warmprior.modules.network import network_observation, velocity_field
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.registry import Registered


class Interpolant(Registered):
    r"""The path :math:`a_t = \alpha(t) a_0 + \beta(t) a_1` and its velocity.

    Subclasses give :meth:`coefficients` and, for files, a ``name``. The coefficients must satisfy
    :math:`\alpha(0)=\beta(1)=1` and :math:`\alpha(1)=\beta(0)=0`, so that the flow starts at the source and
    ends at the data.

    Examples:
        >>> import math
        >>> import torch
        >>> from warmprior import Interpolant
        >>> class SineInterpolant(Interpolant):
        ...     name = "sine"
        ...     def coefficients(self, t):
        ...         beta = torch.sin(math.pi / 2 * t) ** 2
        ...         speed = math.pi / 2 * torch.sin(math.pi * t)
        ...         return 1 - beta, beta, -speed, speed
        >>> a_t, velocity = SineInterpolant()(torch.zeros(1, 2, 1), torch.ones(1, 2, 1), torch.tensor([0.5]))
        >>> round(float(a_t[0, 0]), 3), round(float(velocity[0, 0]), 3)
        (0.5, 1.571)
    """

    def coefficients(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        r"""Return :math:`\alpha, \beta, \dot\alpha, \dot\beta` at times ``t`` in [0, 1], each like ``t``."""
        raise NotImplementedError

    def __call__(
        self, a0: Tensor, a1: Tensor, t: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        r"""Point on the path and its velocity :math:`\dot\alpha a_0 + \dot\beta a_1`, each ``[*B, P, d_a]``.

        Source and data are ``[*B, P, d_a]``, the times ``[*B]``. The generator is of the noise of a path that
        has some.
        """
        alpha, beta, d_alpha, d_beta = self.coefficients(t[..., None, None])
        return alpha * a0 + beta * a1, d_alpha * a0 + d_beta * a1


class LinearInterpolant(Interpolant):
    r"""Straight line: :math:`\alpha = 1 - t`, :math:`\beta = t` (Lipman et al., 2023; the paper's).

    Examples:
        >>> from warmprior import LinearInterpolant
        >>> import torch
        >>> a0, a1 = torch.zeros(1, 2, 1), torch.ones(1, 2, 1)
        >>> a_t, velocity = LinearInterpolant()(a0, a1, torch.tensor([0.25]))
        >>> a_t.flatten().tolist(), velocity.flatten().tolist()
        ([0.25, 0.25], [1.0, 1.0])
    """

    name = "linear"

    def coefficients(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Coefficients of the straight line."""
        one = torch.ones_like(t)
        return 1 - t, t, -one, one


class BridgeInterpolant(Interpolant):
    r"""Brownian bridge: the straight line with noise between its ends (Tong et al., 2024, Sec. 3.4).

    .. math::
        a_t = (1 - t) a_0 + t a_1 + \sigma \sqrt{t (1 - t)} \, \varepsilon, \qquad
        u_t = a_1 - a_0 + \sigma \frac{1 - 2t}{2 \sqrt{t (1 - t)}} \, \varepsilon .

    On pairs of :class:`~warmprior.objectives.BridgeCoupling` the mean of :math:`u_t` given :math:`a_t` is the
    probability flow of the Schroedinger bridge. The velocity grows without bound towards the ends: times are
    kept 0.001 away from them.

    Args:
        sigma: of the noise, > 0, in normalised action units.

    Raises:
        ValueError: if ``sigma`` is not a finite number > 0.

    Examples:
        >>> import torch
        >>> from warmprior import BridgeInterpolant
        >>> a0, a1, t = torch.zeros(1, 1, 1), torch.ones(1, 1, 1), torch.tensor([0.5])
        >>> a_t, velocity = BridgeInterpolant(0.2)(a0, a1, t, torch.Generator().manual_seed(0))
        >>> bool(a_t != 0.5), velocity.item()
        (True, 1.0)
    """

    name = "bridge"

    def __init__(self, sigma: float = 0.5) -> None:
        check_finite_numbers(sigma=sigma)
        if sigma <= 0:
            raise ValueError(f"sigma must be a finite number > 0, got {sigma}")
        self.sigma = float(sigma)

    coefficients = LinearInterpolant.coefficients

    def __call__(
        self, a0: Tensor, a1: Tensor, t: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Point on the path and its velocity, with noise of ``generator``."""
        point, velocity = super().__call__(a0, a1, t)
        t = t[..., None, None].clamp(1e-3, 1 - 1e-3)
        width = (t * (1 - t)).sqrt()
        noise = torch.randn(point.shape, generator=generator, dtype=point.dtype, device=point.device)
        noise = self.sigma * noise
        return point + width * noise, velocity + (1 - 2 * t) / (2 * width) * noise


JUMP = 0.5
"""Where the dense steps of ``dense-jump`` end; Chen et al. saw fields pull towards training actions later."""


def check_grid(grid: str) -> None:
    """A ``ValueError`` if no grid has this name, or its jump does not start in (0, 1)."""
    _jump(grid)


def grid_parts(grid: str, steps: int, *, start_time: float = 0.0) -> list[tuple[float, float, int]]:
    """The parts of a grid as begin, end and number of steps; within each the steps are equally long.

    - ``"uniform"``: one part.
    - ``"dense-jump"``: all steps but one up to :math:`t_j`, and the last from there to ``t = 1`` (Dense-Jump
      Flow Matching, Chen et al., 2025, arXiv:2509.13574). It avoids late steps, which pull towards actions of
      the training data, and is meant for networks trained at ``u-shaped`` times. :math:`t_j` is half way from
      ``start_time`` to 1; ``"dense-jump:0.7"`` moves it.

    One step is the same on every grid. A ``ValueError`` as of :func:`check_grid`.

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
    """Share of the way before the jump; ``None`` without a jump."""
    if grid == "uniform":
        return None
    name, colon, number = str(grid).partition(":")
    if name != "dense-jump":
        raise ValueError(
            f"unknown grid {grid!r}; choose one of uniform, dense-jump, or dense-jump:TIME with a time in "
            "(0, 1)"
        )
    try:
        share = float(number) if colon else JUMP
    except ValueError:
        share = float("nan")
    if not 0.0 < share < 1.0:
        raise ValueError(f"the jump of a grid must start in (0, 1), got {grid!r}")
    return share


DEFAULT_NFE = 9
"""Network evaluations per chunk by default."""

MAX_NFE = 10_000
"""More would take minutes per chunk, and look like a process that hangs."""

GUIDED_BY = (keys.FORECAST, keys.FORECAST_STEPS, keys.DELAY)
"""The further inputs of guided policies."""

GUIDED_BY_WHOM = (
    ". The delay is written by InferenceDelay in an environment, as by policy_transforms(prior, "
    "delay=0), and by AsyncExecutor on a robot"
)

Velocity = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _Tableau:
    """An explicit Runge-Kutta method: nodes ``c``, rows ``a`` below the diagonal, weights ``b``."""

    c: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]


SOLVERS: dict[str, _Tableau] = {
    "euler": _Tableau((0.0,), ((),), (1.0,)),
    "midpoint": _Tableau((0.0, 0.5), ((), (0.5,)), (0.0, 1.0)),
    "heun": _Tableau((0.0, 1.0), ((), (1.0,)), (0.5, 0.5)),
    "rk4": _Tableau(
        (0.0, 0.5, 0.5, 1.0), ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
    ),
}

Solver = Literal["euler", "midpoint", "heun", "rk4"]


def _steps(nfe: int, solver: str) -> int:
    if solver not in SOLVERS:
        raise ValueError(f"unknown solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    stages = len(SOLVERS[solver].b)
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
        velocity: ``(t [B], a_t [B, ...]) -> velocity [B, ...]``.
        a0: source, ``[B, ...]``.
        nfe: calls of ``velocity``, a multiple of the solver's stages (Euler 1, midpoint and Heun 2, RK4 4).
        solver: ``"euler"`` (the paper's), ``"midpoint"``, ``"heun"`` or ``"rk4"``.
        grid: where the steps lie, see :func:`~warmprior.modules.ode.grid_parts`.
        start_time: another time to start from, in [0, 1).
        return_path: return every grid point instead of the last.

    Returns:
        ``a_1`` ``[B, ...]``, or the path ``[B, steps + 1, ...]`` from ``a_0`` to ``a_1``.

    Raises:
        ValueError: for an option that is unknown or out of range.

    Examples:
        >>> import torch
        >>> from warmprior import integrate
        >>> float(integrate(lambda t, a: a, torch.ones(1, 1), nfe=4, solver="rk4"))  # e = 2.71828...
        2.7083...
    """
    steps = _steps(nfe, solver)
    if not 0.0 <= start_time < 1.0:
        raise ValueError(f"start_time must be in [0, 1), got {start_time}")
    tableau = SOLVERS[solver]
    a = a0
    path = [a0]
    for begin, end, count in grid_parts(grid, steps, start_time=start_time):
        h = (end - begin) / count
        for step in range(count):
            slopes: list[Tensor] = []
            for node, row in zip(tableau.c, tableau.a, strict=True):
                time = begin + (step + node) * h
                t = torch.full(a.shape[:1], time, dtype=a.dtype, device=a.device)
                slopes.append(velocity(t, _combine(a, h, row, slopes)))
            a = _combine(a, h, tableau.b, slopes)
            if return_path:
                path.append(a)
    return torch.stack(path, dim=1) if return_path else a


class ODEActor(TensorDictModuleBase):
    """Transports the source to an action chunk: ``(noise, observation) -> chunk``.

    Args:
        network: velocity network ``(t [B], a_t [B, P, d_a], observation [B, To, d_o]) -> [B, P, d_a]``. An
            observation of several entries, nested under its key, arrives as a tensordict ``[B]``.
        nfe: network evaluations per chunk; per call: ``actor(data, nfe=3)``. 9 by default, or ``max_nfe``.
        max_nfe: the largest ``nfe`` that the training allows.
        start_time: see :func:`integrate`.
        solver: see :func:`integrate`.
        grid: see :func:`integrate`.
        clip: the chunk is clamped to ``[-clip, clip]``, one bound for all action dimensions or one for each.
            Set it to the range of the normalised data, such as 1: then the environment executes what the
            prior remembers.
        guidance: makes chunks continue the one being executed. It reads the rest of that chunk,
            ``("history", "forecast")`` and ``("history", "forecast_steps")``, and the delay.
        observation_key: key of the observation, ``[*B, To, d_o]``.

    Raises:
        ValueError: for an option that is unknown, out of range or not what the network is trained for.
        KeyError: if an input key is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ODEActor, VelocityMLP
        >>> actor = ODEActor(VelocityMLP(action_dim=2, observation_dim=3, prediction_length=4), nfe=9)
        >>> data = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...                    ("prior", "noise"): torch.randn(5, 4, 2)}, [5])
        >>> actor(data, nfe=1)["vla_action", "chunk"].shape
        torch.Size([5, 4, 2])
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        nfe: int | None = None,
        max_nfe: int | None = None,
        start_time: float = 0.0,
        solver: Solver = "euler",
        grid: str = "uniform",
        clip: float | Sequence[float] | None = None,
        guidance: RealTimeChunking | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
    ) -> None:
        super().__init__()
        if nfe is None:
            nfe = DEFAULT_NFE if max_nfe is None else min(DEFAULT_NFE, max_nfe)
            if solver in SOLVERS:  # rounded down to a multiple of the stages
                stages = len(SOLVERS[solver].b)
                nfe = max(nfe - nfe % stages, stages)
        self.max_nfe = max_nfe
        self.start_time = start_time
        self.solver = solver
        self.check_nfe(nfe)
        check_grid(grid)
        # A list, as the configuration of a saved policy has it.
        clip = clip if clip is None or isinstance(clip, int | float) else list(clip)
        bounds = clip if isinstance(clip, list) else [1.0 if clip is None else clip]
        # A constant dimension is bounded by 0, but not all of them are constant.
        if not (all(bound >= 0 for bound in bounds) and any(bound > 0 for bound in bounds)):
            raise ValueError(f"clip must be > 0, one such number per dimension, or None, got {clip}")
        width = getattr(network, "action_dim", None)
        if isinstance(clip, list) and width not in (None, len(clip)):
            raise ValueError(f"clip has {len(clip)} bounds, but the network has {width} action dimensions")
        if guidance is not None and max_nfe == 1:
            raise ValueError(
                "the network is trained at t = 0 alone, which is no flow to guide: leave the guidance out"
            )
        self.network = network
        self.nfe = nfe
        self.grid = grid
        self.clip = clip
        self.guidance = guidance
        self.in_keys = [keys.NOISE, observation_key]
        if guidance is not None:
            self.in_keys += GUIDED_BY
        self.out_keys = [keys.CHUNK]

    def check_nfe(self, nfe: int) -> None:
        """A ``ValueError`` unless solver and network support ``nfe`` network evaluations."""
        _steps(nfe, self.solver)
        if self.max_nfe is not None and nfe > self.max_nfe:
            raise ValueError(
                f"the network is trained for at most {self.max_nfe} network evaluation(s) per chunk, got "
                f"nfe={nfe}"
            )

    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, sigma: Tensor | None = None
    ) -> TensorDictBase:
        """Write the chunk; ``sigma``, 1 by default, is the source's deviation for the guidance."""
        nfe = self.nfe if nfe is None else nfe
        self.check_nfe(nfe)
        check_keys(tensordict, self.in_keys[:2], "ODEActor")
        check_keys(tensordict, self.in_keys[2:], "ODEActor", GUIDED_BY_WHOM)
        a0, observation, *rest = (tensordict.get(key) for key in self.in_keys)
        velocity = velocity_field(self.network, network_observation(observation, a0.shape[:-2]))
        if self.guidance is not None:
            leftover, left, delay = rest
            scale = torch.ones_like(a0) if sigma is None else sigma.expand_as(a0)
            velocity = self.guidance.guided(
                velocity,
                leftover.reshape(-1, *a0.shape[-2:]).to(a0.dtype),
                left.reshape(-1, 1),
                delay.reshape(-1, 1),
                scale.reshape(-1, *a0.shape[-2:]),
            )
        chunk = integrate(
            velocity,
            a0.reshape(-1, *a0.shape[-2:]),
            nfe=nfe,
            solver=self.solver,
            grid=self.grid,
            start_time=self.start_time,
        ).reshape(a0.shape)
        if isinstance(self.clip, list):
            bound = torch.tensor(self.clip, dtype=chunk.dtype, device=chunk.device)
            chunk = chunk.clamp(-bound, bound)
        elif self.clip is not None:
            chunk = chunk.clamp(-self.clip, self.clip)
        return tensordict.set(keys.CHUNK, chunk)
