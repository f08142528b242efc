"""Checks of numbers, tensors and devices."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # options are checked before PyTorch is imported
    import torch
    from tensordict.utils import NestedKey
    from torch import Tensor

LARGEST = 1e9
"""The largest number in any unit: a larger one is damage, which squashes all others or overflows."""


def given(**values: Any) -> dict[str, Any]:
    """Return the arguments that are not ``None``, which neither checks nor torch.compile take."""
    return {name: value for name, value in values.items() if value is not None}


def check_finite_numbers(**values: Any) -> None:
    """Raise ValueError for the first value that is not a number up to 1e9, positive or negative."""
    for name, value in values.items():
        try:
            finite = not isinstance(value, bool) and math.isfinite(value) and abs(value) <= LARGEST
        except (TypeError, ValueError, OverflowError):
            finite = False
        if not finite:
            raise ValueError(f"{name} must be a finite number up to {LARGEST:g}, got {value!r}")


def check_whole_numbers(least: int = 1, /, **values: Any) -> None:
    """Raise ValueError for the first value that is not a whole number from ``least`` to below 2**63."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) < 2**63:
            raise ValueError(f"{name} must be a whole number of at least {least}, below 2**63, got {value!r}")


def _check_range(values: Mapping[str, Any], holds: Callable[[float], bool], words: str) -> None:
    check_finite_numbers(**values)
    for name, value in values.items():
        if not holds(value):
            raise ValueError(f"{name} must be {words}, got {value}")


def check_positive(**values: Any) -> None:
    """Raise ValueError for the first value that is not a finite number > 0."""
    _check_range(values, lambda value: value > 0, "> 0")


def check_not_negative(**values: Any) -> None:
    """Raise ValueError for the first value that is not a finite number >= 0."""
    _check_range(values, lambda value: value >= 0, ">= 0")


def check_share(**values: Any) -> None:
    """Raise ValueError for the first value that is not a number in [0, 1)."""
    _check_range(values, lambda value: 0 <= value < 1, "in [0, 1)")


def check_between(low: float, high: float, /, **values: Any) -> None:
    """Raise ValueError for the first value that is not a number in the interval, ends included."""
    _check_range(values, lambda value: low <= value <= high, f"between {low} and {high}")


def all_usable(values: Tensor) -> bool:
    """Return True unless a tensor holds NaN, infinity, or a number above 1e9."""
    # As Python's numbers, since the bound is infinite in half precision; False for NaN.
    return not values.numel() or all(-LARGEST <= end.item() <= LARGEST for end in values.aminmax())


def is_true(key: NestedKey, value: Any) -> bool:
    """Return a flag that says whether a task is solved; raise ValueError for all but 0 and 1."""
    import torch

    number = torch.as_tensor(value)
    if number.numel() != 1 or number.item() not in (0, 1):
        raise ValueError(
            f"success is read from {key!r}, which is {number.tolist()} and neither True (1) nor False (0): "
            "have the environment write a flag, and name this number in measures"
        )
    return bool(number)


def check_choice(name: str, value: Any, choices: Iterable[str]) -> None:
    """Raise ValueError if a value is none of the choices."""
    if value not in (listed := list(choices)):
        raise ValueError(f"{name} must be one of {', '.join(listed)}, got {value!r}")


def check_distinct(what: str, names: Sequence[str]) -> None:
    """Raise ValueError if there is no name, or one occurs twice."""
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{what} must be different names, got {list(names)}")


def check_device(device: torch.device | str) -> None:
    """Raise ValueError if a device, such as ``"cuda"``, is unknown or does not work."""
    import torch

    try:
        # Compute and read a value: some devices exist only by name, such as meta.
        torch.ones(1, device=device).add(1).item()
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(
            f"the device {device} does not work here ({reason}): choose another, such as cpu"
        ) from error


def check_shape(name: str, value: Any, expected: Sequence[int | str]) -> None:
    """Raise ValueError if a tensor or array has another shape; a named dimension may have any size."""
    shape = tuple(value.shape)
    if shape == tuple(expected):
        return
    pairs = zip(shape, expected, strict=False)
    if len(shape) != len(expected) or any(isinstance(n, int) and size != n for size, n in pairs):
        raise ValueError(f"{name} has shape {list(shape)}, expected [{', '.join(map(str, expected))}]")


def check_keys(place: Any, needed: Iterable[NestedKey], whose: str, hint: str = "") -> None:
    """Raise KeyError, with a hint, for needed keys that a tensordict or spec lacks."""
    from tensordict.utils import unravel_key

    needed = list(needed)
    try:
        missing = [key for key in needed if place.get(key, None) is None]
    except (IndexError, ValueError):  # a nested key under an entry that is no group
        missing = [key for key in needed if unravel_key(key) not in place.keys(True)]
    if missing:
        raise KeyError(f"{whose} needs the keys {needed}; missing: {missing}{hint}")


def check_positions(key: NestedKey, chunk: Tensor, prior: Any) -> None:
    """Raise ValueError if chunks ``[*B, P, d_a]`` have another length than a prior predicts."""
    if chunk.shape[-2] != prior.prediction_length:
        raise ValueError(
            f"{key} has {chunk.shape[-2]} positions, but {prior} predicts {prior.prediction_length}: make "
            "the windows for this length"
        )


def check_finite_steps(key: NestedKey, value: Tensor, memory: int = 2**22) -> None:
    """Raise ValueError for the first NaN or infinity of data ``[N, *]``, which may be memory-mapped."""
    import torch

    if not value.is_floating_point():
        return
    steps = max(1, memory * len(value) // max(1, value.numel()))
    for first in range(0, len(value), steps):
        part = torch.isfinite(value[first : first + steps])
        finite = part.reshape(len(part), -1).all(1)
        if not finite.all():
            bad = first + int((~finite).nonzero()[0])
            raise ValueError(f"{key!r} holds NaN or Inf, first at step {bad}")


def check_finite(
    tensors: Mapping[Any, Tensor],
    cause: str = "the training has diverged; lower the learning rate or check the rewards",
) -> None:
    """Raise FloatingPointError at NaN or infinity, with the tensors' names and what to check."""
    import torch

    wrong = [str(name) for name, value in tensors.items() if not torch.isfinite(value).all()]
    if wrong:
        more = f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        raise FloatingPointError(f"NaN or infinity in {', '.join(wrong[:4])}{more}: {cause}")
