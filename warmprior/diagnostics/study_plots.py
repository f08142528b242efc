"""Figures of the studies of sigma, of the chunk length and of the training budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warmprior.diagnostics._figure import new_figure, prior_color, prior_label
from warmprior.diagnostics.paper import PAPER_SIGMA
from warmprior.diagnostics.results import Row, summarize_cell
from warmprior.diagnostics.statistics import SeedSummary, summarize_seeds

__all__ = ["plot_budget", "plot_chunk_lengths", "plot_sigma", "plot_success_bars"]


def _band(
    axis: Any, x: Sequence[float], points: Sequence[SeedSummary], prior: str, **line: Any
) -> None:
    mean = [point.mean for point in points]
    spread = [0.0 if math.isnan(point.std) else point.std for point in points]
    low = [m - s for m, s in zip(mean, spread, strict=True)]
    high = [m + s for m, s in zip(mean, spread, strict=True)]
    axis.fill_between(x, low, high, color=prior_color(prior), alpha=0.2, lw=0)
    axis.plot(x, mean, color=prior_color(prior), marker="o", ms=4, lw=1.4, **line)


def plot_sigma(
    rows: Sequence[Row],
    straightness: Sequence[Mapping[str, Any]],
    path: str | Path,
    *,
    top_k: int,
    title: str,
    paper: bool = False,
) -> None:
    """Success against sigma, with the curvature and the branching bound on the same axis (appendix).

    A panel per warm prior; shaded is one seed standard deviation. Curvature (executed positions, mean
    of the training) and bound are those of the prior over those of the Gaussian source.

    Args:
        rows: evaluations at one NFE, the Gaussian source's included.
        straightness: rows of :func:`~warmprior.diagnostics.straightness` for the same policies.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.
        paper: add the success rates that the paper reports.
    """
    warm = list(dict.fromkeys(row.prior for row in rows if row.prior != "gaussian"))
    sigmas = sorted({row.sigma for row in rows if row.prior in warm}, reverse=True)
    figure, axes = new_figure(5.2 * len(warm), 4.2, 1, len(warm))
    base = [row for row in rows if row.prior == "gaussian"]
    chosen = _pooled(straightness)
    base_bound = next((r["bound"] for r in chosen if r["prior"] == "gaussian"), math.nan)
    for axis, prior in zip(axes, warm, strict=True):
        cells = [[r for r in rows if (r.prior, r.sigma) == (prior, s)] for s in sigmas]
        at = [i for i, cell in enumerate(cells) if cell]
        points = [summarize_cell(cell, top_k) for cell in cells if cell]
        _band(axis, at, points, prior, label="success rate")
        if base:
            level = summarize_cell(base, top_k).mean
            axis.axhline(
                level, color=prior_color("gaussian"), ls="--", lw=1.2, label="Gaussian source"
            )
        if paper:
            told = PAPER_SIGMA.get(prior, {})
            x = [i for i, s in enumerate(sigmas) if s in told]
            axis.plot(x, [told[sigmas[i]] for i in x], "*", color="black", ms=10, label="paper")
        right = axis.twinx()
        mine = {r["sigma"]: r for r in chosen if r["prior"] == prior}
        for key, scale, marker, label in (
            ("ratio_executed", 1.0, "s", "curvature (executed H)"),
            ("bound", base_bound, "^", "branching bound"),
        ):
            y = [mine[s][key] / scale if s in mine else math.nan for s in sigmas]
            right.plot(
                range(len(sigmas)), y, color="0.3", ls=":", marker=marker, ms=4, lw=1.0, label=label
            )
        right.set_ylim(bottom=0)
        right.set_ylabel("relative to the Gaussian source")
        axis.set_xticks(range(len(sigmas)), [f"{s:g}" for s in sigmas])
        axis.set_xlabel(r"$\sigma$")
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel("success rate")
        axis.set_title(prior_label(prior), fontsize=10)
        axis.grid(axis="y", alpha=0.25)
        handles = [h for a in (axis, right) for h in a.get_legend_handles_labels()[0]]
        labels = [label for a in (axis, right) for label in a.get_legend_handles_labels()[1]]
        axis.legend(handles, labels, fontsize=7, frameon=False, loc="upper right")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def _pooled(straightness: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Rows at the mean of the training, averaged over seeds where there are several."""
    trained = [row for row in straightness if row["mean"] == "training"]
    seed = None if any(row["seed"] is None for row in trained) else 0
    return [row for row in trained if row["seed"] == seed]


def plot_chunk_lengths(
    rows: Sequence[Row], path: str | Path, *, nfes: Sequence[int], top_k: int, title: str
) -> None:
    """Success, and jumps at chunk boundaries, against the chunk length.

    Above a panel per NFE with the success rate; below the mean distance between the last action of a
    chunk and the first of the next, in normalised action units, and dotted that between consecutive
    actions inside chunks.

    Args:
        rows: evaluations of one task.
        path: of the PNG.

    Keyword Args:
        nfes: columns.
        top_k: checkpoints averaged per seed.
        title: of the figure.
    """
    figure, axes = new_figure(3.4 * len(nfes), 6.0, 2, len(nfes))
    priors = list(dict.fromkeys(row.prior for row in rows))
    chunks = sorted({row.chunk for row in rows})
    last = max(row.checkpoint for row in rows)
    for column, nfe in enumerate(nfes):
        above, below = axes[column], axes[len(nfes) + column]
        for prior in priors:
            cells = {
                c: [r for r in rows if (r.prior, r.nfe, r.chunk) == (prior, nfe, c)] for c in chunks
            }
            known = {c: summarize_cell(cell, top_k) for c, cell in cells.items() if cell}
            at = [chunks.index(c) for c in known]
            _band(above, at, list(known.values()), prior, label=prior_label(prior))
            for name, style in (("boundary_jump", "-"), ("inner_jump", ":")):
                points = []
                for c, cell in cells.items():
                    jumps = [getattr(r, name) for r in cell if r.checkpoint == last]
                    jumps = [jump for jump in jumps if jump is not None]
                    if jumps:
                        points.append((chunks.index(c), math.fsum(jumps) / len(jumps)))
                if points:
                    x, y = zip(*points, strict=True)
                    below.plot(x, y, color=prior_color(prior), ls=style, marker="o", ms=3, lw=1.2)
        above.set_title(f"NFE {nfe}", fontsize=10)
        above.set_ylim(-0.02, 1.02)
        below.set_ylim(bottom=0)
        below.set_xlabel("chunk length H")
        for axis in (above, below):
            axis.set_xticks(range(len(chunks)), [str(c) for c in chunks])
            axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[len(nfes)].set_ylabel("jump at boundaries (dotted: inside)")
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_success_bars(
    rows: Sequence[Row],
    path: str | Path,
    *,
    groups: Sequence[int],
    nfe: int,
    top_k: int,
    title: str,
) -> None:
    """Success rates as bars, a group per chunk length, with one seed standard deviation (Fig. 6).

    Args:
        rows: evaluations of one task.
        path: of the PNG.

    Keyword Args:
        groups: chunk lengths.
        nfe: which evaluations to show.
        top_k: checkpoints averaged per seed.
        title: of the figure.
    """
    priors = list(dict.fromkeys(row.prior for row in rows))
    figure, (axis,) = new_figure(1.8 + 1.5 * len(groups), 3.6)
    for g, chunk in enumerate(groups):
        for j, prior in enumerate(priors):
            cell = [r for r in rows if (r.prior, r.nfe, r.chunk) == (prior, nfe, chunk)]
            if not cell:
                continue
            summary = summarize_cell(cell, top_k)
            x = g * (len(priors) + 0.8) + j
            spread = None if math.isnan(summary.std) else summary.std
            label = prior_label(prior) if g == 0 else None
            axis.bar(
                x, summary.mean, 0.85, yerr=spread, capsize=3, color=prior_color(prior), label=label
            )
            axis.text(x, summary.mean + 0.015, f"{100 * summary.mean:.0f}", ha="center", fontsize=8)
    centre = (len(priors) - 1) / 2
    at = [g * (len(priors) + 0.8) + centre for g in range(len(groups))]
    axis.set_xticks(at, [f"H = {chunk}" for chunk in groups])
    axis.set_ylim(0, 1.08)
    axis.set_ylabel(f"success rate (NFE {nfe})")
    axis.grid(axis="y", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=len(priors), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_budget(
    rows: Sequence[Row],
    errors: Mapping[tuple[str, int, int], Sequence[float]],
    path: str | Path,
    *,
    top_k: int,
    title: str,
) -> None:
    """Success, and error on held-out demonstrations, against the iterations of the training.

    A column per NFE; shaded is one seed standard deviation.

    Args:
        rows: evaluations of trainings of several lengths, each row's ``checkpoint`` the last of its own.
        errors: by prior, iterations and NFE one error per seed, see :func:`action_error`.
        path: of the PNG.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        title: of the figure.
    """
    nfes = sorted({row.nfe for row in rows})
    budgets = sorted({row.checkpoint for row in rows})
    figure, axes = new_figure(3.6 * len(nfes), 6.0, 2, len(nfes))
    for column, nfe in enumerate(nfes):
        above, below = axes[column], axes[len(nfes) + column]
        for prior in dict.fromkeys(row.prior for row in rows):
            cells = {
                n: [r for r in rows if (r.prior, r.nfe, r.checkpoint) == (prior, nfe, n)]
                for n in budgets
            }
            known = {n: summarize_cell(cell, top_k) for n, cell in cells.items() if cell}
            label = prior_label(prior)
            _band(above, list(known), list(known.values()), prior, label=label)
            found = {n: errors[prior, n, nfe] for n in budgets if (prior, n, nfe) in errors}
            _band(below, list(found), [summarize_seeds(e) for e in found.values()], prior)
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
    axes[len(nfes)].set_ylabel("squared error of executed actions, held out", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)
