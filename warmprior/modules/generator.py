"""Generators of modules, which stay in the process that they were made in."""

from __future__ import annotations

from multiprocessing.context import get_spawning_popen
from typing import Any

import torch


class LeftBehind:
    """Stands for a generator in a worker process, where all workers would draw the same noise."""


class Drawing:
    """A mixin of modules that draw from a generator of their own, PyTorch's global one without.

    It cannot draw in a worker process if it has one. An error while it is sent there would come when
    TorchRL's collectors have moved the weights away, and they would be lost.
    """

    generator: Any = None

    def __getstate__(self) -> Any:
        state: Any = super().__getstate__()
        if self.generator is not None and get_spawning_popen() is not None:
            state = {**state, "generator": LeftBehind()}
        return state

    def chosen_generator(self, generator: torch.Generator | None = None) -> torch.Generator | None:
        """Return a call's generator, or the module's; raise RuntimeError if that one stayed elsewhere."""
        generator = self.generator if generator is None else generator
        if isinstance(generator, LeftBehind):
            raise RuntimeError(
                "a policy with a generator cannot draw in worker processes: all of them would draw the same "
                "noise. Build it without one (generator=None), and seed the collector with set_seed"
            )
        return generator
