"""Draw the charts and write the tables of the results pages, from the numbers in docs/results.

PYTHONPATH=benchmarks python docs/figures/results.py    # or: make results; writes docs/_static/results and
                                                        # three pages' tables

Intervals are 95%: Wilson's score interval of a success rate, Newcombe's of a difference. Both treat the
episodes of all seeds as independent; the true spread is larger over training seeds, and smaller for paired
episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pages import write
from pandas import DataFrame, Series, concat
from shared import (
    CORRELATED,
    DOCS,
    GAUSSIAN,
    INK,
    OPERATORS,
    OUT,
    PAST,
    PREVIEW,
    SOURCES,
    SVG,
    WIDE,
    WIDTH,
    figure,
    finish,
    lines,
    read,
    read_played,
    save,
    wilson,
)

from lab.paper import PAPER_DEFAULT_SIGMA, PAPER_SUCCESS, STATE

PAGE = DOCS / "results.md"


def gain(row: Series, base: Series) -> tuple[float, float, float]:
    """Return the difference to the Gaussian source in points, and the lengths of its error bar."""
    a, b = row["success"], base["success"]
    (low, high), (base_low, base_high) = wilson(a, row["total"]), wilson(b, base["total"])
    return a - b, np.hypot(a - low, base_high - b), np.hypot(high - a, b - base_low)


def gains() -> DataFrame:
    """Return success minus the Gaussian source's at one step, in settings and on average."""
    settings, means = read("one_step"), read("means")
    names = (
        settings["task"]
        + ", "
        + settings["demonstrations"].astype(str)
        + " of "
        + settings["style"].map(OPERATORS)
    )
    rows_of_chart = []
    for rows, name in (settings, names), (means, "mean of " + means["setting"]):
        for setting, group in rows.groupby(name, sort=False):
            base = group[group["source"] == GAUSSIAN].iloc[0]
            for _, row in group[group["source"] != GAUSSIAN].iterrows():
                rows_of_chart.append([setting, row["source"], *gain(row, base)])
    return DataFrame(rows_of_chart, columns=["setting", "source", "gain", "down", "up"])


def one_step() -> None:
    """Draw chart A: gains at one step."""
    frame = gains()
    picture, (axis,) = figure(WIDTH, 10.5, 1, "Success at one step, minus that of the Gaussian source")
    names, order = list(dict.fromkeys(frame["setting"])), []
    for keys in (", 150", ", 300", "of 150"), (", 25", "of 25"), (", 10 ", "of 10"), ("of all",):
        order += [name for key in keys for name in names if key in name]
    for k, source in enumerate((PAST, PREVIEW, CORRELATED, WIDE)):
        part, (label, color, mark) = frame[frame["source"] == source], SOURCES[source]
        places = [order.index(name) + 0.2 * (k - 1.5) for name in part["setting"]]
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
    rows = read("steps")
    many, two = rows["demonstrations"] >= 150, rows["task"] == "transport"
    parts = {
        "150 or 300 demonstrations, one arm:\nmean of six settings": rows[many & ~two],
        "150 or 300, two arms:\nmean of two settings": rows[two],
        "25 of one operator:\nmean of three tasks": rows[rows["demonstrations"] == 25],
        "10 of one operator:\nmean of three tasks": rows[rows["demonstrations"] == 10],
    }
    picture, axes = figure(WIDTH, 6.6, 2, "Success against the number of integration steps", rows=2)
    for axis, (name, part) in zip(axes, parts.items(), strict=True):
        lines(axis, part, "nfe", [1, 3, 9])
        finish(axis, name, xlabel="integration steps (NFE)")
    picture.supylabel("success in percent, 95% interval", fontsize=10)
    save(picture, "steps")


def demonstrations() -> None:
    """Draw chart C: success against demonstrations, with a dot per seed."""
    rows = read("one_step")
    picture, axes = figure(WIDTH, 8, 1, "Success at one step against demonstrations (dots: seeds)", rows=3)
    for axis, task in zip(axes, ("square", "can", "stack"), strict=True):
        part = rows[(rows["task"] == task) & (rows["style"] == "ph")]
        lines(axis, part, "demonstrations", [10, 25, 150], interval=False)
        for _, row in part[part["seed_success"].notna()].iterrows():
            each = [int(n) for n in row["seed_success"].split()]
            place = row["demonstrations"] * (1 + 0.07 * (list(SOURCES).index(row["source"]) - 1))
            axis.plot([place] * len(each), each, ".", ms=7, alpha=0.55, color=SOURCES[row["source"]][1])
        finish(axis, task, xlabel="demonstrations of one operator")
    picture.supylabel("success in percent", fontsize=10)
    save(picture, "demonstrations")


def iterations() -> None:
    """Draw chart D: success against the length of the training."""
    rows = read("iterations")
    six = rows["style"] == "mh"
    parts = {
        "transport, six operators (one seed)": rows[six & (rows["seeds"] == 1)],
        "square, six operators (three seeds)": rows[six & (rows["task"] == "square")],
        "square, one operator, the paper's loss\n(one seed, two at 20,000)": rows[~six],
    }
    picture, axes = figure(WIDTH, 8.4, 1, "Success at one step against the length of the training", rows=3)
    for axis, (name, part) in zip(axes, parts.items(), strict=True):
        lines(axis, part, "iterations", [2_500, 5_000, 10_000, 20_000])
        finish(axis, name, xlabel="training iterations of batch 128", xlim=(2_100, 24_000))
    picture.supylabel("success in percent, 95% interval", fontsize=10)
    save(picture, "iterations")


def memory() -> None:
    """Draw chart E: success against memory gain."""
    rows = read("memory")
    each = rows["memory_gain"].astype(str).str.split()
    rows = rows.assign(gain=each.map(lambda values: np.mean([float(n) for n in values])))
    picture, axes = figure(WIDTH, 7.6, 1, "Success against how much of the past the actions follow", rows=2)
    for axis, task in zip(axes, ("square", "transport"), strict=True):
        for _, row in rows[rows["task"] == task].iterrows():
            label, color, mark = SOURCES[row["source"]]
            face = {"mfc": "none", "mew": 1.5} if color == INK else {"alpha": 0.85}
            axis.plot(row["gain"], row["success"], mark, ms=8, color=color, label=label, **face)
        what = "memory gain (0: past ignored, 1: past copied)"
        finish(axis, f"{task}, 300 demonstrations of six operators", xlabel=what, ylim=(-4, 100))
    picture.supylabel("success in percent", fontsize=10)
    save(picture, "memory")


def noise() -> None:
    """Draw chart F: gains against residual noise, white and correlated."""
    rows = read("noise")
    kept = rows["sigma"] * np.sqrt(rows["correlation"] + (1 - rows["correlation"]) / 8)
    rows = rows.assign(kept=kept)
    six, few = rows["style"] == "mh", rows["seeds"] > 1
    parts = {
        "WP-Past, square, six operators (one seed)": rows[six & ~few & (rows["actions"] == "deltas")],
        "WP-Past, four settings (two or three seeds)": rows[few],
        "WP-Preview, square (one seed)": rows[~few],
    }
    picture, axes = figure(WIDTH, 11, 1, "Success against the noise around the mean, at one step", rows=3)
    for axis, (name, part), warm in zip(axes, parts.items(), (PAST, PAST, PREVIEW), strict=True):
        keys = ["task", "demonstrations", "style", "actions"]
        for k, (setting, group) in enumerate(part.groupby(keys, sort=False)):
            group = group.assign(
                gain=group["success"] - group[group["source"] == GAUSSIAN]["success"].iloc[0]
            )
            group = group[group["source"] == warm].sort_values("kept")
            task = "square, can, stack" if " " in setting[0] else setting[0]
            label = f"{task}, {setting[1]} of {OPERATORS[setting[2]]}, {setting[3]}"
            color = ("#1f77b4", "#d95f02", "#1b9e77", "#984ea3")[k]
            white, common = group[group["correlation"] == 0], group[group["correlation"] > 0]
            axis.plot(white["kept"], white["gain"], "o-", color=color, label=label)
            axis.plot(common["kept"], common["gain"], "s", ms=8, mfc="none", mew=2, color=color)
        axis.plot([], [], "s", ms=8, mfc="none", mew=2, color=INK, label="correlated noise")
        axis.axhline(0, color=SOURCES[GAUSSIAN][1], lw=1.5)
        finish(axis, name, xlabel="noise that averaging over a chunk leaves", xlim=(0, None))
        axis.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False)
    picture.supylabel("success minus the Gaussian source's, in points", fontsize=10)
    picture.savefig(OUT / "noise.svg", **SVG)


def actions() -> None:
    """Draw chart G: deltas and absolute poses."""
    rows = read("actions")
    picture, axes = figure(WIDTH, 6.6, 2, "Deltas and absolute poses, at one step (one seed)", rows=2)
    for axis, (setting, part) in zip(axes, rows.groupby(["task", "style"], sort=False), strict=True):
        for source, group in part.groupby("source", sort=False):
            label, color, mark = SOURCES[source]
            axis.plot(group["actions"], group["success"], mark + "-", color=color, label=label)
        finish(axis, f"{setting[0]}, {OPERATORS[setting[1]]}", ylim=(-3, 103), xlim=(-0.3, 1.3))
    picture.supylabel("success in percent of 50 episodes", fontsize=10)
    save(picture, "actions")


def human_table() -> str:
    """Return score and success on human demonstrations of Push-T in Markdown."""
    rows = read("pusht")
    names = [source for source in SOURCES if source in set(rows["source"])]
    text = ["| demonstrations | steps | " + " | ".join(SOURCES[name][0] for name in names) + " |"]
    text.append("|---" * (2 + len(names)) + "|")
    for (count, nfe), part in rows.groupby(["demonstrations", "nfe"], sort=False):
        part = part.set_index("source")
        cells = []
        for name in names:
            row = part.loc[name]
            pairs = "" if np.isnan(row["won"]) else f", {row['won']:.0f}:{row['lost']:.0f}"
            cells.append(f"{row['score']:.0f} / {row['success']:.0f}{pairs}")
        text.append(f"| {count} | {nfe} | " + " | ".join(cells) + " |")
    return "\n".join(text) + "\n"


def table() -> str:
    """Return success at one step in Markdown."""
    rows = read("means").pivot(index="setting", columns="source", values="success")
    rows = rows.reindex(index=read("means")["setting"].unique(), columns=list(SOURCES)[:5])
    text = [
        "| demonstrations | " + " | ".join(label for label, *_ in list(SOURCES.values())[:5]) + " |",
        "|---" * 6 + "|",
    ]
    for setting, row in rows.iterrows():
        numbers = [
            "" if np.isnan(n) else f"{n + 1e-6:.0f}" if n != row.max() else f"**{n + 1e-6:.0f}**" for n in row
        ]
        text.append(f"| {setting} | " + " | ".join(numbers) + " |")
    return "\n".join(text) + "\n"


def papers_settings() -> DataFrame:
    """Return success in the state settings of the paper's Table 1, a row per training, NFE and source."""
    longest = read_played("square_mh_80000")
    own_noise = (longest["sigma"] == longest["prior"].map(PAPER_DEFAULT_SIGMA)) & (longest["noise"] == 1)
    longest = longest[(longest["options"] == "") & own_noise].rename(columns={"data": "style"})
    keys = ["task", "style", "iterations", "source", "nfe"]
    longest = longest.groupby(keys, as_index=False).agg(
        success=("success_rate", lambda rates: 100 * rates.mean()), seeds=("seed", "nunique")
    )
    steps, longer = read("steps"), read("iterations")
    steps = steps[steps["demonstrations"] >= 150]
    longer = longer[(longer["iterations"] > 10_000) & (longer["weighting"] == "standardised")]
    # The training with more seeds includes those of the one with fewer.
    return concat([steps, longer, longest]).sort_values("seeds").drop_duplicates(keys, keep="last")


def paper_table() -> str:
    """Return the paper's Table 1 and these rows in Markdown: success at NFE 9 / 3 / 1."""

    def line(title: str, place: str, rates: Mapping[tuple[str, int], float]) -> str:
        each = [
            [rates.get((source, nfe), np.nan) for nfe in (9, 3, 1)] for source in (GAUSSIAN, PAST, PREVIEW)
        ]
        texts = [" / ".join("-" if np.isnan(n) else f"{n + 1e-6:.0f}" for n in part) for part in each]
        return f"| {title} | {place} | {' | '.join(texts)} |"

    text = ["| | | Gaussian source | WP-Past | WP-Preview |", "|---|---|---|---|---|"]
    rows = papers_settings()
    for (task, style, observations), paper in PAPER_SUCCESS.items():
        ours = rows[(rows["task"] == task) & (rows["style"] == style)]
        if observations == STATE and len(ours):
            published = {
                (source, nfe): rate for source, rates in paper.items() for nfe, rate in rates.items()
            }
            text.append(line(f"{task} {style}", "the paper", published))
            for iterations, part in ours.groupby("iterations"):
                seeds = {1: "1 seed"}.get(part["seeds"].max(), f"{part['seeds'].max()} seeds")
                rates = dict(zip(zip(part["source"], part["nfe"], strict=True), part["success"], strict=True))
                text.append(line("", f"here, {iterations:,} iterations, {seeds}", rates))
    return "\n".join(text) + "\n"


def tables() -> dict[Path, str]:
    """Return the table of each page."""
    return {PAGE: table(), DOCS / "notes" / "evidence.md": human_table(), DOCS / "paper.md": paper_table()}


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for draw in one_step, steps, demonstrations, iterations, memory, noise, actions:
        draw()
    write(tables())
