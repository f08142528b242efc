"""Generators of modules, which stay in the process that they were made in."""

from __future__ import annotations

import os
from multiprocessing.context import get_spawning_popen
from typing import Any

import torch

_forks = 0  # between the first process and this one


def _count_fork() -> None:
    global _forks
    _forks += 1


os.register_at_fork(after_in_child=_count_fork)


class LeftBehind:
    """Stands for a generator in a worker process, where all workers would draw the same noise."""


class Drawing:
    """A mixin of modules that draw from a generator of their own, PyTorch's global one without.

    It cannot draw in a worker process if it has one. An error while it is sent there would come when
    TorchRL's collectors have moved the weights away, and they would be lost.
    """

    _generator: Any = None
    _set_after = 0  # forks

    @property
    def generator(self) -> Any:
        """The module's own generator, or what stands for it in a process that was forked since."""
        left = self._generator is not None and self._set_after != _forks
        return LeftBehind() if left else self._generator

    @generator.setter
    def generator(self, generator: torch.Generator | LeftBehind | None) -> None:
        self._generator, self._set_after = generator, _forks

    def __getstate__(self) -> Any:
        state: Any = super().__getstate__()
        generator = self.generator
        if generator is not None and get_spawning_popen() is not None:
            generator = LeftBehind()
        return {**state, "_generator": generator}

    def __setstate__(self, state: Any) -> None:
        parent: Any = super()
        parent.__setstate__(state)
        self._set_after = _forks  # those of the process that loads it

    def chosen_generator(self, generator: torch.Generator | None = None) -> torch.Generator | None:
        """Return a call's generator, or the module's; raise RuntimeError if that one stayed elsewhere."""
        generator = self.generator if generator is None else generator
        if isinstance(generator, LeftBehind):
            raise RuntimeError(
                "a policy with a generator cannot draw in worker processes: all of them would draw the same "
                "noise. Build it without one (generator=None), and seed the collector with set_seed"
            )
        return generator
