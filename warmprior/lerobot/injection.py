"""Gives a policy its source where it would draw standard normal noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

Source = Callable[[torch.Size, torch.dtype, torch.device], Tensor]
"""``(shape [B, T, D], dtype, device) -> a_0``: replaces a draw."""


class SourceInjection(TorchFunctionMode):
    """Replaces the one draw by ``torch.randn`` or ``torch.randn_like`` of a chunk's shape, ``[B, T, D]``.

    A ``RuntimeError`` at the exit if there was not exactly one: the port is for another policy.

    Examples:
        >>> import torch
        >>> from warmprior.lerobot.injection import SourceInjection
        >>> with SourceInjection(4, 2, lambda shape, dtype, device: torch.ones(shape)):
        ...     noise, other = torch.randn(3, 4, 2), torch.randn(3)
        >>> bool((noise == 1).all()), other.shape
        (True, torch.Size([3]))
        >>> with SourceInjection(4, 2, lambda shape, dtype, device: torch.ones(shape)):
        ...     noise = torch.rand(3, 4, 2)
        Traceback (most recent call last):
            ...
        RuntimeError: the policy drew normal noise of shape [B, 4, 2] 0 times, not once: ...
    """

    def __init__(self, length: int, width: int, source: Source) -> None:
        super().__init__()
        self.expected = (length, width)
        self.source = source
        self.draws = 0

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Let all calls pass but the draw."""
        kwargs = kwargs or {}
        if func is torch.randn:
            size = kwargs.get("size", args[0] if args and not isinstance(args[0], int) else args)
            like = torch.empty(0, dtype=kwargs.get("dtype"), device=kwargs.get("device"))
        elif func is torch.randn_like:
            size, like = args[0].shape, args[0]
        else:
            return func(*args, **kwargs)
        if len(size) != 3 or tuple(size[1:]) != self.expected:
            return func(*args, **kwargs)
        self.draws += 1
        dtype, device = kwargs.get("dtype") or like.dtype, kwargs.get("device") or like.device
        return self.source(torch.Size(size), dtype, torch.device(device))

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Check the count, unless an error is under way."""
        super().__exit__(kind, error, trace)
        if kind is None and self.draws != 1:
            length, width = self.expected
            raise RuntimeError(
                f"the policy drew normal noise of shape [B, {length}, {width}] {self.draws} times, not "
                "once: its source cannot be replaced. Use the version of lerobot that this port is for"
            )
