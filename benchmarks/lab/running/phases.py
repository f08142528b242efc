"""The phases of a run in wall-clock time."""

from __future__ import annotations

import time

import psutil


class Phases:
    """The phases of a run in wall-clock time, from the start of the process.

    Examples:
        >>> from lab.running.phases import Phases
        >>> phases = Phases()
        >>> phases.end("imports")
        >>> str(phases)
        '... imports'
    """

    def __init__(self) -> None:
        self._began = psutil.Process().create_time()
        self._seconds: dict[str, float] = {}

    def end(self, name: str) -> None:
        """End a phase, which began when the one before ended."""
        now = time.time()
        self._seconds[name], self._began = now - self._began, now

    def __str__(self) -> str:
        return ", ".join(f"{s // 60:.0f}:{s % 60:02.0f} {name}" for name, s in self._seconds.items())
