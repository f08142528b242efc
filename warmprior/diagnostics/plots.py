"""Figures: success posteriors, learning curves, filmstrips."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from warmprior.diagnostics._figure import new_figure, prior_color, prior_label
from warmprior.diagnostics.results import Row, summarize
from warmprior.diagnostics.statistics import success_posterior

__all__ = ["plot_filmstrip", "plot_learning_curves", "plot_success"]


def plot_success(
    rows: Iterable[Row], path: str | Path, *, priors: Sequence[str], nfes: Sequence[int], title: str
) -> None:
    """Beta-posterior violins of the success rate, one group per NFE (appendix A).

    The width at height ``p`` is the posterior density Beta(k + 1, n - k + 1) of the episodes of all
    seeds' last checkpoints together; the tick is its mean, and ``k/n`` stands below.

    Args:
        rows: of one task, data and chunk length.
        path: of the PNG.

    Keyword Args:
        priors: violins of a group.
        nfes: groups.
        title: of the figure.
    """
    rows = list(rows)
    last = max(row.checkpoint for row in rows)
    figure, (axis,) = new_figure(2.2 + 1.6 * len(nfes), 4.2)
    grid = np.linspace(0.0, 1.0, 801)
    ticks: list[tuple[float, str]] = []
    for g, nfe in enumerate(nfes):
        for j, prior in enumerate(priors):
            cell = [r for r in rows if r.nfe == nfe and r.prior == prior and r.checkpoint == last]
            if not cell:
                continue
            k, n = sum(r.successes for r in cell), sum(r.episodes for r in cell)
            posterior = success_posterior(k, n)
            density = posterior.pdf(grid)
            x = g * (len(priors) + 0.8) + j
            half = 0.42 * density / density.max()
            axis.fill_betweenx(
                grid,
                x - half,
                x + half,
                color=prior_color(prior),
                alpha=0.75,
                lw=0,
                label=prior_label(prior) if g == 0 else None,
            )
            axis.plot([x - 0.3, x + 0.3], [posterior.mean()] * 2, color="black", lw=1.2)
            axis.text(x, -0.025, f"{k}/{n}", ha="center", va="top", fontsize=7, color="0.35")
        ticks.append((g * (len(priors) + 0.8) + (len(priors) - 1) / 2, f"NFE {nfe}"))
    axis.set_xticks([x for x, _ in ticks], [label for _, label in ticks])
    axis.set_ylim(-0.08, 1.0)
    axis.set_yticks(np.linspace(0, 1, 6))
    axis.set_ylabel("success rate (posterior density)")
    axis.set_title(title, fontsize=10)
    axis.grid(axis="y", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=max(1, len(priors)), frameon=False, fontsize=9)
    figure.savefig(path, dpi=150)


def plot_learning_curves(
    losses: Mapping[str, Sequence[Sequence[tuple[int, float]]]],
    rows: Iterable[Row],
    path: str | Path,
    *,
    nfe: int,
    title: str,
) -> None:
    """Training loss and success rate against the iteration.

    Args:
        losses: per prior, one ``[(iteration, loss), ...]`` per seed.
        rows: evaluations of one task, data and chunk length.
        path: of the PNG.

    Keyword Args:
        nfe: which evaluations to show.
        title: of the figure.
    """
    rows = [row for row in rows if row.nfe == nfe]
    figure, (left, right) = new_figure(9.0, 3.6, columns=2)
    for prior, seeds in losses.items():
        for i, curve in enumerate(seeds):
            label = prior_label(prior) if i == 0 else None
            left.plot(*zip(*curve, strict=True), color=prior_color(prior), lw=1.0, label=label)
    left.set_yscale("log")
    left.set_ylabel("flow-matching loss (own source)")
    for prior in losses:
        checkpoints = sorted({row.checkpoint for row in rows if row.prior == prior})
        points = [
            summarize([r for r in rows if r.checkpoint == c and r.prior == prior], 1)[(prior, nfe)]
            for c in checkpoints
        ]
        spread = [0.0 if np.isnan(point.std) else point.std for point in points]
        right.errorbar(
            checkpoints,
            [point.mean for point in points],
            yerr=spread,
            marker="o",
            ms=4,
            lw=1.0,
            capsize=2,
            color=prior_color(prior),
        )
    right.set_xlim(left.get_xlim())
    right.set_ylim(-0.02, 1.02)
    right.set_ylabel(f"success rate (NFE {nfe})")
    for axis in (left, right):
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.25)
    left.legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def plot_filmstrip(
    frames: Sequence[np.ndarray],
    labels: Sequence[str],
    path: str | Path,
    *,
    title: str,
) -> None:
    """One episode as a row of pictures.

    Args:
        frames: uint8 ``[h, w, 3]`` each.
        labels: text below each frame.
        path: of the PNG.

    Keyword Args:
        title: of the figure.
    """
    figure, axes = new_figure(1.5 * len(frames), 2.0, columns=len(frames))
    for axis, frame, label in zip(axes, frames, labels, strict=True):
        axis.imshow(frame)
        axis.set_axis_off()
        axis.text(0.5, -0.04, label, transform=axis.transAxes, ha="center", va="top", fontsize=7)
    figure.suptitle(title, fontsize=9)
    figure.savefig(path, dpi=150)
