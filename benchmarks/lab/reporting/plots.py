"""The figures of the benchmarks: bars, lines, violins and paths, from the same rows as the tables.

`running/pictures.py` says which a comparison gets; scripts draw others themselves.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from pandas import DataFrame
from torch import Tensor

from lab.methods.methods import color
from warmprior.diagnostics import success_posterior
from warmprior.envs.navigation1d import (
    HALF_HEIGHT,
    HALF_WIDTH,
    OBSTACLES,
    navigation_heights,
    navigation_positions,
)

ABOVE, BELOW, INK = "#6e6e6e", "#bdbdbd", "#101010"  # sides of the toy's obstacles, and a highlighted path
PALEST = 0.6  # share of white (or black, for bright colours) in a method's last shade
RATES = ("success", "success_rate")


# Parts of all figures


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, share: bool = False
) -> tuple[Figure, list[Any]]:
    """Return a figure and its axes, row by row; it needs no display and leaves no pyplot state."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    return figure, list(axes.flat)


def save(figure: Figure, path: str | Path, title: str, size: int = 10) -> None:
    """Write a figure with its title, and one legend of all axes below it, which enlarges the picture."""
    handles = {
        label: handle
        for axis in figure.axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    if handles:
        entry = 0.6 + 0.07 * max(map(len, handles))  # inches
        columns = max(1, int(figure.get_figwidth() / entry))
        below: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0), "frameon": False}
        figure.legend(handles.values(), handles.keys(), ncols=columns, fontsize=9, **below)
    figure.suptitle(title, fontsize=size)
    figure.savefig(path, dpi=150, bbox_inches="tight")


def dress(axis: Any, title: str = "", x: str = "", y: str = "", rate: bool = False) -> None:
    """Set title, labels and grid of an axis, and the limits of a rate, which is shown in percent."""
    axis.set_title(title, fontsize=10)
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.grid(axis="y", alpha=0.25)
    if rate:
        axis.set_ylim(-0.02, 1.08)
        axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f}%")


def colors_of(rows: DataFrame) -> dict[Hashable, Any]:
    """Return the colour of each method: its prior's, in paler shades for methods with options."""
    colors: dict[Hashable, Any] = {}
    taken: list[str] = []
    for prior, group in rows.groupby("prior", sort=False):
        taken.append(color(prior, taken))
        base, methods = to_rgb(taken[-1]), sorted(group["method"].unique(), key=lambda name: "," in name)
        end = float(sum(base) < 2)
        for place, method in enumerate(methods):
            share = PALEST * place / max(1, len(methods) - 1)
            colors[method] = tuple((1 - share) * part + share * end for part in base)
    return colors


def side_by_side(
    axis: Any, rows: DataFrame, group: str, colors: Mapping[Hashable, Any]
) -> Iterator[tuple[float, DataFrame, dict[str, Any]]]:
    """Yield position, rows and style of every method, side by side in each group.

    Only the first style of a method has a label, so that the legend names it once.
    """
    methods, groups = list(colors), list(rows[group].unique())
    step, named = len(methods) + 0.8, set()
    for g, (_, members) in enumerate(rows.groupby(group, sort=False)):
        for method, rows_of_method in members.groupby("method", sort=False):
            name = None if method in named else method
            yield g * step + methods.index(method), rows_of_method, {"color": colors[method], "label": name}
            named.add(method)
    axis.set_xticks([g * step + (len(methods) - 1) / 2 for g in range(len(groups))], groups)


# Comparisons of methods: rows have the column `method`


def plot_success(rows: DataFrame, path: str | Path, title: str, group: str = "nfe") -> None:
    """Draw posteriors of the success rate as violins (appendix A); rows of a method and group are pooled.

    The width at height p is the density Beta(k + 1, n - k + 1), and the tick is its mean. k/n is below.
    Pooled episodes spread less than trainings do, so a dot shows each training.
    """
    names = rows[group].map(lambda value: value if isinstance(value, str) else f"{group.upper()} {value}")
    rows = rows.assign(group=names)
    width = 2.2 + 0.55 * (rows["method"].nunique() + 1) * rows[group].nunique()
    figure, (axis,) = new_figure(width, 4.2)
    grid = np.linspace(0.0, 1.0, 801)
    for x, violin, look in side_by_side(axis, rows, "group", colors_of(rows)):
        k, n = float(violin["successes"].sum()), int(violin["episodes"].sum())
        posterior = success_posterior(k, n)
        density = posterior.pdf(grid)
        half = 0.42 * density / density.max()
        axis.fill_betweenx(grid, x - half, x + half, alpha=0.75, lw=0, **look)
        axis.plot([x - 0.3, x + 0.3], [posterior.mean()] * 2, color="black", lw=1.2)
        if len(violin) > 1:
            axis.plot([x] * len(violin), violin["success_rate"], ".", color="black", ms=5)
        axis.text(x, -0.025, f"{k:.4g}/{n}", ha="center", va="top", fontsize=7, color="0.35")
    dots = "; dots: trainings" if rows.groupby(["method", "group"]).size().max() > 1 else ""
    dress(axis, y=f"success rate (posterior density{dots})", rate=True)
    axis.set_ylim(-0.08, 1.0)
    save(figure, path, title)


def plot_bars(
    rows: DataFrame,
    path: str | Path,
    title: str,
    group: str,
    measures: Mapping[str, str],
    column: str = "setting",
) -> None:
    """Draw means over seeds as bars with their deviation: a line of panels per measure, a panel per `column`.

    Methods are side by side in groups. `measures` maps columns of the rows to labels of axes.
    """
    panels, colors = rows[column].unique(), colors_of(rows)
    width = 1.0 + rows[group].nunique() * (0.6 + 0.33 * rows["method"].nunique())
    figure, axes = new_figure(width * len(panels), 0.4 + 2.8 * len(measures), len(measures), len(panels))
    places = [(name, panel) for name in measures for panel in panels]
    for axis, (name, panel) in zip(axes, places, strict=True):
        rate = name in RATES
        panel_rows = rows[(rows[column] == panel) & rows[name].notna()]
        for x, bar, look in side_by_side(axis, panel_rows, group, colors):
            mean, std = bar[name].mean(), bar[name].std()
            shown = f"{100 * mean:.0f}" if rate else f"{mean:.2f}"
            axis.bar(x, mean, 0.85, yerr=None if math.isnan(std) else std, capsize=3, **look)
            above = mean + (0.0 if math.isnan(std) else std)  # the error bar
            axis.annotate(shown, (x, above), (0, 4), textcoords="offset points", ha="center", fontsize=8)
        first = panel == panels[0]
        dress(axis, panel, y=measures[name] if first else "", rate=rate)
        if not rate:
            axis.margins(y=0.1)  # for the numbers above the bars
            axis.set_ylim(bottom=0)
    save(figure, path, title)


def plot_lines(
    rows: DataFrame,
    path: str | Path,
    title: str,
    x: str,
    measures: Mapping[Any, str],
    column: str = "nfe",
    scale: str = "even",
) -> None:
    """Draw means over seeds against `x`, with shaded deviations, in a panel per measure and `column`.

    The second of a pair of measures is dotted. On the scale `even` the values of `x` have equal distances, in
    the order of the rows; other scales are `log` and `linear`.
    """
    panels, values, colors = rows[column].unique(), list(rows[x].unique()), colors_of(rows)
    figure, axes = new_figure(3.6 * len(panels), 0.4 + 2.8 * len(measures), len(measures), len(panels))
    places = [(names, panel) for names in measures for panel in panels]
    for axis, (names, panel) in zip(axes, places, strict=True):
        pair = (names,) if isinstance(names, str) else names
        for method, group in rows[rows[column] == panel].groupby("method", sort=False):
            for name, style in zip(pair, ("-", ":"), strict=False):
                points = group.dropna(subset=[name]).astype({name: float}).groupby(x, sort=False)[name]
                mean, std = points.mean(), points.std().fillna(0.0)
                at = [values.index(value) if scale == "even" else value for value in mean.index]
                look = {"color": colors[method], "ls": style, "label": method if style == "-" else None}
                axis.plot(at, mean, marker="o", ms=3, lw=1.3, **look)
                axis.fill_between(at, mean - std, mean + std, color=colors[method], alpha=0.2, lw=0)
        first, rate = panel == panels[0], pair[0] in RATES
        words = panel if isinstance(panel, str) else f"{column.upper()} {panel}"
        dress(axis, words, x.replace("_", " "), measures[names] if first else "", rate)
        if not rate:
            axis.set_ylim(bottom=0)
        if scale == "log":
            axis.set_xscale("log")
            axis.minorticks_off()
        if scale != "linear":
            ticks = values if scale == "log" else range(len(values))
            axis.set_xticks(ticks, [f"{value:,g}" for value in values], fontsize=8)
    save(figure, path, title)


def plot_learning_curves(
    losses: Mapping[str, Sequence[Sequence[tuple[int, float]]]], rows: DataFrame, path: str | Path, title: str
) -> None:
    """Draw loss against iterations, and success if there are several checkpoints.

    `losses` has (iteration, loss) per method and seed.
    """
    several = rows["checkpoint"].nunique() > 1
    figure, (left, *others) = new_figure(9.0 if several else 5.0, 3.6, columns=1 + several)
    colors = colors_of(rows)
    for method, seeds in losses.items():
        for i, curve in enumerate(seeds):
            name = method if i == 0 else None
            look = {"color": colors[method], "lw": 1.0, "marker": "." if len(curve) == 1 else ""}
            left.plot(*zip(*curve, strict=True), label=name, **look)
    left.set_yscale("log")
    dress(left, x="iteration", y="flow-matching loss (own source)")
    for right in others:
        left.sharex(right)
        for method, group in rows.groupby("method", sort=False):
            rates = group.groupby("checkpoint")["success_rate"]
            look = {"marker": "o", "ms": 4, "lw": 1.0, "capsize": 2, "color": colors[method]}
            right.errorbar(rates.mean().index, rates.mean(), yerr=rates.std().fillna(0.0), **look)
        nfes = ", ".join(map(str, rows["nfe"].unique()))  # a method may have its own
        dress(right, x="iteration", y=f"success rate (NFE {nfes})", rate=True)
    save(figure, path, title)


def plot_filmstrip(frames: Sequence[np.ndarray], labels: Sequence[str], path: str | Path, title: str) -> None:
    """Draw an episode as a row of pictures, uint8 [h, w, 3], with a label below each."""
    figure, axes = new_figure(1.5 * len(frames), 2.0, columns=len(frames))
    for axis, frame, label in zip(axes, frames, labels, strict=True):
        axis.imshow(frame)
        axis.set_axis_off()
        axis.text(0.5, -0.04, label, transform=axis.transAxes, ha="center", va="top", fontsize=7)
    save(figure, path, title, 9)


# The navigation toy, and paths of the flow


def sides(axis: Any, x: np.ndarray, lines: np.ndarray, decides: int, **look: Any) -> None:
    """Draw lines in the grey of the side of their point with index `decides`."""
    for line in lines:
        axis.plot(x, line, color=ABOVE if line[decides] > 0 else BELOW, **look)


def plot_navigation(
    panels: Mapping[str, tuple[Tensor, Sequence[str]]],
    path: str | Path,
    chunk_length: int,
    title: str,
) -> None:
    """Draw executed paths between the obstacles, in a panel for the data and one per policy (Fig. 5).

    `panels` has heights [n, 64] and lines of text by title. A path is dark or light by the side of its
    first action; one path is black, with a dot at the first action of each chunk.
    """
    rows = -(-(len(panels) + 1) // 3)
    figure, axes = new_figure(11.0, 0.7 + 3.0 * rows, rows, 3, share=True)
    x, demonstrations = navigation_positions().numpy(), navigation_heights().numpy()
    for axis in axes[len(panels) + 1 :]:
        axis.set_visible(False)
    for i, (axis, name) in enumerate(zip(axes, ["demonstrations", *panels], strict=False)):
        for c in OBSTACLES:
            ends = [c - HALF_WIDTH, c + HALF_WIDTH]
            axis.fill_between(ends, -HALF_HEIGHT, HALF_HEIGHT, color="0.8")
        lines: Sequence[str] = ["three above, three below"]
        if i == 0:
            sides(axis, x, demonstrations, 0, lw=1.4)
        else:
            axis.plot(x, demonstrations.T, color="0.6", lw=0.6, ls=":")
            heights, lines = panels[name]
            drawn = heights[:24].numpy()
            sides(axis, x, drawn, 0, lw=0.8, alpha=0.45)
            axis.plot(x, drawn[0], color=INK, lw=1.6)
            axis.plot(x[::chunk_length], drawn[0, ::chunk_length], "o", color=INK, ms=3.4)
        letter = f"({ascii_lowercase[i]}) " if i < len(ascii_lowercase) else ""
        below = i >= len(panels) + 1 - 3
        dress(
            axis, letter + name, "position (observation)" if below else "", "" if i % 3 else "height (action)"
        )
        place = {"transform": axis.transAxes, "ha": "center", "va": "bottom", "fontsize": 8}
        axis.text(0.5, 0.02, "\n".join(lines), **place)
        axis.set_xlim(-1, 1)
        axis.set_ylim(-1.5, 1.15)
        axis.set_yticks([-1, 0, 1])
    save(figure, path, title)


def plot_flow_paths(paths: Mapping[str, Tensor], path: str | Path, title: str) -> None:
    """Draw an action coordinate along the flow, [n, steps + 1], in a panel per policy (Fig. 4)."""
    figure, axes = new_figure(2.5 * len(paths) + 0.5, 3.4, 1, len(paths), share=True)
    for axis, (name, lines) in zip(axes, paths.items(), strict=True):
        values = lines.numpy()
        sides(axis, np.linspace(0.0, 1.0, values.shape[1]), values, -1, lw=0.7, alpha=0.5)
        for time, end in ((0.0, values[:, 0]), (1.0, values[:, -1])):
            axis.plot(np.full(len(end), time), end, "o", color=INK, ms=1.8, alpha=0.6)
        dress(axis, name, "flow time t")
    axes[0].set_ylabel("first action of the chunk")
    save(figure, path, title)
