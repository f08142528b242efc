"""What all tables and figures share: a canvas without display, and how each source is shown."""

from __future__ import annotations

from typing import Any

from warmprior.io.extras import require
from warmprior.modules.prior import Prior

__all__ = ["new_figure", "prior_color", "prior_label"]


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


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, *, share: bool = False
) -> tuple[Any, list[Any]]:
    """A figure and its axes, row by row.

    Raises:
        ImportError: if matplotlib is missing.
    """
    # The Agg canvas needs no display, and no pyplot state is left behind.
    require("matplotlib", "sim")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    return figure, list(axes.flat)
