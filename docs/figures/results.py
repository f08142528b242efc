"""Draw the charts and write the tables of the results pages, from the rows of the runs in docs/results.

PYTHONPATH=benchmarks python docs/figures/results.py    # or: make results; writes docs/_static/results and
                                                        # the tables of three pages

Intervals are 95%, and count trainings: Student's, from the spread between trainings and between the starts
that they share. Differences pair what the same seed played.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
from comparisons import Comparison, compare, estimate
from pandas import DataFrame, concat
from shared import (
    CORRELATED,
    DOCS,
    GAUSSIAN,
    INK,
    OUT,
    PAST,
    PREVIEW,
    SOURCES,
    WIDTH,
    at_nine_three_one,
    figure,
    finish,
    lines,
    read_arms,
    read_cells,
    read_played,
    save,
    shown_sources,
    with_own_noise,
)
from tables import write

from lab.measures.statistics import chosen_elsewhere
from lab.reporting.paper import PAPER_SUCCESS, STATE

PAGE = DOCS / "results.md"
TEN, TWENTY_FIVE, MANY = "10", "25", "300 from six operators"
SHORT = "square_mh_10000", "transport_mh_10000"
LONG = "square_mh_80000", "transport_mh_80000"
GROUPS = {TEN: ("scripted_10",), TWENTY_FIVE: ("scripted_25",), MANY: LONG}
"""Scripted demonstrations, and the rows of their runs."""
LENGTHS = {  # demonstrations whose runs differ in the length of training
    f"square, {MANY}": (SHORT[0], LONG[0]),
    f"transport, {MANY}": (SHORT[1], LONG[1]),
    "can, 25 from six operators": ("can_mh_25_10000", "can_mh_25_80000"),
    "can, 150 from six operators": ("can_mh_150_10000", "can_mh_150_80000"),
    "door, 25 human": ("door_20000", "door_80000"),
    "Push-T, 50 human": ("pusht_50", "pusht_50_80000"),
    "Push-T, 206 human": ("pusht_206_45000", "pusht_206_80000"),
}
WARM = (PAST, PREVIEW, CORRELATED)
LIFT_AGENTS = "agents_lift"
AGENTS = {
    "lift, weak policies": LIFT_AGENTS,
    "square, 25 demonstrations": "agents_square_25_small",
}


def gains() -> DataFrame:
    """Return success minus the Gaussian source's at NFE 1, in cells and on average over a group."""
    differences: dict[tuple[str, str], list[np.ndarray]] = {}
    for group, runs in GROUPS.items():
        cells = read_cells(runs).query("nfe == 1")
        tasks = [(f"{task}, {group}", part) for task, part in cells.groupby("task", sort=False)]
        for name, part in (*tasks, (f"mean of {group}", cells)):
            solved = part.pivot(index="task", columns="source", values="solved")
            differences |= {(name, source): list(solved[source] - solved[GAUSSIAN]) for source in WARM}
    alike = [cells[0] for cells in differences.values() if len(cells) == 1]
    rows_of_chart = []
    for (name, source), cells in differences.items():
        mean, low, high = estimate(cells, alike)
        rows_of_chart.append([name, source, mean, mean - low, high - mean])
    return DataFrame(rows_of_chart, columns=["setting", "source", "gain", "down", "up"])


def one_step() -> None:
    """Draw chart A: gains at NFE 1."""
    frame = gains()
    picture, (axis,) = figure(WIDTH, 7.5, 1, "Success at NFE 1, minus that of the Gaussian source")
    order = list(dict.fromkeys(frame["setting"]))
    for k, source in enumerate(WARM):
        part, (label, color, mark) = frame[frame["source"] == source], SOURCES[source]
        places = [order.index(name) + 0.2 * (k - 1) for name in part["setting"]]
        axis.errorbar(
            part["gain"], places, xerr=part[["down", "up"]].T, fmt=mark, ms=5, color=color, label=label
        )
    for k, name in enumerate(order):
        if name.startswith("mean"):
            axis.axhspan(k - 0.5, k + 0.5, color=INK, alpha=0.12, lw=0, zorder=0)
    axis.axvline(0, color=SOURCES[GAUSSIAN][1], lw=1.5)
    axis.set_yticks(range(len(order)), order)
    axis.set_ylim(len(order) - 0.5, -0.5)
    axis.set_xlabel("points, with 95% interval")
    axis.grid(axis="x")
    save(picture, "one_step")


def steps() -> None:
    """Draw chart B: success against NFE."""
    picture, axes = figure(WIDTH, 8.4, 1, "Success against NFE (network evaluations per chunk)", rows=3)
    for axis, (group, runs) in zip(axes, GROUPS.items(), strict=True):
        cells = read_cells(runs)
        lines(axis, cells, "nfe", [1, 2, 3, 9])
        finish(axis, f"{group}: mean of {', '.join(cells['task'].unique())}", xlabel="NFE")
    picture.supylabel("success in percent, 95% interval", fontsize=10)
    save(picture, "steps")


def iterations() -> None:
    """Draw chart C: success against the length of the training."""
    rows = (len(LENGTHS) + 1) // 2
    picture, axes = figure(WIDTH, 3.1 * rows, 2, "Success against the length of the training", rows=rows)
    for spare in axes[len(LENGTHS) :]:
        spare.remove()
    for axis, (name, runs) in zip(axes, LENGTHS.items(), strict=False):
        cells = read_cells(runs, common_seeds=True)
        cells = cells[cells["source"].isin((GAUSSIAN, *WARM))]
        # The same episodes were played at every NFE, so an episode counts once, with its mean outcome.
        means = cells.groupby(["source", "iterations"], as_index=False).agg(
            solved=("solved", lambda solved: np.mean([*solved], 0))
        )
        means["iterations"] //= 1_000
        lines(axis, means, "iterations", sorted(means["iterations"].unique()))
        finish(axis, name.replace(", ", ",\n"), xlabel="thousand iterations of batch 128", xlim=(8, 100))
    picture.supylabel("success in percent, mean of NFE 9, 3 and 1, 95% interval", fontsize=10)
    save(picture, "iterations")


def agents() -> None:
    """Draw chart D: success of agents in source space, the mean over seeds and every seed."""
    picture, axes = figure(WIDTH, 4.4, len(AGENTS), "Agents around frozen policies, three seeds")
    for axis, (task, name) in zip(axes, AGENTS.items(), strict=True):
        for arm, part in read_arms(name).groupby("arm", sort=False):
            prior, algorithm, centre = part[["prior", "algorithm", "centre"]].iloc[0]
            _, color, _ = SOURCES[prior]
            style, mark = ("--", "s") if algorithm == "dsrl-sac" else ("-", "o")
            style, mark = (":", "x") if centre == "zero" else (style, mark)
            for _, curve in part.groupby("seed"):
                rates = 100 * curve["success_rate"]
                axis.plot(curve["environment_steps"] / 1_000, rates, style, color=color, lw=0.7, alpha=0.4)
            mean = part.groupby("evaluated")[["environment_steps", "success_rate"]].mean()
            shown = {"color": color, "lw": 2, "marker": mark, "ms": 5, "label": arm}
            axis.plot(mean["environment_steps"] / 1_000, 100 * mean["success_rate"], style, **shown)
        finish(axis, task, xlabel="thousand control steps", ylim=(-3, 103))
    axes[0].set_ylabel("success in percent")
    save(picture, "agents")


def table() -> str:
    """Return success of methods on groups of scripted demonstrations in Markdown."""
    groups = {name: read_cells(runs) for name, runs in GROUPS.items()}
    names = [s for s in SOURCES if any(s in shown_sources(cells) for cells in groups.values())]
    text = [f"| demonstrations | tasks | {' | '.join(SOURCES[name][0] for name in names)} |"]
    text.append("|---" * (2 + len(names)) + "|")
    for group, cells in groups.items():
        entries = [at_nine_three_one(cells, name) for name in names]
        text.append(f"| {group} | {', '.join(cells['task'].unique())} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


def lengths_table() -> str:
    """Return success after short and long trainings in Markdown, of the seeds that both lengths have."""
    names = (GAUSSIAN, *WARM)
    text = [f"| demonstrations | iterations | seeds | {' | '.join(SOURCES[name][0] for name in names)} |"]
    text.append("|---" * (3 + len(names)) + "|")
    for name, runs in LENGTHS.items():
        lengths = dict(list(read_cells(runs, common_seeds=True).groupby("iterations")))
        entries = [" → ".join(at_nine_three_one(p, source) for p in lengths.values()) for source in names]
        iterations = " → ".join(f"{length:,}" for length in lengths)
        seeds = max(part["seeds"].max() for part in lengths.values())
        text.append(f"| {name} | {iterations} | {seeds} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


@cache
def outcomes_by_length(runs: tuple[str, str], source: str, nfe: int) -> dict[str, np.ndarray]:
    """Return outcomes of a source and the Gaussian one, ``[lengths, seeds, episodes]``, of common seeds."""
    rows = concat([with_own_noise(read_played(run)).assign(run=run) for run in runs])
    rows = rows[rows["source"].isin((source, GAUSSIAN)) & (rows["nfe"] == nfe)]
    solved = rows.pivot(index="seed", columns=["source", "run"], values="solved").dropna()
    return {s: np.stack([np.stack(list(solved[s, run])) for run in runs]) for s in (source, GAUSSIAN)}


def better_length(outcomes: np.ndarray) -> np.ndarray:
    """Return the outcomes ``[seeds, episodes]`` of the better length, chosen on other episodes."""
    return chosen_elsewhere(outcomes.reshape(len(outcomes), -1)).reshape(outcomes.shape[1:])


def all_lengths(source: str, choose: Callable[[np.ndarray], np.ndarray]) -> list[Comparison]:
    """Return a source beside the Gaussian source over all sets, at NFE 9, 3 and 1.

    `choose` takes the outcomes after each length, and returns those of one.
    """
    comparisons = []
    for nfe in (9, 3, 1):
        played = [outcomes_by_length(runs, source, nfe) for runs in LENGTHS.values()]
        comparisons.append(compare(*([choose(of[name]) for of in played] for name in (source, GAUSSIAN))))
    return comparisons


CHOICES = {"long training": lambda outcomes: outcomes[-1], "better length": better_length}
"""After which training a source is played; the better length is chosen per set and NFE, on other episodes."""


def sets_table() -> str:
    """Return the mean success of warm sources over all sets in Markdown, beside the Gaussian source's."""
    text = [f"| | NFE | {' | '.join(f'{choice} | Gaussian | ahead:behind' for choice in CHOICES)} |"]
    text.append("|---" * (2 + 3 * len(CHOICES)) + "|")
    for source in WARM:
        for nfe, *pair in zip((9, 3, 1), *(all_lengths(source, c) for c in CHOICES.values()), strict=True):
            entries = [text for c in pair for text in (*(f"{r + 1e-6:.0f}" for r in c.rates), str(c))]
            text.append(f"| {SOURCES[source][0]} | {nfe} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


def paper_table() -> str:
    """Return the paper's Table 1 and these rows in Markdown: success at NFE 9 / 3 / 1."""

    def line(title: str, place: str, entries: Mapping[str, str]) -> str:
        return f"| {title} | {place} | {' | '.join(entries[name] for name in names)} |"

    names = GAUSSIAN, PAST, PREVIEW
    text = ["| | | Gaussian source | WP-Past | WP-Preview |", "|---|---|---|---|---|"]
    rows = read_cells((*SHORT, *LONG, "square_ph_80000"))
    for (task, style, observations), paper in PAPER_SUCCESS.items():
        ours = rows[(rows["task"] == task) & (rows["data"] == style)]
        if observations == STATE and len(ours):
            published = {
                name: "/".join(f"{paper[name][nfe] + 1e-6:.0f}" for nfe in (9, 3, 1)) for name in names
            }
            text.append(line(f"{task} {style}", "the paper", published))
            for length, part in ours.groupby("iterations"):
                seeds = {1: "1 seed"}.get(part["seeds"].max(), f"{part['seeds'].max()} seeds")
                played = {name: at_nine_three_one(part, name) for name in names}
                text.append(line("", f"here, {length:,} iterations, {seeds}", played))
    return "\n".join(text) + "\n"


def tables() -> dict[Path, list[str]]:
    """Return the tables of each page in their order; the lab notes have those of runs alone."""
    return {
        PAGE: [table(), sets_table()],
        DOCS / "notes" / "evidence.md": [lengths_table()],
        DOCS / "notes" / "preview.md": [],
    }


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for draw in one_step, steps, iterations, agents:
        draw()
    write(tables())
