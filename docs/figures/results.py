"""Draw the charts and write the tables of the results pages, from the rows of the runs in docs/results.

PYTHONPATH=benchmarks python docs/figures/results.py    # or: make results; writes docs/_static/results and
                                                        # the tables of three pages

Intervals are 95%: Wilson's score interval of a success rate, Newcombe's of a difference. Both treat the
episodes of all seeds as independent; the true spread is larger over training seeds, and smaller for paired
episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
from pages import write
from pandas import DataFrame, Series, concat
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
    read_cells,
    read_played,
    save,
    shown_sources,
    wilson,
    with_own_noise,
)

from lab.paper import PAPER_SUCCESS, STATE
from lab.statistics import chosen_elsewhere

PAGE = DOCS / "results.md"
TEN, TWENTY_FIVE, MANY = "10", "25", "300 of six operators"
SHORT = "square_mh_10000", "transport_mh_10000"
LONG = "square_mh_80000", "transport_mh_80000"
GROUPS = {TEN: ("scripted_10",), TWENTY_FIVE: ("scripted_25",), MANY: LONG}
"""Scripted demonstrations, and the rows of their runs."""
LENGTHS = {  # demonstrations whose runs differ in the length of training
    f"square, {MANY}": (SHORT[0], LONG[0]),
    f"transport, {MANY}": (SHORT[1], LONG[1]),
    "can, 25 of six operators": ("can_mh_25_10000", "can_mh_25_80000"),
    "can, 150 of six operators": ("can_mh_150_10000", "can_mh_150_80000"),
    "door, 25 human": ("door_20000", "door_80000"),
    "Push-T, 50 human": ("pusht_50", "pusht_50_80000"),
    "Push-T, 206 human": ("pusht_206_45000", "pusht_206_80000"),
}
WARM = (PAST, PREVIEW, CORRELATED)


def gain(row: Series, base: Series) -> tuple[float, float, float]:
    """Return the difference to the Gaussian source in points, and the lengths of its error bar."""
    a, b = row["success"], base["success"]
    (low, high), (base_low, base_high) = wilson(a, row["total"]), wilson(b, base["total"])
    return a - b, np.hypot(a - low, base_high - b), np.hypot(high - a, b - base_low)


def gains() -> DataFrame:
    """Return success minus the Gaussian source's at one step, in cells and on average over a group."""
    rows_of_chart = []
    for group, runs in GROUPS.items():
        cells = read_cells(runs).query("nfe == 1")
        tasks = [(f"{task}, {group}", part) for task, part in cells.groupby("task", sort=False)]
        mean = cells.groupby("source", as_index=False).agg({"success": "mean", "total": "sum"})
        for name, part in (*tasks, (f"mean of {group}", mean)):
            part = part.set_index("source")
            rows_of_chart += [[name, source, *gain(part.loc[source], part.loc[GAUSSIAN])] for source in WARM]
    return DataFrame(rows_of_chart, columns=["setting", "source", "gain", "down", "up"])


def one_step() -> None:
    """Draw chart A: gains at one step."""
    frame = gains()
    picture, (axis,) = figure(WIDTH, 7.5, 1, "Success at one step, minus that of the Gaussian source")
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
    """Draw chart B: success against the number of integration steps."""
    picture, axes = figure(WIDTH, 8.4, 1, "Success against the number of network evaluations", rows=3)
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
        # The same episodes were played at every NFE.
        means = cells.groupby(["source", "iterations"], as_index=False).agg(
            {"success": "mean", "total": "max"}
        )
        means["iterations"] //= 1_000
        lines(axis, means, "iterations", sorted(means["iterations"].unique()))
        finish(axis, name.replace(", ", ",\n"), xlabel="thousand iterations of batch 128", xlim=(8, 100))
    picture.supylabel("success in percent, mean of NFE 9, 3 and 1, 95% interval", fontsize=10)
    save(picture, "iterations")


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
    """Return outcomes of a source and the Gaussian one, ``[lengths, episodes]``, of their common seeds."""
    rows = concat([with_own_noise(read_played(run)).assign(run=run) for run in runs])
    rows = rows[rows["source"].isin((source, GAUSSIAN)) & (rows["nfe"] == nfe)]
    solved = rows.pivot(index="seed", columns=["source", "run"], values="solved").dropna()
    return {s: np.stack([np.concatenate(list(solved[s, run])) for run in runs]) for s in (source, GAUSSIAN)}


def all_lengths(source: str, choose: Callable[[np.ndarray], np.ndarray]) -> tuple[str, str, str]:
    """Return the mean success of a source over all sets, that of the Gaussian source, and their pairs.

    `choose` takes the outcomes after each length, and returns those of one. The texts are for NFE 9, 3 and 1.
    """
    texts = []
    for nfe in (9, 3, 1):
        played = [outcomes_by_length(runs, source, nfe) for runs in LENGTHS.values()]
        pairs = [[choose(of[name]) for name in (source, GAUSSIAN)] for of in played]
        means = 100 * np.mean([[outcomes.mean() for outcomes in pair] for pair in pairs], 0) + 1e-6
        won, lost = (sum((ahead * (a - b) > 0).sum() for a, b in pairs) for ahead in (1, -1))
        texts.append((*(f"{mean:.0f}" for mean in means), f"{won}:{lost}"))
    success, base, counts = zip(*texts, strict=True)
    return "/".join(success), "/".join(base), ", ".join(counts)


CHOICES = {"long training": lambda outcomes: outcomes[-1], "better length": chosen_elsewhere}
"""After which training a source is played; the better length is chosen per set and NFE, on other episodes."""


def sets_table() -> str:
    """Return the mean success of warm sources over all sets in Markdown, beside the Gaussian source's."""
    text = [
        "| | " + " | ".join(f"{choice} | {SOURCES[GAUSSIAN][0]} | won : lost" for choice in CHOICES) + " |"
    ]
    text.append("|---" * (1 + 3 * len(CHOICES)) + "|")
    for source in WARM:
        entries = [entry for choose in CHOICES.values() for entry in all_lengths(source, choose)]
        text.append(f"| {SOURCES[source][0]} | {' | '.join(entries)} |")
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
        DOCS / "paper.md": [paper_table()],
    }


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for draw in one_step, steps, iterations:
        draw()
    write(tables())
