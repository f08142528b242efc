"""Draw the flowchart of the page on sources, and the timeline of the page on concepts.

python docs/figures/diagrams.py    # or: make results; writes docs/_static
"""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from shared import CVAE, DOCS, INK, SOURCES, SVG

OUT = DOCS / "_static"
GREY, BLUE, ORANGE, LEARNED, LIGHT = "#7f7f7f", "#1f77b4", "#d95f02", SOURCES[CVAE][1], "#eeeeee"
QUESTIONS = (
    ("Can the same observation call for\ndifferent actions (several routes)?", "PastPrior(8), nfe=3", BLUE),
    ("Do you set joints=, or are actions\nabsolute poses of an arm?", "GaussianPrior(8), nfe=3", GREY),
    ("Human demonstrations, without\ncameras?", "CVAEPrior(8), nfe=9", LEARNED),
    ("At most 25 scripted demos, and\nonly time for NFE 1?", "PastPrior(8), nfe=1", BLUE),
)


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """Return an empty picture in units of a tenth of an inch, without axes."""
    picture = Figure(figsize=(width, height))
    axis = picture.add_axes((0, 0, 1, 1), xlim=(0, 10 * width), ylim=(0, 10 * height))
    axis.axis("off")
    return picture, axis


def box(
    axis: Axes, place: tuple[float, float], size: tuple[float, float], text: str, **style: object
) -> None:
    """Draw a rectangle with its text, centred at a place."""
    (x, y), (width, height) = place, size
    colors = {"fc": style.get("fc", "white"), "ec": style.get("ec", INK)}
    axis.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, lw=1.2, **colors))
    axis.text(x, y, text, ha="center", va="center", fontsize=10.5, color=style.get("color", "black"))


def flowchart() -> None:
    """Draw chart H: the choice of a source."""
    picture, axis = canvas(6.4, 4.62)
    left, right, step, top = 17.0, 51.0, 9.2, 41.6
    for k, (question, answer, color) in enumerate(QUESTIONS):
        y = top - step * k
        box(axis, (left, y), (30, 6.4), question, fc=LIGHT)
        box(axis, (right, y), (23, 6.4), answer, fc=color, ec=color, color="white")
        arrow = {"arrowstyle": "-|>", "color": INK}
        axis.annotate("", (right - 11.5, y), (left + 15, y), arrowprops=arrow)
        axis.annotate("", (left, y - step + 3.2), (left, y - 3.2), arrowprops=arrow)
        axis.text(left + 16, y + 0.6, "yes", fontsize=10)
        axis.text(left + 0.8, y - step / 2 - 0.8, "no", fontsize=10)
    box(
        axis,
        (left, top - step * len(QUESTIONS)),
        (30, 6.4),
        "PastPrior(8, correlation=0.5),\nnfe=3",
        fc=BLUE,
        ec=BLUE,
        color="white",
    )
    picture.savefig(OUT / "which_source.svg", **SVG)


def timeline() -> None:
    """Draw chart I: the source of chunk B for each prior."""
    picture, axis = canvas(6.0, 3.9)
    start, unit = 14.2, 1.84  # position of step 0, and width of a step

    def bar(row: float, first: int, last: int, text: str, **style: object) -> None:
        width = unit * (last - first)
        box(axis, (start + unit * first + width / 2, row), (width - 0.4, 4.4), text, **style)

    rows = {"executed": 31.0, "Gaussian source": 23.0, "WP-Past": 15.0, "WP-Preview": 7.0}
    for name, row in rows.items():
        axis.text(0.5, row, name, va="center", fontsize=10.5)
    for step in range(0, 25, 8):
        axis.text(start + unit * step, 36.4, str(step), ha="center", fontsize=10, color=INK)
        axis.plot([start + unit * step] * 2, [3.5, 35.6], color=INK, alpha=0.3, zorder=0)
    axis.text(0.8, 36.4, "control step", fontsize=10, color=INK)
    axis.plot([start + unit * 8] * 2, [3.5, 35.6], color=INK, ls="--")
    axis.text(start + unit * 8, 1.0, "decision", ha="center", fontsize=10)
    bar(31, 0, 8, "chunk A", fc=LIGHT)
    bar(31, 8, 16, "chunk B,\nto decide", fc="white")
    bar(23, 8, 16, "mean 0,\nwidth 1", fc=GREY, ec=GREY, color="white")
    bar(15, 0, 8, "remembered", fc=LIGHT)
    bar(15, 8, 16, "mean: chunk A,\nwidth 0.5", fc=BLUE, ec=BLUE, color="white")
    bar(7, 0, 8, "forecast\nwith A", fc=LIGHT)
    bar(7, 8, 16, "mean: forecast,\nwidth 1", fc=ORANGE, ec=ORANGE, color="white")
    bar(7, 16, 24, "cold: mean 0,\nwidth 1", fc=GREY, ec=GREY, color="white")
    picture.savefig(OUT / "timeline.svg", **SVG)


if __name__ == "__main__":
    flowchart()
    timeline()
