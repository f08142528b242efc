"""Sources beside each other, training by training, as tables and sentences say it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lab.measures.statistics import ENOUGH_TRAININGS, interval, sign_flip_test, spread_of


def estimate(cells: Iterable[np.ndarray], alike: Iterable[np.ndarray] = ()) -> tuple[float, float, float]:
    """Return the mean over cells, each ``[trainings, episodes]``, and its interval's ends, in percent.

    Trainings of a cell played the same starts, so the interval counts both. The cells that are `alike`, of a
    chart for example, tell together how much trainings differ; by default these cells alone do.
    """
    cells = list(cells)
    ends = interval(cells, spread_of(list(alike) or cells, shared_starts=True))
    return tuple(100 * np.array([np.mean([cell.mean() for cell in cells]), *ends]))


@dataclass(frozen=True)
class Comparison:
    """A source beside another, training by training.

    Attributes:
        rates: the mean success of both in percent.
        gain: their difference in points.
        low: the lower end of its 95% interval.
        high: the upper end.
        ahead: the number of trainings in which the first solves more.
        behind: the number in which it solves fewer.
        trainings: the number of all.
        p: the two-sided p-value by sign flips over trainings.
    """

    rates: tuple[float, float]
    gain: float
    low: float
    high: float
    ahead: int
    behind: int
    trainings: int
    p: float

    def __str__(self) -> str:
        """Return the trainings ahead and behind, with the p-value if there are enough of them."""
        p = self.chance.replace("p = ", "").replace("p < ", "<")
        return f"{self.ahead}:{self.behind}" + (f" ({p})" if self.trainings >= ENOUGH_TRAININGS else "")

    @property
    def chance(self) -> str:
        """The p-value in words, with one significant digit, or two from 0.1 on."""
        if self.p < 0.001:
            return "p < 0.001"
        return f"p = {self.p:.2f}" if self.p >= 0.095 else f"p = {self.p:.1g}"

    @property
    def in_trainings(self) -> str:
        """The trainings ahead and behind in words."""
        behind = self.behind or "none"
        return f"ahead in {self.ahead} of {self.trainings} training runs and behind in {behind}"

    @property
    def points(self) -> str:
        """The gain in points, with its interval."""
        return f"{self.gain:+.1f} [{self.low:.1f}, {self.high:.1f}]"


def compare(first: Iterable[np.ndarray], second: Iterable[np.ndarray]) -> Comparison:
    """Return the comparison of two sources that played the same, in cells ``[trainings, episodes]``."""
    first, second = list(first), list(second)
    differences = [a - b for a, b in zip(first, second, strict=True)]
    by_training = np.concatenate([cell.mean(1) for cell in differences])
    rates = tuple(100 * float(np.mean([cell.mean() for cell in cells])) for cells in (first, second))
    signs = int((by_training > 0).sum()), int((by_training < 0).sum())
    return Comparison(
        rates,
        *estimate(differences),
        *signs,
        len(by_training),
        sign_flip_test(*(cell.mean(1) for cell in differences)),
    )
