"""Networks wrapped by :func:`torch.compile`, with the names and configuration of the network inside."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

__all__ = ["uncompiled", "without_compilation"]

_PREFIX = "_orig_mod."


def uncompiled(module: nn.Module) -> nn.Module:
    """The module inside a compiled one; any other is returned as it is."""
    return getattr(module, _PREFIX[:-1], module)


def without_compilation(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A state dict under the names of the uncompiled network."""
    return {name.replace(_PREFIX, ""): value for name, value in tensors.items()}
