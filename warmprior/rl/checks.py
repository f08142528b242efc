"""Checks of numbers and tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

__all__ = ["check_counts", "check_finite", "check_positive"]


def check_counts(**counts: int) -> None:
    """Raise ValueError for the first of them that is below one."""
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")


def check_positive(**values: float) -> None:
    """Raise ValueError for the first of them that is not a finite number > 0."""
    for name, value in values.items():
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(f"{name} must be a finite number > 0, got {value}")


def check_finite(
    tensors: Mapping[Any, Tensor],
    cause: str = "the training has diverged; lower the learning rate or check the rewards",
) -> None:
    """Stop at NaN or infinity.

    Args:
        tensors: of any kind, by name.
        cause: what to check, for the message.

    Raises:
        FloatingPointError: naming the tensors.

    Examples:
        >>> import torch
        >>> from warmprior.rl.checks import check_finite
        >>> check_finite({"loss_actor": torch.tensor(torch.nan)})
        Traceback (most recent call last):
        FloatingPointError: NaN or infinity in loss_actor: the training has diverged; ...
    """
    wrong = [str(name) for name, value in tensors.items() if not torch.isfinite(value).all()]
    if wrong:
        more = f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        raise FloatingPointError(f"NaN or infinity in {', '.join(wrong[:4])}{more}: {cause}")
