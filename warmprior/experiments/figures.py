"""Figures of comparisons: success posteriors, learning curves, filmstrips, agents."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warmprior.diagnostics.statistics import SeedSummary, success_posterior, summarize_seeds
from warmprior.experiments.labels import prior_label, source_colors, source_labels, source_of
from warmprior.experiments.results import Row, grouped, success_summary
from warmprior.io.extras import require

__all__ = [
    "plot_filmstrip",
    "plot_learning_curves",
    "plot_reinforcement",
    "plot_success",
    "plot_success_bars",
]


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


def band(axis: Any, x: Sequence[float], points: Sequence[SeedSummary], **line: Any) -> None:
    """A line of means, with one standard deviation over seeds shaded."""
    mean = np.array([point.mean for point in points])
    spread = np.nan_to_num([point.std for point in points])
    drawn = axis.plot(x, mean, **{"marker": "o", "ms": 4, "lw": 1.4} | line)[0]
    axis.fill_between(x, mean - spread, mean + spread, color=drawn.get_color(), alpha=0.2, lw=0)


def legend_below(figure: Any) -> None:
    """One legend of all axes below them, in as many columns as the figure is wide.

    The figure grows by its height, so that the axes keep theirs, and to its width if one column is wider.
    """
    handles = {
        label: handle
        for axis in figure.axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    for columns in range(max(1, len(handles)), 0, -1):
        legend = figure.legend(
            handles.values(),
            handles.keys(),
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=9,
        )
        needed = legend.get_window_extent()
        if columns == 1 or needed.width <= figure.bbox.width:
            break
        legend.remove()
    width, height = figure.get_size_inches()
    figure.set_size_inches(
        max(width, needed.width / figure.dpi), height + needed.height / figure.dpi
    )


def plot_success(
    rows: Iterable[Row],
    path: str | Path,
    *,
    title: str,
    group: Callable[[Row], str] = lambda row: f"NFE {row['nfe']}",
) -> None:
    """Beta-posterior violins of the success rate (appendix A).

    The width at height ``p`` is the posterior density Beta(k + 1, n - k + 1) of the episodes of all
    seeds together; the tick is its mean, and ``k/n`` stands below.

    Args:
        rows: evaluations; those of one source and group are pooled.
        path: of the PNG.

    Keyword Args:
        title: of the figure.
        group: names what stands side by side.

    See Also:
        - :func:`~warmprior.diagnostics.success_posterior`: the density.
        - :func:`~warmprior.experiments.plot_success_bars`: bars over chunk lengths.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments.results import played
        >>> facts = {"options": "", "sigma": 1.0, "chunk": 8, "seed": 0, "nfe": 1}
        >>> rows = [played(facts | {"prior": prior}, [True] * wins + [False] * (10 - wins))
        ...         for prior, wins in {"gaussian": 5, "past": 8}.items()]
        >>> with TemporaryDirectory() as folder:
        ...     plot_success(rows, Path(folder) / "success.png", title="lift ph")
        ...     [path.name for path in Path(folder).iterdir()]
        ['success.png']
    """
    rows = list(rows)
    label, groups = source_labels(rows), grouped(rows, group)
    sources, colors = list(grouped(rows, label)), source_colors(rows, label)
    figure, (axis,) = new_figure(2.2 + 0.55 * (len(sources) + 1) * len(groups), 4.2)
    grid = np.linspace(0.0, 1.0, 801)
    ticks: list[float] = []
    shown: set[str] = set()
    for g, members in enumerate(groups.values()):
        start = g * (len(sources) + 0.8)
        for j, source in enumerate(sources):
            cell = [row for row in members if label(row) == source]
            if not cell:
                continue
            k, n = (sum(row[name] for row in cell) for name in ("successes", "episodes"))
            posterior = success_posterior(k, n)
            density = posterior.pdf(grid)
            x, half = start + j, 0.42 * density / density.max()
            axis.fill_betweenx(
                grid,
                x - half,
                x + half,
                color=colors(cell[0]),
                alpha=0.75,
                lw=0,
                label=None if source in shown else source,
            )
            shown.add(source)
            axis.plot([x - 0.3, x + 0.3], [posterior.mean()] * 2, color="black", lw=1.2)
            axis.text(x, -0.025, f"{k}/{n}", ha="center", va="top", fontsize=7, color="0.35")
        ticks.append(start + (len(sources) - 1) / 2)
    axis.set_xticks(ticks, list(groups))
    axis.set_ylim(-0.08, 1.0)
    axis.set_yticks(np.linspace(0, 1, 6))
    axis.set_ylabel("success rate (posterior density)")
    axis.set_title(title, fontsize=10)
    axis.grid(axis="y", alpha=0.25)
    legend_below(figure)
    figure.savefig(path, dpi=150)


def grouped_bars(
    axis: Any,
    rows: Sequence[Row],
    group: Callable[[Row], str],
    label: Callable[[Row], str],
    color: Callable[[Row], Any],
    summary: Callable[[list[Row]], SeedSummary],
    text: Callable[[float], str],
) -> None:
    """Bars of what was measured, side by side in groups, with one seed standard deviation.

    Args:
        axis: to draw on.
        rows: in the order of groups and bars.
        group: names the group of a row.
        label: names its bar, for the legend.
        color: of the bar; the same function for all axes of a figure, whose legend is one.
        summary: of the rows of a bar.
        text: above a bar and its deviation, of its mean.
    """
    groups = grouped(rows, group)
    sources = list(grouped(rows, label))
    shown: set[str] = set()
    for g, members in enumerate(groups.values()):
        for j, source in enumerate(sources):
            cell = [row for row in members if label(row) == source]
            if not cell:
                continue
            found = summary(cell)
            x = g * (len(sources) + 0.8) + j
            axis.bar(
                x,
                found.mean,
                0.85,
                yerr=None if math.isnan(found.std) else found.std,
                capsize=3,
                color=color(cell[0]),
                label=None if source in shown else source,
            )
            shown.add(source)
            axis.annotate(
                text(found.mean),
                (x, found.mean + np.nan_to_num(found.std)),  # above the error bar
                (0, 4),
                textcoords="offset points",
                annotation_clip=False,
                ha="center",
                fontsize=8,
            )
    centre = (len(sources) - 1) / 2
    at = [g * (len(sources) + 0.8) + centre for g in range(len(groups))]
    axis.set_xticks(at, list(groups))
    axis.grid(axis="y", alpha=0.25)


def plot_success_bars(rows: Sequence[Row], path: str | Path, *, top_k: int, title: str) -> None:
    """Success rates as bars, a group per chunk length, with one seed standard deviation (Fig. 6).

    Args:
        rows: evaluations of one task at one NFE.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.

    See Also:
        - :func:`~warmprior.experiments.plot_success`: posteriors of the rates.
        - :func:`~warmprior.experiments.success_table`: the same in numbers.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> facts = {"prior": "past", "options": "", "sigma": 0.5, "seed": 0, "nfe": 1, "checkpoint": 100}
        >>> rows = [Row(facts | {"chunk": chunk}, {"success_rate": 0.7}) for chunk in (4, 8, 16)]
        >>> with TemporaryDirectory() as folder:
        ...     plot_success_bars(rows, Path(folder) / "bars.png", top_k=1, title="lift ph")
        ...     imread(Path(folder) / "bars.png").shape[1]  # wider for every chunk length
        945
    """
    figure, (axis,) = new_figure(1.8 + 1.5 * len(grouped(rows, lambda row: row["chunk"])), 3.6)
    label = source_labels(rows, chunks=False)
    grouped_bars(
        axis,
        rows,
        lambda row: f"H = {row['chunk']}",
        label,
        source_colors(rows, label),
        lambda cell: success_summary(cell, top_k),
        lambda mean: f"{100 * mean:.0f}",
    )
    axis.set_ylim(0, 1.08)
    axis.set_ylabel(f"success rate (NFE {rows[0]['nfe']})")
    legend_below(figure)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_learning_curves(
    losses: Mapping[str, Sequence[Sequence[tuple[int, float]]]],
    rows: Iterable[Row],
    path: str | Path,
    *,
    title: str,
) -> None:
    """Training loss and success rate against the iteration.

    Args:
        losses: per source, as :func:`source_labels` names it, one ``[(iteration, loss), ...]`` per seed.
        rows: evaluations of one problem at one NFE.
        path: of the PNG.

    Keyword Args:
        title: of the figure.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> facts = {"prior": "past", "options": "", "sigma": 0.5, "chunk": 8, "seed": 0, "nfe": 1}
        >>> rows = [Row(facts | {"checkpoint": n}, {"success_rate": n / 100}) for n in (50, 100)]
        >>> losses = {source_labels(rows)(rows[0]): [[(25, 0.9), (50, 0.5), (100, 0.4)]]}
        >>> with TemporaryDirectory() as folder:
        ...     plot_learning_curves(losses, rows, Path(folder) / "curves.png", title="lift ph")
        ...     [path.name for path in Path(folder).iterdir()]
        ['curves.png']
    """
    rows = list(rows)
    figure, (left, right) = new_figure(9.0, 3.6, columns=2)
    label = source_labels(rows)
    by_source, color = grouped(rows, label), source_colors(rows, label)
    colors = {source: color(group[0]) for source, group in by_source.items()}
    for source, seeds in losses.items():
        for i, curve in enumerate(seeds):
            name = source if i == 0 else None
            left.plot(*zip(*curve, strict=True), color=colors.get(source), lw=1.0, label=name)
    left.set_yscale("log")
    left.set_ylabel("flow-matching loss (own source)")
    for source, group in by_source.items():
        cells = grouped(group, lambda row: row["checkpoint"])
        points = [success_summary(cells[checkpoint], 1) for checkpoint in sorted(cells)]
        right.errorbar(
            sorted(cells),
            [point.mean for point in points],
            yerr=np.nan_to_num([point.std for point in points]),
            marker="o",
            ms=4,
            lw=1.0,
            capsize=2,
            color=colors[source],
        )
    right.set_xlim(left.get_xlim())
    right.set_ylim(-0.02, 1.02)
    right.set_ylabel("success rate" + (f" (NFE {rows[0]['nfe']})" if rows else ""))
    for axis in (left, right):
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.25)
    left.legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_filmstrip(
    frames: Sequence[np.ndarray], labels: Sequence[str], path: str | Path, *, title: str
) -> None:
    """One episode as a row of pictures.

    Args:
        frames: uint8 ``[h, w, 3]`` each.
        labels: text below each frame.
        path: of the PNG.

    Keyword Args:
        title: of the figure.

    See Also:
        :func:`~warmprior.training.record_filmstrip`: makes the pictures.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> frames = [np.full((40, 40, 3), shade, np.uint8) for shade in (0, 120, 240)]
        >>> with TemporaryDirectory() as folder:
        ...     plot_filmstrip(frames, ["step 0", "step 5", "step 9"], f"{folder}/film.png", title="lift")
        ...     imread(f"{folder}/film.png").shape[:2]  # 225 pixels per frame
        (300, 675)
    """
    figure, axes = new_figure(1.5 * len(frames), 2.0, columns=len(frames))
    for axis, frame, label in zip(axes, frames, labels, strict=True):
        axis.imshow(frame)
        axis.set_axis_off()
        axis.text(0.5, -0.04, label, transform=axis.transAxes, ha="center", va="top", fontsize=7)
    figure.suptitle(title, fontsize=9)
    figure.savefig(path, dpi=150)


def agent_label(row: Row, seeds: int) -> str:
    """What figures and tables call the agents of one algorithm and source."""
    many = "" if seeds == 1 else "s"
    return f"{row['algorithm'].upper()}, {prior_label(*source_of(row))} ({seeds} seed{many})"


def plot_reinforcement(
    rows: Iterable[Row], path: str | Path, *, title: str, warmup_steps: int
) -> None:
    """Success rate against control steps, mean and one standard deviation over seeds (Fig. 7).

    A panel for the greedy and one for the stochastic agent. Seeds are averaged evaluation by
    evaluation: they are due at the same number of control steps, and made at the next decision.

    Args:
        rows: evaluations with ``algorithm``, ``prior``, ``options``, ``seed``, ``environment_steps`` and
            ``evaluation`` (``"base"``, ``"greedy"`` or ``"stochastic"``).
        path: of the PNG.

    Keyword Args:
        title: of the figure.
        warmup_steps: control steps before the first update, shaded.

    See Also:
        :class:`~warmprior.rl.PriorSpaceTraining`: whose evaluations it draws.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> agent = {"algorithm": "dsrl-na", "prior": "past", "options": "", "seed": 0}
        >>> measured = [("base", 0, 0.2), ("greedy", 100, 0.6), ("stochastic", 100, 0.5)]
        >>> rows = [Row(agent | {"evaluation": kind, "environment_steps": steps}, {"success_rate": rate})
        ...         for kind, steps, rate in measured]
        >>> with TemporaryDirectory() as folder:
        ...     plot_reinforcement(rows, Path(folder) / "agents.png", title="lift", warmup_steps=50)
        ...     [path.name for path in Path(folder).iterdir()]
        ['agents.png']
    """
    rows = list(rows)
    figure, axes = new_figure(10.0, 3.8, 1, 2, share=True)
    agents = grouped(rows, lambda row: (row["algorithm"], *source_of(row)))
    colors = source_colors(rows)
    for axis, kind in zip(axes, ("greedy", "stochastic"), strict=True):
        for (algorithm, *_), members in agents.items():
            shown = [row for row in members if row["evaluation"] in ("base", kind)]
            seeds = list(grouped(shown, lambda row: row["seed"]).values())
            shared = range(min(map(len, seeds)))
            band(
                axis,
                [
                    float(np.mean([points[k]["environment_steps"] for points in seeds]))
                    for k in shared
                ],
                [summarize_seeds([points[k]["success_rate"] for points in seeds]) for k in shared],
                color=colors(members[0]),
                ls="--" if algorithm == "dsrl-sac" else "-",
                ms=3,
                label=agent_label(members[0], len(seeds)),
            )
        axis.axvspan(0, warmup_steps, color="0.92", lw=0, zorder=-1)
        axis.set_title(f"{kind} agent; at 0 the frozen policy", fontsize=9)
        axis.set_xlabel("control steps (shaded: warm-up)")
        axis.set_ylim(-0.02, 1.02)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)
