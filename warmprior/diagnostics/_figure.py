"""What all figures share: a canvas without display, and the colour of each source."""

from __future__ import annotations

from typing import Any

from warmprior._extras import require

COLORS = {
    "gaussian": "#7f7f7f",
    "past": "#1f77b4",
    "preview": "#d95f02",
    "regression": "#b8860b",
    "history": "#6a51a3",
}


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
