"""What tables and figures call each source, and how they show it."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

from warmprior.experiments.methods import METHODS, PALETTE
from warmprior.experiments.results import Row

__all__ = [
    "prior_color",
    "prior_label",
    "source_colors",
    "source_labels",
    "source_of",
    "space_of",
    "with_space",
]

PALEST = 0.6
"""Share of white (or black, where the prior's own colour is bright) in the last shade of a prior."""


def space_of(facts: Row | Mapping[str, Any]) -> dict[str, str]:
    """The spaces of actions and observations, where they are not the recorded one and the state.

    Args:
        facts: of a problem, or a row.

    Examples:
        >>> space_of({"task": "square"}), space_of({"task": "square", "obs": "image"})
        ({}, {'obs': 'image'})
    """
    found = {name: facts.get(name) for name in ("actions", "obs")}
    return {name: value for name, value in found.items() if value is not None}


def with_space(told: str, facts: Row | Mapping[str, Any]) -> str:
    """Add to what is told of a problem what :func:`space_of` tells, and how images are rendered.

    Args:
        told: of the problem.
        facts: of the problem, or a row, which does not know how images are rendered.

    Examples:
        >>> with_space("square ph", {}), with_space("square ph", {"actions": "absolute"})
        ('square ph', 'square ph, absolute actions')
        >>> with_space("square ph", {"obs": "image", "images": {"fast_rendering": True}})
        'square ph, image observations, rendered fast'
    """
    space = space_of(facts)
    words = {"actions": "actions", "obs": "observations"}
    parts = [told, *(f"{value} {words[name]}" for name, value in space.items())]
    if (facts.get("images") or {}).get("fast_rendering"):
        parts.append("rendered fast")
    return ", ".join(parts)


def source_of(row: Row) -> tuple[str, str]:
    """Name and options of the method of a row.

    Examples:
        >>> [source_of(Row({"prior": "past", **told}, {})) for told in ({"options": "leap=2"}, {})]
        [('past', 'leap=2'), ('past', '')]
    """
    return row["prior"], row.get("options") or ""


def prior_label(name: str, options: str = "") -> str:
    """What tables and figures call a method: its label, or its name where it is a user's own.

    Args:
        name: of the prior.
        options: that are not at their defaults, as :attr:`Method.options` tells them.

    See Also:
        - :func:`~warmprior.experiments.prior_color`: its colour.
        - :func:`~warmprior.experiments.source_labels`: tells the rows of a figure apart.

    Examples:
        >>> prior_label("past"), prior_label("past", "correlation=0.5"), prior_label("Momentum")
        ('WP-Past', 'WP-Past, correlation=0.5', 'Momentum')
    """
    return ", ".join(filter(None, (METHODS[name].label if name in METHODS else name, options)))


def prior_color(name: str) -> str:
    """The colour of a method in figures.

    See Also:
        :func:`~warmprior.experiments.prior_label`: its name.

    Examples:
        >>> prior_color("past")
        '#1f77b4'
    """
    if name in METHODS:
        return METHODS[name].color
    return PALETTE[zlib.crc32(name.encode()) % len(PALETTE)]


def source_colors(
    rows: Iterable[Row], source: Callable[[Row], Hashable] = source_of
) -> Callable[[Row], Any]:
    """A function that gives the colour of a row: its prior's, in shades where several sources share it.

    Args:
        rows: all that are shown together; of a prior the first source keeps the colour as it is.
        source: tells apart what has a colour of its own; prior and options by default.

    Examples:
        >>> rows = [Row({"prior": "past", "options": told}, {}) for told in ("", "correlation=0.5")]
        >>> colors = source_colors(rows)
        >>> colors(rows[0]) == prior_color("past"), colors(rows[1]) == prior_color("past")
        (True, False)
    """
    variants: dict[str, list[Hashable]] = {}
    for row in rows:
        of_prior = variants.setdefault(row["prior"], [])
        if source(row) not in of_prior:
            of_prior.append(source(row))

    def color(row: Row) -> Any:
        own, of_prior = prior_color(row["prior"]), variants[row["prior"]]
        place = of_prior.index(source(row))
        if place == 0:
            return own
        from matplotlib.colors import to_rgb

        rgb = to_rgb(own)
        end, share = float(sum(rgb) < 2), PALEST * place / (len(of_prior) - 1)
        return tuple((1 - share) * part + share * end for part in rgb)

    return color


def source_labels(rows: Iterable[Row], *, chunks: bool = True) -> Callable[[Row], str]:
    """A function that names the source of a row: its options, and sigma and H where these tell rows apart.

    Args:
        rows: all that are shown together.

    Keyword Args:
        chunks: whether H belongs to the name; not where it is told beside it.

    See Also:
        - :func:`~warmprior.experiments.prior_label`: the name of the prior alone.
        - :func:`~warmprior.experiments.guided_labels`: adds the guidance.

    Examples:
        >>> rows = [Row({"prior": "past", "sigma": s, "chunk": 8}, {}) for s in (0.5, 1.0)]
        >>> [source_labels(rows)(row) for row in rows], source_labels(rows[:1])(rows[0])
        (['WP-Past, sigma 0.5', 'WP-Past, sigma 1'], 'WP-Past')
    """
    rows = list(rows)
    sigmas: dict[str, set[float]] = {}
    for row in rows:
        sigmas.setdefault(row["prior"], set()).add(row["sigma"])
    several_chunks = chunks and len({row["chunk"] for row in rows}) > 1

    def label(row: Row) -> str:
        text = prior_label(*source_of(row))
        if len(sigmas[row["prior"]]) > 1:
            text += f", sigma {row['sigma']:g}"
        return f"{text}, H {row['chunk']}" if several_chunks else text

    return label
