"""Checks of numbers given to constructors."""

from __future__ import annotations

import math
from numbers import Integral
from typing import Any

__all__ = ["check_finite_numbers", "check_whole_numbers"]


def check_finite_numbers(**values: Any) -> None:
    """Raise ValueError for the first of them that is no finite number."""
    for name, value in values.items():
        try:
            finite = not isinstance(value, bool) and math.isfinite(value)
        except (TypeError, ValueError, OverflowError):
            finite = False
        if not finite:
            raise ValueError(f"{name} must be a finite number, got {value!r}")


def check_whole_numbers(**values: Any) -> None:
    """Raise ValueError for the first of them that is no whole number of at least 1."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
