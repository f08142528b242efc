"""Draw and write the leaderboard: success of methods on human and on scripted demonstrations, by NFE.

PYTHONPATH=benchmarks python docs/figures/leaderboard.py    # or: make results; writes a picture and a table

95% intervals count trainings, as in results.py. A rank is among all lines of the table, and its interval is
from draws of all means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from comparisons import Comparison, compare
from pandas import DataFrame, concat
from results import CHOICES, GROUPS, TWENTY_FIVE, all_lengths, paper_table
from scipy.stats import rankdata
from scipy.stats import t as student_t
from shared import (
    DOCS,
    GAUSSIAN,
    L1,
    OUT,
    PAST,
    PREVIEW,
    SOURCES,
    WIDTH,
    beside,
    figure,
    finish,
    read_played,
    save,
    shown_sources,
    with_own_noise,
)
from tables import own_best, write

from lab.measures.statistics import interval, spread_of
from lab.reporting.paper import PAPER_SUCCESS

PAGE = DOCS / "leaderboard.md"
DOOR = "door, 25"
PUSHT = "pusht"
DRAWS = 2_000  # of the means, for the intervals of ranks


class Sets(dict[str, tuple[str, Sequence[str]]]):
    """By name of the demonstrations: the task, and the runs that have its rows."""

    __hash__ = object.__hash__  # nobody changes them, so what follows from their rows is computed once


HUMAN = Sets(
    (name, (task, (run, f"{run}_l1", f"{run}_others")))
    for name, task, run in (
        (DOOR, "adroit-door-human-v0", "door_20000"),
        ("Push-T, 25", PUSHT, "pusht_25"),
        ("Push-T, 50", PUSHT, "pusht_50"),
        ("Push-T, 206", PUSHT, "pusht_206_45000"),
    )
)
LEARNED_L1 = Sets((name, (task, (f"{runs[0]}_learned_l1",))) for name, (task, runs) in HUMAN.items())
"""The same demonstrations, all sources with an L1 loss."""

ONE_STEP = Sets(
    (name, (task, (run,)))
    for (name, (task, _)), run in zip(
        HUMAN.items(),
        ("one_step_door", "one_step_pusht_25", "one_step_pusht_50", "one_step_pusht_206"),
        strict=True,
    )
)
"""The same demonstrations, policies that see one observation."""

SCRIPTED = Sets((f"{task}, 25", (task, GROUPS[TWENTY_FIVE])) for task in ("square", "can", "stack"))
TITLES = {
    "Human demonstrations: the mean of four sets": HUMAN,
    "25 scripted demonstrations: the mean of three tasks": SCRIPTED,
}


@cache
def trials(sets: Sets = HUMAN, own_noise: bool = True) -> DataFrame:
    """Return the rows of all sets, by default at the noise of each source's training (MIP's is 0)."""
    played = {name: concat(map(read_played, runs)) for name, (_, runs) in sets.items()}
    rows = concat([played[name].query("task == @task").assign(set=name) for name, (task, _) in sets.items()])
    return with_own_noise(rows) if own_noise else rows


@cache
def beside_source(
    source: str, nfe: int, baseline: str = GAUSSIAN, sets: Sets = HUMAN, own_noise: bool = True
) -> Comparison:
    """Return a source beside another over all sets, training by training.

    The other has the same NFE, or, if it was not played with that, its largest. Without `own_noise` each has
    its best noise per set, chosen on other episodes.
    """
    rows = trials(sets, own_noise)
    of_baseline = rows[rows["source"] == baseline]["nfe"]
    base_nfe = nfe if nfe in set(of_baseline) else of_baseline.max()
    cells = []
    for _, part in rows.groupby("set"):
        one, two = (
            part[(part["source"] == name) & (part["nfe"] == n)]
            for name, n in ((source, nfe), (baseline, base_nfe))
        )
        seeds = sorted({*one["seed"]} & {*two["seed"]})
        if own_noise:
            cells.append([np.stack([*each.set_index("seed").loc[seeds, "solved"]]) for each in (one, two)])
        else:
            best = own_best(part[(part["nfe"] == nfe) & part["source"].isin((source, baseline))])
            cells.append([best[name].reshape(len(seeds), -1) for name in (source, baseline)])
    return compare(*zip(*cells, strict=True))


@cache
def with_best_noise(sets: Sets = HUMAN) -> dict[tuple[str, int], float]:
    """Return the mean success per method and NFE, each with its best noise, chosen on other episodes."""
    rates: dict[tuple[str, int], list[float]] = {}
    for (_, nfe), part in trials(sets, own_noise=False).groupby(["set", "nfe"]):
        for source, outcomes in own_best(part).items():
            rates.setdefault((source, nfe), []).append(100 * outcomes.mean())
    return {setting: float(np.mean(of)) for setting, of in rates.items() if len(of) == len(sets)}


@cache
def standings(sets: Sets = HUMAN) -> DataFrame:
    """Return success per method and NFE in percent, by set and on average, with ranks and intervals.

    Methods with a single seed are left out.
    """
    rng, lines, draws, best = np.random.default_rng(0), [], [], with_best_noise(sets)
    rows = trials(sets)
    shared_starts = "first_episode" not in rows or bool(rows["first_episode"].isna().any())
    for (source, nfe), part in rows.groupby(["source", "nfe"]):
        by_set = {name: group for name, group in part.groupby("set")}
        if set(by_set) != set(sets) or part["seed"].nunique() == 1:
            continue
        cells = [np.stack(list(group["solved"])) for group in by_set.values()]
        spread = spread_of(cells, shared_starts)
        low, high = (100 * end for end in interval(cells, spread, 0.95))
        half_width = student_t.ppf(0.975, spread.freedom)
        draws.append((low + high) / 2 + (high - low) / 2 / half_width * rng.standard_t(spread.freedom, DRAWS))
        rates = {name: 100 * g["successes"].sum() / g["episodes"].sum() for name, g in by_set.items()}
        mean, at_best = np.mean(list(rates.values())), best.get((source, nfe), np.nan)
        lines.append({"source": source, "nfe": nfe, "mean": mean, "best noise": at_best, **rates})
    frame, draws = DataFrame(lines), np.stack(draws)
    ends = {"mean": draws, "rank": rankdata(-draws, axis=0)}
    frame["rank"] = rankdata(-frame["mean"], "min")
    for name, values in ends.items():
        frame[f"{name}_low"], frame[f"{name}_high"] = np.percentile(values, (2.5, 97.5), axis=1)
    return frame.sort_values("mean", ascending=False, kind="stable")


def draw() -> None:
    """Draw the mean over sets against the number of network evaluations."""
    picture, axes = figure(WIDTH, 8.6, 1, "Success of methods", rows=len(TITLES))
    for axis, (title, sets) in zip(axes, TITLES.items(), strict=True):
        frame = standings(sets)
        for k, source in enumerate(shown := shown_sources(frame)):
            label, color, mark = SOURCES[source]
            part = frame[frame["source"] == source].sort_values("nfe")
            bars = np.abs(part[["mean_low", "mean_high"]].to_numpy().T - part["mean"].to_numpy())
            places = part["nfe"] * beside(k, len(shown))
            line = "--" if source.endswith(L1) else "-"
            axis.errorbar(places, part["mean"], bars, color=color, marker=mark, ls=line, lw=1.6, label=label)
        finish(axis, title, xlabel="network evaluations per chunk (NFE)")
        axis.set(xscale="log", ylim=(0, None))
        axis.set_xticks(*2 * [sorted(frame["nfe"].unique())])
        axis.minorticks_off()
    picture.supylabel("solved in percent, 95% interval", fontsize=10)
    save(picture, "leaderboard")


def table(sets: Sets) -> str:
    """Return the standings in Markdown."""
    frame = standings(sets)
    names = [name for name in ("mean", "best noise", *sets) if frame[name].notna().any()]
    text = [f"| rank | method | NFE | {' | '.join(names)} | ahead:behind |"]
    text.append("|---" * (4 + len(names)) + "|")
    for _, row in frame.iterrows():
        place = f"{row['rank']:.0f} ({row['rank_low']:.0f}-{row['rank_high']:.0f})"
        pair = "" if row["source"] == GAUSSIAN else str(beside_source(row["source"], row["nfe"], sets=sets))
        rates = ["" if np.isnan(row[name]) else f"{row[name] + 1e-6:.0f}" for name in names]
        cells = [place, SOURCES[row["source"]][0], str(row["nfe"]), *rates, pair]
        text.append(f"| {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def short_table(sets: Sets) -> str:
    """Return a line per method in Markdown: its mean at NFE 9, or at its largest, and at NFE 1."""
    means = standings(sets).set_index(["source", "nfe"])["mean"]
    most = {source: max(n for s, n in means.index if s == source) for source, _ in means.index}
    rates = {source: means[source, nfe] for source, nfe in most.items()}
    return _lines_of(sorted(most, key=lambda source: -rates[source]), means.to_dict(), most, sets)


def one_seed_table() -> str:
    """Return the mean success of a single training per set in Markdown, of the methods that have only one."""
    rows = trials().query("seed == 0")
    rates = rows.groupby(["source", "nfe", "set"])["success_rate"].mean().groupby(["source", "nfe"])
    means = 100 * rates.mean()[rates.size() == len(HUMAN)]
    sources = [GAUSSIAN, *sorted({source for source, _ in means.index} - {*standings()["source"]})]
    return _lines_of(sources, means.to_dict(), dict.fromkeys(sources, 9), HUMAN)


def _lines_of(
    sources: Sequence[str], means: Mapping[tuple[str, int], float], most: Mapping[str, int], sets: Sets
) -> str:
    text = ["| method | NFE 9 | ahead:behind | NFE 1 | ahead:behind |", "|---" * 5 + "|"]
    for source in sources:
        cells = []
        for setting in ((source, most[source]), (source, 1)):
            played = setting in means
            other = f" (NFE {setting[1]})" if setting[1] not in (9, 1) else ""
            cells.append(f"{means[setting] + 1e-6:.0f}{other}" if played else "")
            cells.append(str(beside_source(*setting, sets=sets)) if played and source != GAUSSIAN else "")
        text.append(f"| {SOURCES[source][0]} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def paper_gain(source: str, nfe: int) -> float:
    """Return how many points a source is ahead in the paper, on the mean of its thirteen cells."""
    return float(np.mean([cell[source][nfe] - cell[GAUSSIAN][nfe] for cell in PAPER_SUCCESS.values()]))


def effect_table() -> str:
    """Return the mean gain of warm sources in Markdown: the paper's, and ours with intervals."""
    text = ["| | NFE | the paper, 13 cells | human demonstrations | long training, seven sets |"]
    text.append("|---" * 5 + "|")
    for source in (PAST, PREVIEW):
        longer = all_lengths(source, CHOICES["long training"])
        for nfe, long in zip((9, 3, 1), longer, strict=True):
            human = beside_source(source, nfe)
            paper = f"{paper_gain(source, nfe):+.1f}"
            text.append(f"| {SOURCES[source][0]} | {nfe} | {paper} | {human.points} | {long.points} |")
    return "\n".join(text) + "\n"


def tables() -> dict[Path, list[str]]:
    """Return the tables of each page."""
    return {
        PAGE: [short_table(HUMAN), short_table(ONE_STEP), short_table(SCRIPTED)],
        DOCS / "notes" / "leaderboard.md": [
            table(HUMAN),
            one_seed_table(),
            table(ONE_STEP),
            table(SCRIPTED),
        ],
        DOCS / "paper.md": [effect_table()],
        DOCS / "notes" / "paper_readings.md": [paper_table()],
    }


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    draw()
    write(tables())
