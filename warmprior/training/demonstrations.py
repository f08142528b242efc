"""Which demonstrations policies are trained on, and which ones they never saw."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from warmprior.data.scripted import generate_demonstrations

__all__ = ["Demonstrations"]

HELD_OUT_SEED = 50
"""Of the generated files that no training uses; training files have seed 0."""


@dataclass(frozen=True)
class Demonstrations:
    """Where the data come from.

    Attributes:
        path: a robomimic HDF5 file.
        source: ``"scripted"``, ``"official"`` or ``"file"``.
        style: ``"ph"`` or ``"mh"``; decides the time limit.
    """

    path: Path
    source: str
    style: str

    @cached_property
    def sha256(self) -> str:
        """Digest of the file: the identity of the data in everything that is cached."""
        with open(self.path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    @classmethod
    def held_out(cls, task: str, style: str, n: int) -> Demonstrations:
        """Generate (or find in the cache) scripted demonstrations that share no episode with training.

        Args:
            task: see :func:`~warmprior.data.generate_demonstrations`.
            style: likewise.
            n: number of demonstrations.
        """
        return cls(generate_demonstrations(task, style, n, HELD_OUT_SEED), "scripted", style)
