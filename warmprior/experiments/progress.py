"""How far a comparison is: two bars, and a line for whatever is finished."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Self

from tqdm import tqdm

from warmprior.experiments.worker import Job, Measure, Train

__all__ = ["ComparisonProgress"]


class ComparisonProgress:
    """Bars of all gradient steps and all episodes, on a terminal; lines above them, or in a pipe alone.

    Args:
        iterations: gradient steps of all trainings.
        episodes: to play.
    """

    def __init__(self, iterations: int, episodes: int) -> None:
        self._counts: dict[Job, int] = {}
        # Without a terminal, None shows no bar: two of them would fill a log with control characters.
        self._training, self._playing = (
            tqdm(
                total=total,
                desc=description,
                unit=unit,
                position=position,
                leave=False,
                dynamic_ncols=True,
                disable=None,
            )
            for position, (total, description, unit) in enumerate(
                [(iterations, "train", "it"), (episodes, "play", "ep")]
            )
        )

    def say(self, line: str) -> None:
        """Print a line that stays."""
        tqdm.write(line)
        sys.stdout.flush()  # a pipe is to show it at once

    def moved(self, job: Job, count: int) -> None:
        """A job has come to ``count`` gradient steps, or episodes; one that starts anew moves back."""
        if not isinstance(job, Measure):
            bar = self._training if isinstance(job, Train) else self._playing
            bar.update(count - self._counts.get(job, 0))
            self._counts[job] = count

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for bar in (self._playing, self._training):
            bar.close()
