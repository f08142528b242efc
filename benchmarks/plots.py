"""Pictures of the benchmarks, from the same rows as their tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from methods import Method, color
from pandas import DataFrame, Series
from paper import PAPER_SIGMA
from report import agents, labelled, last_checkpoints, pooled, prior_label, seed_success, text_of
from torch import Tensor

from warmprior.diagnostics import SeedSummary, success_posterior, summarize_seeds
from warmprior.envs.navigation1d import (
    HALF_HEIGHT,
    HALF_WIDTH,
    OBSTACLES,
    navigation_heights,
    navigation_positions,
)

ABOVE, BELOW, INK = "#1f77b4", "#d95f02", "#202020"  # sides of the toy's obstacles, and one path
PALEST = 0.6  # share of white (or black, where the prior's own colour is bright) in the last shade


# What the pictures share


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, share: bool = False
) -> tuple[Figure, list[Any]]:
    """A figure and its axes, row by row; it needs no display and leaves no pyplot state behind."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    return figure, list(axes.flat)


def save(figure: Figure, path: str | Path, title: str, size: int = 10) -> None:
    figure.suptitle(title, fontsize=size)
    figure.savefig(path, dpi=150)


def colors_of(rows: DataFrame, name: str = "method") -> dict[Hashable, Any]:
    """The colour of each method: its prior's, in shades where several methods share a prior."""
    colors: dict[Hashable, Any] = {}
    for prior, group in rows.groupby("prior", sort=False):
        own, methods = to_rgb(color(prior)), group[name].unique()
        end = float(sum(own) < 2)
        for place, method in enumerate(methods):
            share = PALEST * place / max(1, len(methods) - 1)
            colors[method] = tuple((1 - share) * part + share * end for part in own)
    return colors


def band(axis: Any, x: Sequence[float], points: Sequence[SeedSummary], **line: Any) -> None:
    """A line of means, with one standard deviation over seeds shaded."""
    mean = np.array([point.mean for point in points])
    spread = np.nan_to_num([point.std for point in points])
    drawn = axis.plot(x, mean, **{"marker": "o", "ms": 4, "lw": 1.4} | line)[0]
    axis.fill_between(x, mean - spread, mean + spread, color=drawn.get_color(), alpha=0.2, lw=0)


def legend_below(figure: Figure) -> None:
    """One legend of all axes below them, in as many columns as the figure is wide.

    The figure grows by its height, so that the axes keep theirs, and to its width if one column is wider.
    """
    handles = {
        label: handle
        for axis in figure.axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    style: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "fontsize": 9}
    for columns in range(max(1, len(handles)), 0, -1):
        legend = figure.legend(handles.values(), handles.keys(), ncols=columns, **style)
        needed = legend.get_window_extent()
        if columns == 1 or needed.width <= figure.bbox.width:
            break
        legend.remove()
    width, height = figure.get_size_inches()
    grown = height + needed.height / figure.dpi
    figure.set_size_inches(max(width, needed.width / figure.dpi), grown)


def side_by_side(
    axis: Any, rows: DataFrame, group: str, draw: Callable[[float, DataFrame, dict[str, Any]], None]
) -> None:
    """Draw the methods of each group beside each other; the legend names each of them once."""
    methods, groups = list(rows["method"].unique()), list(rows[group].unique())
    step, named = len(methods) + 0.8, set()
    for g, (_, members) in enumerate(rows.groupby(group, sort=False)):
        for method, cell in members.groupby("method", sort=False):
            look = {"color": cell["color"].iloc[0], "label": None if method in named else method}
            draw(g * step + methods.index(method), cell, look)
            named.add(method)
    axis.set_xticks([g * step + (len(methods) - 1) / 2 for g in range(len(groups))], groups)
    axis.grid(axis="y", alpha=0.25)


def bars(
    axis: Any,
    rows: DataFrame,
    group: str,
    found: Callable[[DataFrame], SeedSummary],
    form: str,
    scale: float = 1.0,
) -> None:
    """Bars of means, with one standard deviation over seeds and the mean in writing."""

    def draw(x: float, cell: DataFrame, look: dict[str, Any]) -> None:
        point = found(cell)
        std = None if math.isnan(point.std) else point.std
        axis.bar(x, point.mean, 0.85, yerr=std, capsize=3, **look)
        axis.annotate(
            f"{scale * point.mean:{form}}",
            (x, point.mean + (std or 0.0)),  # above the error bar
            (0, 4),
            textcoords="offset points",
            annotation_clip=False,
            ha="center",
            fontsize=8,
        )

    side_by_side(axis, rows, group, draw)


def coloured(rows: DataFrame, chunks: bool = True) -> DataFrame:
    """The rows with their `method` in words and its `color`."""
    rows = labelled(rows, chunks)
    colors = colors_of(rows)
    return rows.assign(color=[colors[method] for method in rows["method"]])


# Comparisons


def plot_success(rows: DataFrame, path: str | Path, title: str, group: str = "nfe") -> None:
    """Posteriors of the success rate as violins (appendix A); a method's rows of a group are pooled.

    The width at height p is the density Beta(k + 1, n - k + 1), the tick its mean; k/n stands below.
    """
    rows = coloured(rows)
    rows[group] = [f"NFE {name}" if group == "nfe" else str(name).upper() for name in rows[group]]
    width = 2.2 + 0.55 * (rows["method"].nunique() + 1) * rows[group].nunique()
    figure, (axis,) = new_figure(width, 4.2)
    grid = np.linspace(0.0, 1.0, 801)

    def draw(x: float, cell: DataFrame, look: dict[str, Any]) -> None:
        k, n = int(cell["successes"].sum()), int(cell["episodes"].sum())
        posterior = success_posterior(k, n)
        density = posterior.pdf(grid)
        half = 0.42 * density / density.max()
        axis.fill_betweenx(grid, x - half, x + half, alpha=0.75, lw=0, **look)
        axis.plot([x - 0.3, x + 0.3], [posterior.mean()] * 2, color="black", lw=1.2)
        axis.text(x, -0.025, f"{k}/{n}", ha="center", va="top", fontsize=7, color="0.35")

    side_by_side(axis, rows, group, draw)
    axis.set_ylim(-0.08, 1.0)
    axis.set_yticks(np.linspace(0, 1, 6))
    axis.set_ylabel("success rate (posterior density)")
    axis.set_title(title, fontsize=10)
    legend_below(figure)
    figure.savefig(path, dpi=150)


def plot_bars(rows: DataFrame, path: str | Path, top_k: int, title: str) -> None:
    """Success at one NFE as bars, a group per chunk length (Fig. 6)."""
    rows = coloured(rows, chunks=False)
    rows["group"] = "H = " + rows["chunk"].astype(str)
    figure, (axis,) = new_figure(1.8 + 1.5 * rows["chunk"].nunique(), 3.6)
    bars(axis, rows, "group", lambda cell: seed_success(cell, top_k), ".0f", 100)
    axis.set_ylim(0, 1.08)
    axis.set_ylabel(f"success rate (NFE {rows['nfe'].iloc[0]})")
    legend_below(figure)
    save(figure, path, title)


def plot_learning_curves(
    losses: Mapping[str, Sequence[Sequence[tuple[int, float]]]],
    rows: DataFrame,
    path: str | Path,
    title: str,
) -> None:
    """Loss and success against the iteration; `losses` by method, a list of (iteration, loss) per seed."""
    figure, (left, right) = new_figure(9.0, 3.6, columns=2)
    rows = labelled(rows)
    colors = colors_of(rows)
    for method, seeds in losses.items():
        for i, curve in enumerate(seeds):
            name = method if i == 0 else None
            left.plot(*zip(*curve, strict=True), color=colors.get(method), lw=1.0, label=name)
    for method, group in rows.groupby("method", sort=False):
        points = {n: seed_success(cell, 1) for n, cell in group.groupby("checkpoint")}
        mean, std = np.array([(point.mean, point.std) for point in points.values()]).T
        look = {"marker": "o", "ms": 4, "lw": 1.0, "capsize": 2, "color": colors[method]}
        right.errorbar(list(points), mean, yerr=np.nan_to_num(std), **look)
    left.set_yscale("log")
    left.set_ylabel("flow-matching loss (own source)")
    right.set_xlim(left.get_xlim())
    right.set_ylim(-0.02, 1.02)
    right.set_ylabel(f"success rate (NFE {rows['nfe'].iloc[0]})")
    for axis in (left, right):
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.25)
    left.legend(frameon=False, fontsize=8)
    save(figure, path, title)


def plot_filmstrip(frames: Sequence[np.ndarray], labels: Sequence[str], path: str | Path, title: str) -> None:
    """One episode as a row of pictures, uint8 [h, w, 3], with a text below each."""
    figure, axes = new_figure(1.5 * len(frames), 2.0, columns=len(frames))
    for axis, frame, label in zip(axes, frames, labels, strict=True):
        axis.imshow(frame)
        axis.set_axis_off()
        axis.text(0.5, -0.04, label, transform=axis.transAxes, ha="center", va="top", fontsize=7)
    save(figure, path, title, 9)


def plot_agents(rows: DataFrame, path: str | Path, title: str, warmup_steps: int) -> None:
    """Success of agents against control steps (Fig. 7), of the greedy and of the stochastic one.

    Seeds are averaged evaluation by evaluation: they are due at the same number of control steps, and made
    at the next decision.
    """
    figure, axes = new_figure(10.0, 3.8, 1, 2, share=True)
    rows = agents(rows)
    rows["source"] = [prior_label(row) for row in rows.to_dict("records")]
    colors = colors_of(rows, "source")
    for axis, kind in zip(axes, ("greedy", "stochastic"), strict=True):
        shown = rows[rows["evaluation"].isin(["base", kind])]
        for agent, group in shown.groupby("agent", sort=False):
            first, seeds = group.iloc[0], group.groupby("seed", sort=False)
            # What all seeds have.
            points = list(group.groupby(seeds.cumcount()))[: seeds.size().min()]
            style = "--" if first["algorithm"] == "dsrl-sac" else "-"
            band(
                axis,
                [point["environment_steps"].mean() for _, point in points],
                [summarize_seeds(list(point["success_rate"])) for _, point in points],
                **{"color": colors[first["source"]], "ls": style, "ms": 3, "label": agent},
            )
        axis.axvspan(0, warmup_steps, color="0.92", lw=0, zorder=-1)
        axis.set_title(f"{kind} agent; at 0 the frozen policy", fontsize=9)
        axis.set_xlabel("control steps (shaded: warm-up)")
        axis.set_ylim(-0.02, 1.02)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    save(figure, path, title)


# Studies


def plot_sigma(rows: DataFrame, curvatures: DataFrame, path: str | Path, top_k: int, title: str) -> None:
    """Success at one NFE against sigma, and curvature and branching bound relative to the first policy's.

    A panel per source that takes sigma. Curvature and bound are those of the executed positions, with the
    mean of the training. The paper's success is added where it measured the same.
    """
    measured = pooled(curvatures[curvatures["mean"] == "training"])
    rows, measured = (
        part.assign(source=[prior_label(row) for row in part.to_dict("records")]) for part in (rows, measured)
    )
    first = rows.iloc[0]
    same = [first.get(name) for name in ("task", "data", "chunk", "nfe")] == ["square", "mh", 8, 1]
    sources = {source: group for source, group in rows.groupby("source", sort=False)}
    warm = [
        source
        for source, group in sources.items()
        if Method(group["prior"].iloc[0], int(first["chunk"])).takes_sigma
    ]
    base = next((source for source in sources if source not in warm), None)
    figure, axes = new_figure(5.2 * len(warm), 4.2, 1, len(warm))
    for axis, source in zip(axes, warm, strict=True):
        group = sources[source].sort_values("sigma", ascending=False, kind="stable")
        prior, sigmas = group["prior"].iloc[0], list(group["sigma"].unique())
        points = [seed_success(cell, top_k) for _, cell in group.groupby("sigma", sort=False)]
        band(axis, range(len(sigmas)), points, color=color(prior), label="success rate")
        if base is not None:
            line = {"color": color(sources[base]["prior"].iloc[0]), "ls": "--", "lw": 1.2}
            axis.axhline(seed_success(sources[base], top_k).mean, label=base, **line)
        if same and not any(text_of(group.iloc[0], name) for name in ("options", "obs")):
            paper = PAPER_SIGMA.get(prior, {})
            x = [i for i, sigma in enumerate(sigmas) if sigma in paper]
            look = {"color": "black", "ms": 10, "label": "paper"}
            axis.plot(x, [paper[sigmas[i]] for i in x], "*", **look)
        right = axis.twinx()
        at = measured[(measured["source"] == source) & measured["sigma"].isin(sigmas)]
        for name, marker, words in (
            ("ratio_executed", "s", "curvature (executed H)"),
            ("bound_executed", "^", "branching bound"),
        ):
            scale = 1.0 if name == "ratio_executed" else measured[name].iloc[0]
            known = at[at[name].notna()].sort_values("sigma", ascending=False)
            if len(known) and scale:
                x = [sigmas.index(sigma) for sigma in known["sigma"]]
                look = {"color": "0.3", "ls": ":", "marker": marker, "ms": 4, "lw": 1.0}
                right.plot(x, list(known[name] / scale), label=words, **look)
        right.set_ylim(bottom=0)
        right.set_ylabel("relative to the first policy")
        axis.set_xticks(range(len(sigmas)), [f"{sigma:g}" for sigma in sigmas])
        axis.set_xlabel(r"$\sigma$")
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel("success rate")
        axis.set_title(source, fontsize=10)
        axis.grid(axis="y", alpha=0.25)
        both = zip(axis.get_legend_handles_labels(), right.get_legend_handles_labels(), strict=True)
        axis.legend(*(a + b for a, b in both), fontsize=7, frameon=False, loc="upper right")
    save(figure, path, title)


def success_above(
    rows: DataFrame, x: str, scale: Callable[[float], float], width: float, top_k: int, below: Any
) -> tuple[Figure, list[Any], list[Any]]:
    """A column per NFE, in the order of the rows: success against `x` above, and what `below` draws."""
    nfes = rows["nfe"].unique()
    figure, axes = new_figure(width * len(nfes), 6.0, 2, len(nfes))
    for nfe, upper, lower in zip(nfes, axes, axes[len(nfes) :], strict=False):
        for method, group in rows[rows["nfe"] == nfe].groupby("method", sort=False):
            found, own = dict(list(group.groupby(x))), group["color"].iloc[0]
            places, cells = [scale(value) for value in found], list(found.values())
            points = [seed_success(cell, top_k) for cell in cells]
            band(upper, places, points, color=own, label=method)
            below(lower, places, cells, own)
        upper.set_title(f"NFE {nfe}", fontsize=10)
        upper.set_ylim(-0.02, 1.02)
        lower.set_ylim(bottom=0)
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[0].legend(frameon=False, fontsize=8)
    return figure, axes, axes[len(nfes) :]


def plot_chunk_lengths(rows: DataFrame, path: str | Path, top_k: int, title: str) -> None:
    """Success against the chunk length, and below the jumps of the last checkpoints.

    Drawn through is the jump at boundaries of chunks, dotted that between the actions inside, in normalised
    action units.
    """
    rows = coloured(rows, chunks=False).sort_values("nfe", ascending=False, kind="stable")
    chunks = sorted(rows["chunk"].unique())

    def below(axis: Any, x: list[float], cells: list[DataFrame], own: Any) -> None:
        for name, style in (("boundary_jump", "-"), ("inner_jump", ":")):
            jumps = [last_checkpoints(cell)[name].astype(float).mean() for cell in cells]
            known = Series(jumps, x).dropna()
            axis.plot(known.index, known, color=own, ls=style, marker="o", ms=3, lw=1.2)

    figure, axes, lower = success_above(rows, "chunk", chunks.index, 3.4, top_k, below)
    for axis in axes:
        axis.set_xticks(range(len(chunks)), [str(chunk) for chunk in chunks])
    for axis in lower:
        axis.set_xlabel("chunk length H")
    lower[0].set_ylabel("jump at boundaries (dotted: inside)")
    save(figure, path, title)


def plot_budget(rows: DataFrame, path: str | Path, top_k: int, title: str) -> None:
    """Success, and below the error on held-out demonstrations, against the iterations of the training."""
    rows = coloured(rows).sort_values("nfe", kind="stable")
    budgets = sorted(rows["iterations"].unique())

    def below(axis: Any, x: list[float], cells: list[DataFrame], own: Any) -> None:
        band(axis, x, [summarize_seeds(list(cell["action_error"])) for cell in cells], color=own)

    figure, axes, lower = success_above(rows, "iterations", float, 3.6, top_k, below)
    for axis in axes:
        axis.set_xscale("log")
        axis.set_xticks(budgets, [f"{budget:,}" for budget in budgets], fontsize=8)
        axis.minorticks_off()
    for axis in lower:
        axis.set_xlabel("iterations")
    lower[0].set_ylabel("squared error of executed actions, held out", fontsize=9)
    save(figure, path, title)


def plot_delays(rows: DataFrame, path: str | Path, top_k: int, title: str) -> None:
    """Success at one NFE, and jumps where chunks take effect, as bars in groups of one delay."""
    rows = coloured(rows.sort_values("delay", kind="stable"))
    rows["group"] = "delay " + rows["delay"].astype(str)
    rows["panel"] = rows["task"] + " " + rows["data"]
    panels = rows["panel"].unique()
    width = 1.0 + rows["delay"].nunique() * (0.6 + 0.33 * rows["method"].nunique())
    figure, axes = new_figure(width * len(panels), 6.0, 2, len(panels))

    def jump(cell: DataFrame) -> SeedSummary:
        return summarize_seeds(list(cell["boundary_jump"]))

    for panel, above, below in zip(panels, axes, axes[len(panels) :], strict=False):
        members = rows[rows["panel"] == panel]
        known = last_checkpoints(members[members["boundary_jump"].notna()])
        bars(above, members, "group", lambda cell: seed_success(cell, top_k), ".0f", 100)
        bars(below, known, "group", jump, ".2f")
        above.set_title(panel, fontsize=10)
        above.set_ylim(0, 1.08)
        below.margins(y=0.1)  # for the numbers above the bars
        below.set_ylim(bottom=0)
    axes[0].set_ylabel(f"success rate (NFE {rows['nfe'].iloc[0]})")
    axes[len(panels)].set_ylabel("jump where chunks take effect")
    legend_below(figure)
    save(figure, path, title)


# The navigation toy, and paths of the flow


def sides(axis: Any, x: np.ndarray, lines: np.ndarray, decides: int, **look: Any) -> None:
    """Lines in the colour of the side on which one of their points lies."""
    for line in lines:
        axis.plot(x, line, color=ABOVE if line[decides] > 0 else BELOW, **look)


def plot_navigation(
    panels: Mapping[str, tuple[Tensor, Sequence[str]]],
    path: str | Path,
    chunk_length: int,
    title: str,
    shown: int = 24,
) -> None:
    """Executed paths between the obstacles, a panel per policy after one of the data (Fig. 5).

    `panels` has by title the heights [n, 64] and lines of text. A path has the colour of the side of its
    first action; one is black, with a dot at the first action of each chunk.
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
            drawn = heights[:shown].numpy()
            sides(axis, x, drawn, 0, lw=0.8, alpha=0.45)
            axis.plot(x, drawn[0], color=INK, lw=1.3)
            axis.plot(x[::chunk_length], drawn[0, ::chunk_length], "o", color=INK, ms=2.8)
        letter = f"({ascii_lowercase[i]}) " if i < len(ascii_lowercase) else ""
        axis.set_title(f"{letter}{name}", fontsize=10)
        place = {"transform": axis.transAxes, "ha": "center", "va": "bottom", "fontsize": 8}
        axis.text(0.5, 0.02, "\n".join(lines), **place)
        axis.set_xlim(-1, 1)
        axis.set_ylim(-1.5, 1.15)
        axis.set_yticks([-1, 0, 1])
        if i % 3 == 0:
            axis.set_ylabel("height (action)")
        if i >= len(panels) + 1 - 3:
            axis.set_xlabel("position (observation)")
    save(figure, path, title)


def plot_flow_paths(paths: Mapping[str, Tensor], path: str | Path, title: str) -> None:
    """One action coordinate along the flow, [n, steps + 1], in a panel per policy (Fig. 4)."""
    figure, axes = new_figure(2.5 * len(paths) + 0.5, 3.4, 1, len(paths), share=True)
    for axis, (name, lines) in zip(axes, paths.items(), strict=True):
        values = lines.numpy()
        sides(axis, np.linspace(0.0, 1.0, values.shape[1]), values, -1, lw=0.7, alpha=0.5)
        for time, end in ((0.0, values[:, 0]), (1.0, values[:, -1])):
            axis.plot(np.full(len(end), time), end, "o", color=INK, ms=1.8, alpha=0.6)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("flow time t")
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("first action of the chunk")
    save(figure, path, title)
