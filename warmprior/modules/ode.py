"""Integration from the source to the action chunk."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from warmprior import keys
from warmprior.checks import check_keys, check_share
from warmprior.modules.network import network_observation, velocity_field
from warmprior.modules.real_time_chunking import RealTimeChunking, Velocity
from warmprior.modules.sampling import SOLVERS, Sampling, Solver, grid_parts, steps_of


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
        grid: where the steps lie, see :func:`~warmprior.modules.sampling.grid_parts`.
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
    steps = steps_of(nfe, solver)
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
