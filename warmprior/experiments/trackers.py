"""How far jobs are, and what they gave: in memory on one machine, in files on many."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from warmprior.experiments.cell_outcome import CellOutcome
from warmprior.experiments.contestant import Contestant
from warmprior.experiments.recipe import EvaluationOptions
from warmprior.experiments.worker import Job, PlayCell, Train
from warmprior.io.files import digest_of, read_json, write_atomic

__all__ = ["FileTracker", "MemoryTracker"]

REPORT_EVERY = 1.0
"""Seconds between two reports of a job: each writes a file, perhaps over a network."""

LOCK_POLL, LOCK_PATIENCE = 1.0, 60.0
"""Seconds between two looks at a folder in use, and in which that of a dead process becomes free."""


class MemoryTracker:
    """Gradient steps of trainings, in memory that a process shares with those it forks or spawns.

    Args:
        num_policies: how many policies jobs name by number.
    """

    def __init__(self, num_policies: int) -> None:
        # Without a lock, which a killed worker might hold for ever: each entry has a single writer.
        self._iterations = multiprocessing.RawArray("q", num_policies)

    def report(self, job: Job, count: int) -> None:
        """A training has come to ``count`` gradient steps."""
        if isinstance(job, Train):
            self._iterations[job.number] = count

    def count(self, job: Job) -> int:
        """Gradient steps of a training; other jobs are too short to be asked."""
        return self._iterations[job.number] if isinstance(job, Train) else 0

    def result(self, job: Job, compute: Callable[[], Any]) -> Any:
        """What a job gives."""
        return compute()


class FileTracker:
    """Files of a folder that all machines share, named by all that determines what a job gives.

    What was measured or played is found again there, by whoever continues a run whose driver was killed
    or repeats a job whose process died; trained policies lie in folders of their own.

    Args:
        folder: where.
        contestants: the policies that jobs name by number.
        options: how they are played.
    """

    def __init__(
        self, folder: Path, contestants: Sequence[Contestant], options: EvaluationOptions
    ) -> None:
        self._folder, self._options = folder.absolute(), asdict(options)
        self._policies = [chosen.folder.name for chosen in contestants]
        self._reported = 0.0

    def report(self, job: Job, count: int) -> None:
        """A job has come to ``count`` gradient steps, or episodes; told once a second at most."""
        if time.monotonic() - self._reported >= REPORT_EVERY:
            self._reported = time.monotonic()
            path = self._path(job, "count")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(str(count))

    def count(self, job: Job) -> int:
        """What was last reported of a job."""
        try:
            return int(self._path(job, "count").read_text())
        except (OSError, ValueError):  # there is none yet, or it is being written
            return 0

    def result(self, job: Job, compute: Callable[[], Any]) -> Any:
        """What a job gives; computed if there is no file of it.

        Raises:
            ValueError: if there is, and it is damaged.
        """
        if isinstance(job, Train):
            return _once_free(compute)
        path = self._path(job, "json")
        if not path.exists():
            given = compute()
            text = json.dumps(asdict(given) if isinstance(given, CellOutcome) else given)
            write_atomic(path, lambda temporary: temporary.write_text(text))
        stored = read_json(path)
        if isinstance(job, PlayCell):
            return CellOutcome(**stored)
        return {int(nfe): measured for nfe, measured in stored.items()}

    def remove(self) -> None:
        """Remove all files: what they tell is stored elsewhere."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, job: Job, kind: str) -> Path:
        cell = asdict(job.cell) if isinstance(job, PlayCell) else type(job).__name__
        digest = digest_of(self._policies[job.number], self._options, cell)
        return self._folder / f"{digest}.{kind}"


def _once_free(train: Callable[[], Any]) -> Any:
    """Train once nobody else does: what a killed driver started may go on for a moment."""
    end = time.monotonic() + LOCK_PATIENCE
    while True:
        try:
            return train()
        except BlockingIOError:
            if time.monotonic() > end:
                raise
            time.sleep(LOCK_POLL)
