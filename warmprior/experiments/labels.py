"""What tables and figures call each source, and how they show it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from warmprior.experiments.results import Row
from warmprior.modules.prior import Prior

__all__ = ["prior_color", "prior_label", "source_labels", "with_actions"]


def with_actions(told: str, actions: str | None) -> str:
    """Add the space of the actions to what is told of a problem, where it is not the recorded one.

    Args:
        told: of the problem.
        actions: as facts of a problem and its rows have them.

    Examples:
        >>> with_actions("square ph", None), with_actions("square ph", "absolute")
        ('square ph', 'square ph, absolute actions')
    """
    return told if actions is None else f"{told}, {actions} actions"


def prior_label(name: str) -> str:
    """What tables and figures call a prior: its own label, or the name where it is not imported.

    Examples:
        >>> prior_label("past"), prior_label("not imported")
        ('WP-Past', 'not imported')
    """
    prior = Prior.registered().get(name)
    return name if prior is None else prior.label


def prior_color(name: str) -> str | None:
    """The colour of a prior in figures; ``None`` (matplotlib's next) where it is not imported."""
    prior = Prior.registered().get(name)
    return None if prior is None else prior.color


def source_labels(rows: Iterable[Row]) -> Callable[[Row], str]:
    """A function that names the source of a row: its options, and sigma and H where these tell rows apart.

    Args:
        rows: all that are shown together.

    Examples:
        >>> rows = [Row({"prior": "past", "sigma": s, "chunk": 8}, {}) for s in (0.5, 1.0)]
        >>> [source_labels(rows)(row) for row in rows], source_labels(rows[:1])(rows[0])
        (['WP-Past, sigma 0.5', 'WP-Past, sigma 1'], 'WP-Past')
    """
    rows = list(rows)
    sigmas: dict[str, set[float]] = {}
    for row in rows:
        sigmas.setdefault(row["prior"], set()).add(row["sigma"])
    several_chunks = len({row["chunk"] for row in rows}) > 1

    def label(row: Row) -> str:
        text = ", ".join(filter(None, (prior_label(row["prior"]), row.get("options"))))
        if len(sigmas[row["prior"]]) > 1:
            text += f", sigma {row['sigma']:g}"
        return f"{text}, H {row['chunk']}" if several_chunks else text

    return label
