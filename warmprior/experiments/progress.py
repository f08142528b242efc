"""How far a comparison is: two bars, and a line for whatever is finished."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Self

from tqdm import tqdm

__all__ = ["ComparisonProgress"]


class ComparisonProgress:
    """Bars of all gradient steps and all episodes, on a terminal; lines above them, or in a pipe alone.

    Args:
        iterations: gradient steps of all trainings.
        episodes: to play.
    """

    def __init__(self, iterations: int, episodes: int) -> None:
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

    def trained(self, iterations: int) -> None:
        """Move the bar of the trainings to as many gradient steps."""
        self._training.update(iterations - self._training.n)

    def played(self) -> None:
        """Count an episode."""
        self._playing.update()

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
