"""What a module would hold, found out without taking memory or time for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import prod
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["BlueprintError", "blueprint"]

# What building takes beside the tensors themselves: initialisation, masks, copies of layers. Ours take
# up to 4 operations per tensor and 4 times their elements.
_SHARE, _LEAST_OPERATIONS, _LEAST_ELEMENTS = 64, 4096, 2**24


class BlueprintError(ValueError):
    """A module would be far larger than what is there to fill it."""


class _Bounded(TorchDispatchMode):
    """Ends a construction that makes more, or larger, tensors than it may."""

    def __init__(self, operations: int, elements: int) -> None:
        super().__init__()
        self.operations, self.elements = operations, elements

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        if func is torch.ops.aten._local_scalar_dense.default:
            return True  # whether values are good cannot be asked where there are none
        if args and isinstance(args[0], list) and all(isinstance(n, int) for n in args[0]):
            self._spend(prod(args[0]))  # a size; before it is taken, in case it is no meta tensor
        out = func(*args, **(kwargs or {}))
        self._spend(out.numel() if isinstance(out, Tensor) else 0)
        return out

    def _spend(self, elements: int) -> None:
        self.operations -= 1
        self.elements -= elements
        if min(self.operations, self.elements) < 0:
            raise BlueprintError("it would be many times as large as what is there to fill it")


def blueprint(
    build: Callable[[], nn.Module], filling: Mapping[str, tuple[int, ...]]
) -> dict[str, Tensor]:
    """Build a module without values.

    Args:
        build: makes the module.
        filling: the shapes of the tensors that are there to fill it, by name.

    Returns:
        Its state dict on the meta device.

    Raises:
        BlueprintError: if the module would be many times as large as ``filling``.
        Exception: whatever ``build`` raises.

    Examples:
        >>> blueprint(lambda: nn.Linear(2, 3), {"weight": (3, 2), "bias": (3,)})["weight"].shape
        torch.Size([3, 2])
        >>> blueprint(lambda: nn.Linear(20_000, 20_000), {"weight": (3, 2)})
        Traceback (most recent call last):
            ...
        warmprior.modules.blueprint.BlueprintError: it would be many times as large as what is there ...
    """
    elements = sum(map(prod, filling.values()))
    limits = _Bounded(
        2 * _SHARE * len(filling) + _LEAST_OPERATIONS, _SHARE * elements + _LEAST_ELEMENTS
    )
    with torch.device("meta"), limits:
        return build().state_dict()
