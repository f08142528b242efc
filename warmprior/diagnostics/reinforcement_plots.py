"""Success of agents in source space against control steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from warmprior.diagnostics._figure import new_figure, prior_color, prior_label
from warmprior.diagnostics.statistics import summarize_seeds

__all__ = ["plot_reinforcement"]

STYLES = {"dsrl-na": "-", "dsrl-sac": "--"}


def agent_label(algorithm: str, prior: str, seeds: int) -> str:
    """What figures and tables call the agents of one algorithm and prior."""
    many = "" if seeds == 1 else "s"
    return f"{algorithm.upper()}, {prior_label(prior)} ({seeds} seed{many})"


def plot_reinforcement(
    curve: Iterable[Mapping[str, Any]], path: str | Path, *, title: str, warmup_steps: int
) -> None:
    """Success rate against control steps, mean and one standard deviation over seeds (Fig. 7).

    A panel for the greedy and one for the stochastic agent. Seeds are averaged evaluation by
    evaluation: they are due at the same number of control steps, and made at the next decision.

    Args:
        curve: evaluations with ``"algorithm"``, ``"prior"``, ``"seed"``, ``"environment_steps"``,
            ``"evaluation"`` (``"base"``, ``"greedy"`` or ``"stochastic"``) and ``"success_rate"``.
        path: of the PNG.

    Keyword Args:
        title: of the figure.
        warmup_steps: control steps before the first update, shaded.
    """
    rows = list(curve)
    figure, axes = new_figure(10.0, 3.8, 1, 2, share=True)
    cells = list(dict.fromkeys((row["algorithm"], row["prior"]) for row in rows))
    for axis, kind in zip(axes, ("greedy", "stochastic"), strict=True):
        for algorithm, prior in cells:
            seeds: dict[int, list[tuple[int, float]]] = {}
            for row in rows:
                same = (row["algorithm"], row["prior"]) == (algorithm, prior)
                if same and row["evaluation"] in ("base", kind):
                    point = (row["environment_steps"], row["success_rate"])
                    seeds.setdefault(row["seed"], []).append(point)
            shared = min(map(len, seeds.values()))
            x, mean, low, high = [], [], [], []
            for k in range(shared):
                summary = summarize_seeds([points[k][1] for points in seeds.values()])
                spread = 0.0 if math.isnan(summary.std) else summary.std
                x.append(sum(points[k][0] for points in seeds.values()) / len(seeds))
                mean.append(summary.mean)
                low.append(summary.mean - spread)
                high.append(summary.mean + spread)
            color, style = prior_color(prior), STYLES.get(algorithm, "-")
            label = agent_label(algorithm, prior, len(seeds))
            axis.fill_between(x, low, high, color=color, alpha=0.2, lw=0)
            axis.plot(x, mean, color=color, ls=style, marker="o", ms=3, lw=1.4, label=label)
        axis.axvspan(0, warmup_steps, color="0.92", lw=0, zorder=-1)
        axis.set_title(f"{kind} agent; at 0 the frozen policy", fontsize=9)
        axis.set_xlabel("control steps (shaded: warm-up)")
        axis.set_ylim(-0.02, 1.02)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("success rate")
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)
