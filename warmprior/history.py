"""The history: what the robot did and what it planned to do, as a value with one layout.

Training windows, environments, the executor and LeRobot's adapter write the same layout under
:data:`warmprior.keys.HISTORY`, and a prior reads it (:meth:`Prior.mean`), so that a prior's mean is computed
from the same values everywhere.

=====================  =========================  =====================================================
entry                  shape                      meaning, in the normalised action space
=====================  =========================  =====================================================
``"actions"``          ``[*B, H, d_a]`` float     the last ``H`` executed actions, the oldest first; 0
                                                  where the episode has none
``"steps"``            ``[*B, 1]`` int64          how many of them are real, counted from the newest
``"forecast"``         ``[*B, P, d_a]`` float     the last prediction for the next ``P`` steps, 0 after its
                                                  end
``"forecast_steps"``   ``[*B, 1]`` int64          how many of them it covers
=====================  =========================  =====================================================

A training window holds the target's first ``P - H`` actions as a perfect forecast (Eq. 3), and no more of
the target. At decisions after ``k < H`` actions the forecast covers ``P - k`` steps (Eq. 4): priors read its
first ``P - H``, Real-Time Chunking reads all of it.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_keys

__all__ = [
    "ENTRIES",
    "advance",
    "caught_up",
    "check_history",
    "cold_history",
    "history_keys",
    "window_history",
    "without",
]

ENTRIES = ("actions", "steps", "forecast", "forecast_steps")


def history_keys(history_key: NestedKey = keys.HISTORY) -> list[NestedKey]:
    """Return the keys of a history's entries in a tensordict."""
    return [unravel_key((history_key, name)) for name in ENTRIES]


def cold_history(
    batch_size: Any, history_length: int, prediction_length: int, action_dim: int, **like: Any
) -> TensorDict:
    """Return the history of robots that have not acted yet; ``dtype`` and ``device`` as in ``torch.zeros``.

    Examples:
        >>> from warmprior.history import cold_history
        >>> cold_history([5], history_length=4, prediction_length=8, action_dim=2)["forecast"].shape
        torch.Size([5, 8, 2])
    """
    actions, forecast = (
        torch.zeros(*batch_size, length, action_dim, **like) for length in (history_length, prediction_length)
    )
    none = torch.zeros(*batch_size, 1, dtype=torch.int64, device=like.get("device"))
    return _history(batch_size, actions, none, forecast, none.clone())


def advance(history: TensorDictBase, chunk: Tensor, executed: Tensor) -> TensorDict:
    """Return the history after some actions of a chunk were executed, in the history's dtypes.

    A row that executes nothing keeps its actions, and its forecast becomes the chunk; after a partial step
    the caller restores the history of resting rows.

    Args:
        history: the history before the decision, ``[*B]``.
        chunk: the chunk being executed, ``[*B, P, d_a]``.
        executed: number of its actions that were executed, at most ``H``, int64 ``[*B, 1]``.

    Raises:
        ValueError: if chunk and forecast differ in length, or ``executed`` is out of range.

    Examples:
        >>> import torch
        >>> from warmprior.history import advance, cold_history
        >>> chunk = torch.arange(1.0, 5.0)[:, None]
        >>> history = advance(cold_history([], 2, 4, 1), chunk, torch.tensor([1]))
        >>> {key: value.flatten().tolist() for key, value in sorted(history.items())}
        {'actions': [0.0, 1.0], 'forecast': [2.0, 3.0, 4.0, 0.0], 'forecast_steps': [3], 'steps': [1]}
    """
    before, shape = history["actions"], history["forecast"].shape
    remembered, length = before.shape[-2], shape[-2]
    if chunk.shape != shape:
        raise ValueError(
            f"the chunk has shape {tuple(chunk.shape)}, but the history's forecast {tuple(shape)}: give both "
            "the same prediction length"
        )
    low, high = map(int, torch.aminmax(executed)) if executed.numel() else (0, 0)
    if not 0 <= low <= high <= min(remembered, length):
        raise ValueError(
            f"a decision executed {high if low >= 0 else low} actions, but the history remembers "
            f"{remembered} and the chunk has {length}: execute between 0 and {min(remembered, length)}"
        )
    chunk = chunk.to(before.dtype)
    # In [actions, chunk, zeros] the last executed actions begin at k, and the rest of the chunk follows.
    line = torch.cat([before, chunk, torch.zeros_like(chunk[..., :remembered, :])], -2)
    if low == high:  # one robot, or all in step: a slice, at a third of the time
        moved = line[..., low : low + remembered + length, :]
    else:
        index = (executed + torch.arange(remembered + length, device=executed.device)).unsqueeze(-1)
        moved = line.gather(-2, index.expand(*index.shape[:-1], line.shape[-1]))
    actions, forecast = moved[..., :remembered, :], moved[..., remembered:, :]
    steps = (history["steps"] + executed).clamp(max=remembered)
    return _history(history.batch_size, actions, steps, forecast, length - executed)


def caught_up(history: TensorDictBase, chunk: Tensor, executed: Tensor) -> TensorDict:
    """Return the history after up to all actions of a chunk, possibly more than it remembers.

    This extends :func:`advance` to robots that go on while a decision is late.

    Examples:
        >>> import torch
        >>> from warmprior.history import caught_up, cold_history
        >>> chunk = torch.arange(1.0, 5.0)[:, None]
        >>> history = caught_up(cold_history([], 2, 4, 1), chunk, torch.tensor([3]))
        >>> {key: value.flatten().tolist() for key, value in sorted(history.items())}
        {'actions': [2.0, 3.0], 'forecast': [4.0, 0.0, 0.0, 0.0], 'forecast_steps': [1], 'steps': [2]}
    """
    forecast_steps, remembered = chunk.shape[-2] - executed, history["actions"].shape[-2]
    while True:
        some = executed.clamp(max=remembered)
        history = advance(history, chunk, some)
        chunk, executed = history["forecast"], executed - some
        if not executed.any():
            return history.update({"forecast_steps": forecast_steps})


def window_history(before: Tensor, steps: Tensor, target: Tensor, chunk_length: int) -> TensorDict:
    """Return the history of a training window (Eq. 3).

    Args:
        before: the actions before the window, ``[*B, H, d_a]``, 0 before the episode's start.
        steps: steps since the episode began, int64 ``[*B, 1]``.
        target: the chunk to predict, ``[*B, P, d_a]``.
        chunk_length: ``H``.

    Examples:
        >>> import torch
        >>> from warmprior.history import window_history
        >>> target = torch.arange(1.0, 5.0)[:, None]
        >>> window_history(torch.zeros(2, 1), torch.tensor([0]), target, 2)["forecast"].flatten().tolist()
        [1.0, 2.0, 0.0, 0.0]
    """
    batch_size, ahead = target.shape[:-2], target.shape[-2] - chunk_length
    if not batch_size == before.shape[:-2] == steps.shape[:-1]:
        shapes = f"{tuple(before.shape)}, {tuple(steps.shape)} and {tuple(target.shape)}"
        raise ValueError(f"need shapes [*B, H, d_a], [*B, 1] and [*B, P, d_a], got {shapes}")
    forecast = torch.zeros_like(target)
    forecast[..., :ahead, :] = target[..., :ahead, :]
    steps = steps.clamp_max(before.shape[-2])
    return _history(batch_size, before, steps, forecast, torch.full_like(steps, ahead))


def without(history: TensorDictBase, rows: Tensor) -> TensorDict:
    """Return a history ``[*B]`` with some rows, bool ``[*B]``, made cold.

    These are rows of new episodes, or rows withheld in training.

    Examples:
        >>> import torch
        >>> from warmprior.history import window_history, without
        >>> ones = torch.ones(2, 2, 1)
        >>> history = window_history(ones[:, :1], torch.ones(2, 1, dtype=torch.int64), ones, chunk_length=1)
        >>> without(history, torch.tensor([True, False]))["forecast_steps"].flatten().tolist()
        [0, 1]
    """
    values = (history[name] for name in ENTRIES)
    kept = (value.masked_fill(expand_as_right(rows, value), 0) for value in values)
    return _history(history.batch_size, *kept)


def _history(batch_size: Any, *values: Tensor) -> TensorDict:
    # Unchecked, because the checks take as long as a window's gathers.
    return TensorDict._new_unsafe(dict(zip(ENTRIES, values, strict=True)), batch_size=torch.Size(batch_size))


def check_history(history: Any, history_length: int, prediction_length: int, whose: Any) -> None:
    """Raise KeyError if a history is missing or incomplete, ValueError if its lengths differ."""
    values: list[Any] = [None if history is None else history.get(name, None) for name in ENTRIES]
    if any(value is None for value in values):
        writers = ". ActionHistory writes it in an environment, ActionWindow in a replay buffer"
        check_keys(TensorDict() if history is None else history, ENTRIES, f"the history of {whose}", writers)
    actions, _, forecast, _ = values
    lengths = actions.shape[-2], forecast.shape[-2]
    if lengths != (history_length, prediction_length):
        raise ValueError(
            f"{whose} needs {history_length} remembered actions and forecasts of {prediction_length}, but "
            f"the history has {lengths[0]} and {lengths[1]}: make windows and environment for these lengths"
        )
