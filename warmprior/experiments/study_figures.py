"""Figures of the studies of sigma, of the chunk length, of the training budget and of delays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from warmprior.diagnostics.statistics import summarize_seeds
from warmprior.experiments.figures import band, grouped_bars, legend_below, new_figure
from warmprior.experiments.labels import (
    prior_color,
    prior_label,
    source_colors,
    source_labels,
    source_of,
)
from warmprior.experiments.methods import Method
from warmprior.experiments.paper import PAPER_SIGMA
from warmprior.experiments.results import Row, grouped, mean_known, select, success_summary
from warmprior.experiments.straightness import pooled

__all__ = ["plot_budget", "plot_chunk_lengths", "plot_delays", "plot_sigma"]


def plot_sigma(
    rows: Sequence[Row], path: str | Path, *, top_k: int, title: str, paper: bool = False
) -> None:
    """Success against sigma, with the curvature and the branching bound on the same axis (appendix).

    A panel per warm source; shaded is one seed standard deviation. Curvature (executed positions, mean
    of the training) and bound are those of the prior over those of the first policy.

    Args:
        rows: evaluations at one NFE, the baseline's first if there is one, and those of
            :func:`~warmprior.experiments.straightness` for the same policies.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.
        paper: add the success rates that the paper reports.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> facts = {"options": "", "chunk": 8, "seed": 0, "nfe": 1, "checkpoint": 100}
        >>> cells = [("gaussian", 1.0, 0.5), ("past", 1.0, 0.6), ("past", 0.5, 0.8), ("preview", 1.0, 0.7)]
        >>> rows = [Row(facts | {"prior": prior, "sigma": sigma}, {"success_rate": rate})
        ...         for prior, sigma, rate in cells]
        >>> with TemporaryDirectory() as folder:
        ...     plot_sigma(rows, f"{folder}/sigma.png", top_k=1, title="lift ph")
        ...     imread(f"{folder}/sigma.png").shape[:2]  # 780 pixels per warm source
        (630, 1560)
    """
    played = select(rows, "success_rate")
    measured = pooled(select(rows, "ratio_executed", mean="training"))
    by_source, curved = grouped(played, source_of), grouped(measured, source_of)
    warm = [source for source in by_source if Method.takes(source[0], "sigma")]
    base = next((source for source in by_source if source not in warm), None)
    # Curvatures are told relative to the first policy, whether or not it is a baseline; so is the bound.
    policies = grouped(measured, lambda row: (source_of(row), row["sigma"]))
    first_bound = mean_known(next(iter(policies.values()), ()), "bound_executed")
    figure, axes = new_figure(5.2 * len(warm), 4.2, 1, len(warm))
    for axis, source in zip(axes, warm, strict=True):
        prior, options = source
        cells = grouped(by_source[source], lambda row: row["sigma"])
        sigmas = sorted(cells, reverse=True)
        points = [success_summary(cells[sigma], top_k) for sigma in sigmas]
        band(axis, range(len(sigmas)), points, color=prior_color(prior), label="success rate")
        if base is not None:
            level = success_summary(by_source[base], top_k).mean
            label = prior_label(*base)
            axis.axhline(level, color=prior_color(base[0]), ls="--", lw=1.2, label=label)
        if paper and not options:
            told = PAPER_SIGMA.get(prior, {})
            x = [i for i, s in enumerate(sigmas) if s in told]
            axis.plot(x, [told[sigmas[i]] for i in x], "*", color="black", ms=10, label="paper")
        right = axis.twinx()
        for measure, scale, marker, label in (
            ("ratio_executed", 1.0, "s", "curvature (executed H)"),
            ("bound_executed", first_bound, "^", "branching bound"),
        ):
            at = grouped(curved.get(source, ()), lambda row: row["sigma"])
            found = {s: mean_known(at.get(s, ()), measure) for s in sigmas}
            known = {s: value for s, value in found.items() if value is not None and scale}
            if not known:
                continue
            right.plot(
                [sigmas.index(s) for s in known],
                [value / scale for value in known.values()],  # type: ignore[operator]
                color="0.3",
                ls=":",
                marker=marker,
                ms=4,
                lw=1.0,
                label=label,
            )
        right.set_ylim(bottom=0)
        right.set_ylabel("relative to the first policy")
        axis.set_xticks(range(len(sigmas)), [f"{s:g}" for s in sigmas])
        axis.set_xlabel(r"$\sigma$")
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel("success rate")
        axis.set_title(prior_label(*source), fontsize=10)
        axis.grid(axis="y", alpha=0.25)
        handles, labels = (
            [part for a in (axis, right) for part in a.get_legend_handles_labels()[i]]
            for i in (0, 1)
        )
        axis.legend(handles, labels, fontsize=7, frameon=False, loc="upper right")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_chunk_lengths(rows: Sequence[Row], path: str | Path, *, top_k: int, title: str) -> None:
    """Success, and jumps at chunk boundaries, against the chunk length.

    Above a panel per NFE with the success rate; below the mean distance between the last action of a
    chunk and the first of the next, in normalised action units, and dotted that between consecutive
    actions inside chunks, of the last checkpoints.

    Args:
        rows: evaluations of one task.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.

    See Also:
        :func:`~warmprior.diagnostics.smoothness`: measures the jumps.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> facts = {"prior": "past", "options": "", "sigma": 0.5, "seed": 0, "checkpoint": 100}
        >>> measures = {"success_rate": 0.7, "boundary_jump": 0.2, "inner_jump": 0.1}
        >>> rows = [Row(facts | {"iterations": 100, "chunk": chunk, "nfe": nfe}, measures)
        ...         for chunk in (4, 8) for nfe in (9, 1)]
        >>> with TemporaryDirectory() as folder:
        ...     plot_chunk_lengths(rows, f"{folder}/chunks.png", top_k=1, title="lift ph")
        ...     imread(f"{folder}/chunks.png").shape[:2]  # 510 pixels per NFE
        (900, 1020)
    """
    by_nfe = grouped(rows, lambda row: row["nfe"])
    chunks = sorted({row["chunk"] for row in rows})
    label = source_labels(rows, chunks=False)
    colors = source_colors(rows, label)
    figure, axes = new_figure(3.4 * len(by_nfe), 6.0, 2, len(by_nfe))
    for column, (nfe, members) in enumerate(by_nfe.items()):
        above, below = axes[column], axes[len(by_nfe) + column]
        for source, cells in grouped(members, label).items():
            color, found = colors(cells[0]), grouped(cells, lambda row: row["chunk"])
            known = sorted(found)
            at = [chunks.index(chunk) for chunk in known]
            points = [success_summary(found[chunk], top_k) for chunk in known]
            band(above, at, points, color=color, label=source)
            for measure, style in (("boundary_jump", "-"), ("inner_jump", ":")):
                jumps = {
                    chunks.index(chunk): mean_known(
                        [r for r in found[chunk] if r["checkpoint"] == r["iterations"]], measure
                    )
                    for chunk in known
                }
                shown = {x: jump for x, jump in jumps.items() if jump is not None}
                line = {"color": color, "ls": style, "marker": "o", "ms": 3, "lw": 1.2}
                below.plot(list(shown), list(shown.values()), **line)
        above.set_title(f"NFE {nfe}", fontsize=10)
        above.set_ylim(-0.02, 1.02)
        below.set_ylim(bottom=0)
        below.set_xlabel("chunk length H")
        for axis in (above, below):
            axis.set_xticks(range(len(chunks)), [str(c) for c in chunks])
            axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[len(by_nfe)].set_ylabel("jump at boundaries (dotted: inside)")
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_budget(rows: Sequence[Row], path: str | Path, *, top_k: int, title: str) -> None:
    """Success, and error on held-out demonstrations, against the iterations of the training.

    A column per NFE; shaded is one seed standard deviation.

    Args:
        rows: evaluations of trainings of several lengths, and their ``action_error``, see
            :func:`~warmprior.diagnostics.action_error`.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> facts = {"prior": "past", "options": "", "sigma": 0.5, "chunk": 8, "seed": 0, "nfe": 1}
        >>> measured = [(100, {"success_rate": 0.4, "action_error": 0.2}),
        ...             (1000, {"success_rate": 0.8, "action_error": 0.1})]
        >>> rows = [Row(facts | {"iterations": n, "checkpoint": n}, found) for n, found in measured]
        >>> with TemporaryDirectory() as folder:
        ...     plot_budget(rows, f"{folder}/budget.png", top_k=1, title="lift ph")
        ...     imread(f"{folder}/budget.png").shape[:2]  # 540 pixels per NFE
        (900, 540)
    """
    by_nfe = grouped(sorted(rows, key=lambda row: row["nfe"]), lambda row: row["nfe"])
    budgets = sorted({row["iterations"] for row in rows})
    label = source_labels(rows)
    colors = source_colors(rows, label)
    figure, axes = new_figure(3.6 * len(by_nfe), 6.0, 2, len(by_nfe))
    for column, (nfe, members) in enumerate(by_nfe.items()):
        above, below = axes[column], axes[len(by_nfe) + column]
        for source, cells in grouped(members, label).items():
            color, found = colors(cells[0]), grouped(cells, lambda row: row["iterations"])
            known = sorted(found)
            success = [success_summary(select(found[n], "success_rate"), top_k) for n in known]
            errors = [
                summarize_seeds([row["action_error"] for row in select(found[n], "action_error")])
                for n in known
            ]
            band(above, known, success, color=color, label=source)
            band(below, known, errors, color=color)
        above.set_title(f"NFE {nfe}", fontsize=10)
        above.set_ylim(-0.02, 1.02)
        below.set_ylim(bottom=0)
        below.set_xlabel("iterations")
        for axis in (above, below):
            axis.set_xscale("log")
            axis.set_xticks(budgets, [f"{n:,}" for n in budgets], fontsize=8)
            axis.minorticks_off()
            axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[len(by_nfe)].set_ylabel("squared error of executed actions, held out", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_delays(
    rows: Sequence[Row],
    path: str | Path,
    *,
    label: Callable[[Row], str],
    top_k: int,
    title: str,
) -> None:
    """Success and jumps where chunks take effect, a group of bars per delay.

    A column per task; the layout is that of the paper's comparison with Real-Time Chunking.

    Args:
        rows: evaluations at one NFE and several delays.
        path: of the PNG.

    Keyword Args:
        label: names the source and guidance of a row.
        top_k: checkpoints averaged per seed.
        title: of the figure.

    See Also:
        - :class:`~warmprior.experiments.DelayedRecipe`: the comparison that it draws.
        - :class:`~warmprior.RealTimeChunking`: the guidance.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> facts = {"task": "lift", "data": "ph", "prior": "past", "options": "", "sigma": 0.5, "chunk": 8,
        ...          "seed": 0, "nfe": 1, "checkpoint": 100, "iterations": 100}
        >>> measures = {"success_rate": 0.7, "boundary_jump": 0.2}
        >>> rows = [Row(facts | {"delay": delay}, measures) for delay in (0, 2)]
        >>> with TemporaryDirectory() as folder:
        ...     plot_delays(rows, f"{folder}/delays.png", label=source_labels(rows), top_k=1, title="lift")
        ...     [path.name for path in Path(folder).iterdir()]
        ['delays.png']
    """
    rows = sorted(rows, key=lambda row: row["delay"])
    tasks = grouped(rows, lambda row: f"{row['task']} {row['data']}")
    delays = len({row["delay"] for row in rows})
    bars, color = len(grouped(rows, label)), source_colors(rows, label)
    width = 1.0 + delays * (0.6 + 0.33 * bars)
    figure, axes = new_figure(width * len(tasks), 6.0, 2, len(tasks))
    for column, (task, members) in enumerate(tasks.items()):
        above, below = axes[column], axes[len(tasks) + column]

        def delay(row: Row) -> str:
            return f"delay {row['delay']}"

        grouped_bars(
            above,
            members,
            delay,
            label,
            color,
            lambda cell: success_summary(cell, top_k),
            lambda mean: f"{100 * mean:.0f}",
        )
        last = [row for row in members if row["checkpoint"] == row["iterations"]]
        known = [row for row in last if row.get("boundary_jump") is not None]
        grouped_bars(
            below,
            known,
            delay,
            label,
            color,
            lambda cell: summarize_seeds([row["boundary_jump"] for row in cell]),
            lambda mean: f"{mean:.2f}",
        )
        above.set_title(task, fontsize=10)
        above.set_ylim(0, 1.08)
        below.margins(y=0.1)  # for the numbers above the bars
        below.set_ylim(bottom=0)
    axes[0].set_ylabel(f"success rate (NFE {rows[0]['nfe']})")
    axes[len(tasks)].set_ylabel("jump where chunks take effect")
    legend_below(figure)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)
