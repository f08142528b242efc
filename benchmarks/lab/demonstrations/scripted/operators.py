"""The operators of demonstrations: a skilled one for ``ph`` data, six with three levels for ``mh``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

#: Skill levels of multi-human data, best first.
LEVELS = ("better", "okay", "worse")


@dataclass(frozen=True)
class Operator:
    """The habits of one person.

    ``speed`` is the largest command as a fraction of the full range, ``noise`` the scale of the added noise.
    ``pause`` and ``clumsy`` are the probabilities of pausing before a waypoint, and of missing a grasp.
    Transfers bulge by ``arc`` metres to the left, rise ``high`` metres above the necessary height, or go
    ``axiswise``. ``side`` is the preferred side; ``choice`` 0 takes the cheapest of several ways, 1 the
    second.
    """

    level: str = "better"
    speed: float = 0.95
    noise: float = 0.05
    pause: float = 0.05
    arc: float = 0.0
    side: int = 1
    high: float = 0.0
    choice: int = 0
    axiswise: bool = False
    clumsy: float = 0.0


SKILLED = Operator(pause=0.03, high=0.02)
OPERATORS = (
    Operator(),
    Operator(speed=0.85, arc=0.07, side=-1, high=0.06, choice=1),
    Operator("okay", 0.65, 0.08, 0.20, -0.07, 1, 0.03, 0, True, 0.1),
    Operator("okay", 0.60, 0.08, 0.20, 0.05, -1, 0.10, 1, False, 0.1),
    Operator("worse", 0.45, 0.12, 0.45, -0.10, -1, 0.12, 1, True, 0.35),
    Operator("worse", 0.40, 0.12, 0.45, 0.10, 1, 0.05, 0, True, 0.35),
)


class Demonstrator:
    """An operator in one episode: the habits with small variations, and the episode's random numbers."""

    def __init__(self, operator: Operator, rng: np.random.Generator) -> None:
        self.rng = rng
        self.level, self.pause, self.clumsy = operator.level, operator.pause, operator.clumsy
        self.side, self.choice, self.axiswise = operator.side, operator.choice, operator.axiswise
        self.speed = operator.speed * rng.uniform(0.85, 1.1)
        self.noise = operator.noise * rng.uniform(0.7, 1.3)
        self.arc = operator.arc + rng.normal(0, 0.012)
        self.high = operator.high + rng.uniform(-0.01, 0.02)
        self.gain = rng.uniform(0.8, 1.1)
        self.smoothing = rng.uniform(0.45, 0.7)

    def draw(self, low: float, high: float) -> float:
        """Draw uniformly from an interval."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self.rng.random() < probability)

    def pick[T](self, options: Sequence[T], cost: Callable[[T], float]) -> T:
        """Choose by habit: the cheapest option, or the second cheapest."""
        ranked = sorted(options, key=cost)
        return ranked[min(self.choice, len(ranked) - 1)]
