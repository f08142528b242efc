"""Comparisons of policies that take time: sources with and without Real-Time Chunking, at several delays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from warmprior.experiments.condition import Condition
from warmprior.experiments.labels import source_labels
from warmprior.experiments.methods import Method
from warmprior.experiments.problem import Problem, find_problems, navigation_problem
from warmprior.experiments.recipe import Recipe, check_counts
from warmprior.experiments.results import Row
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.transforms.delay import check_delay

__all__ = ["DelayedRecipe", "guided_labels"]

TOY = "navigation"
"""What the toy is called among the tasks."""


@dataclass(frozen=True)
class DelayedRecipe(Recipe):
    """A comparison under injected latency.

    Attributes:
        delay: control steps until chunks take effect, an evaluation each.
        execute: actions executed per decision, the same at all delays (default: as many as the largest
            delay leaves of H).
        guidance: without any, and by Real-Time Chunking.
        toy: the navigation toy: beside the tasks, alone, or not at all.
        rtc: of the guidance.

    See Also:
        - :class:`~warmprior.experiments.Condition`: one of its delays.
        - :class:`~warmprior.RealTimeChunking`: the guidance.

    Examples:
        >>> from warmprior.experiments import SourceOptions
        >>> recipe = DelayedRecipe(delay=(0, 4), toy="alone", sources=SourceOptions(("past",)))
        >>> (method,) = recipe.sources.methods()
        >>> [(c.delay, c.execute, c.guidance is not None) for c in recipe.conditions(method)]
        [(0, 4, False), (0, 4, True), (4, 4, False), (4, 4, True)]
        >>> DelayedRecipe(delay=(), toy="alone").check()
        Traceback (most recent call last):
            ...
        ValueError: --delay needs at least one value
    """

    delay: tuple[int, ...] = (0, 2, 4)
    execute: int | None = None
    guidance: tuple[Literal["none", "rtc"], ...] = ("none", "rtc")
    toy: Literal["beside", "alone", "no"] = "beside"
    rtc: RealTimeChunking = field(default_factory=RealTimeChunking)

    @property
    def name(self) -> str:
        """Of the output folder."""
        if self.toy == "alone":
            return TOY
        return super().name + (f"-{TOY}" if self.toy == "beside" else "")

    def check(self) -> None:
        """Refuse what cannot work, before any work."""
        super().check()
        self.check_single(chunk=True)
        check_counts(self, "delay", least=0)
        for name in ("delay", "guidance"):
            if not getattr(self, name):
                raise ValueError(f"--{name} needs at least one value")
        if self.toy != "no" and self.evaluation.play_on:
            raise ValueError("the toy has an end of its own: leave out --play-on, or add --toy no")
        (chunk,) = self.sources.chunk
        check_counts(self, "execute", most=chunk)
        for method in self.sources.methods():
            if not self.conditions(method):
                raise ValueError(
                    f"{method.name} is no flow to guide: add --guidance none, or leave it out"
                )
            for condition in self.conditions(method):
                delay, execute = condition.delay or 0, condition.execute or 0
                try:
                    check_delay(delay, execute, method.prediction_length)
                    if condition.guidance is not None:
                        condition.guidance.check_delay(delay, method.prediction_length - execute)
                except ValueError as error:
                    raise ValueError(
                        f"--delay {delay} with --execute {execute} and {method.name}, which predicts "
                        f"{method.prediction_length}: {error}"
                    ) from error

    def conditions(self, method: Method) -> list[Condition]:
        """Every delay, without and with guidance, where there is a flow to guide.

        Args:
            method: of the policy.

        Examples:
            >>> from warmprior.experiments import Method
            >>> recipe = DelayedRecipe(delay=(0, 2), guidance=("none",))
            >>> [(c.delay, c.execute) for c in recipe.conditions(Method("gaussian", 8))]
            [(0, 6), (2, 6)]
        """
        execute = self.execute
        if execute is None:
            execute = max(1, self.sources.chunk[0] - max(self.delay))
        guidances = {"none": None, "rtc": self.rtc}
        return [
            Condition(delay, execute, guidances[name])
            for delay in sorted(set(self.delay))
            for name in dict.fromkeys(self.guidance)
            if name == "none" or method.is_flow
        ]

    def problems(self) -> list[Problem]:
        """The tasks' demonstrations, and the toy's.

        Raises:
            ValueError: if a file is of another task than the one that is named.
        """
        found = []
        if self.toy != "alone":
            found = find_problems(self.data, self.network.observation_steps)
        return found + ([] if self.toy == "no" else [navigation_problem()])


def guided_labels(rows: Sequence[Row]) -> Callable[[Row], str]:
    """A function that names the source and guidance of a row, as the paper's comparison does.

    Args:
        rows: all that are shown together.

    See Also:
        - :func:`~warmprior.experiments.source_labels`: without guidance.
        - :func:`~warmprior.experiments.plot_delays`: uses it.

    Examples:
        >>> facts = {"sigma": 1.0, "chunk": 8}
        >>> rows = [Row({"prior": p, "guidance": g, **facts}, {})
        ...         for p in ("gaussian", "preview") for g in ("none", "rtc")]
        >>> list(map(guided_labels(rows), rows))
        ['Base', 'RTC', 'WP-Preview', 'RTC + WP-Preview']
    """
    source = source_labels(rows)

    def label(row: Row) -> str:
        if row["guidance"] == "none":
            return source(row)
        return "RTC" if row["prior"] == "gaussian" else f"RTC + {source(row)}"

    return label
