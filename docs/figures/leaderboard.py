"""Draw and write the leaderboard: success of methods on human and on scripted demonstrations, by NFE.

The README's table has its means next to those on scripted demonstrations.

PYTHONPATH=benchmarks python docs/figures/leaderboard.py    # or: make results; writes a picture and a table

95% intervals are from a bootstrap over training seeds and episodes. A rank is among all lines of the table,
and its interval is from the same bootstrap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pages import own_best, write
from pandas import DataFrame, concat
from results import GROUPS, TWENTY_FIVE, WARM
from scipy.stats import rankdata
from shared import (
    DOCS,
    GAUSSIAN,
    OUT,
    SOURCES,
    WIDTH,
    at_nine_three_one,
    beside,
    figure,
    finish,
    read_cells,
    read_played,
    save,
    shown_sources,
    with_own_noise,
)

from lab.statistics import resampled_means

PAGE, README = DOCS / "leaderboard.md", DOCS.parent / "README.md"
DOOR = "door, 25"
PUSHT = "pusht"
Sets = Mapping[str, tuple[str, Sequence[str]]]
"""By name of the demonstrations: the task, and the runs that have its rows."""

HUMAN: Sets = {
    name: (task, (run, f"{run}_l1", f"{run}_others"))
    for name, task, run in (
        (DOOR, "adroit-door-human-v0", "door_20000"),
        ("Push-T, 25", PUSHT, "pusht_25"),
        ("Push-T, 50", PUSHT, "pusht_50"),
        ("Push-T, 206", PUSHT, "pusht_206_45000"),
    )
}

SCRIPTED: Sets = {f"{task}, 25": (task, GROUPS[TWENTY_FIVE]) for task in ("square", "can", "stack")}
TITLES = {
    "Human demonstrations: the mean of four sets": HUMAN,
    "25 scripted demonstrations: the mean of three tasks": SCRIPTED,
}


def trials(sets: Sets = HUMAN, own_noise: bool = True) -> DataFrame:
    """Return the rows of all sets, by default at the noise of each source's training (MIP's is 0)."""
    played = {name: concat(map(read_played, runs)) for name, (_, runs) in sets.items()}
    rows = concat([played[name].query("task == @task").assign(set=name) for name, (task, _) in sets.items()])
    return with_own_noise(rows) if own_noise else rows


def pairs(sets: Sets = HUMAN, baseline: str = GAUSSIAN, by: Sequence[str] = ("source", "nfe")) -> DataFrame:
    """Return episodes won and lost against a source, over all sets, or by more columns.

    That source has the same NFE, or, if it was not played with that, its largest.
    """
    rows = trials(sets)
    others, base = rows[rows["source"] != baseline], rows[rows["source"] == baseline]
    base_nfe = others["nfe"].where(others["nfe"].isin(base["nfe"]), base["nfe"].max())
    keys = ["set", "seed"]
    both = others.assign(base_nfe=base_nfe).merge(
        base, left_on=[*keys, "base_nfe"], right_on=[*keys, "nfe"], suffixes=("", "_base")
    )
    for ahead, name in (1, "won"), (-1, "lost"):
        differences = both["solved"] - both["solved_base"]
        both[name] = [(ahead * difference > 0).sum() for difference in differences]
    return both.groupby([*by])[["won", "lost"]].sum().astype(int)


def with_best_noise(sets: Sets = HUMAN) -> dict[tuple[str, int], float]:
    """Return the mean success per method and NFE, each with its best noise, chosen on other episodes."""
    rates: dict[tuple[str, int], list[float]] = {}
    for (_, nfe), part in trials(sets, own_noise=False).groupby(["set", "nfe"]):
        for source, outcomes in own_best(part).items():
            rates.setdefault((source, nfe), []).append(100 * outcomes.mean())
    return {setting: float(np.mean(of)) for setting, of in rates.items() if len(of) == len(sets)}


def standings(sets: Sets = HUMAN) -> DataFrame:
    """Return success per method and NFE in percent, by set and on average, with ranks and intervals.

    Methods with a single seed are left out.
    """
    rng, lines, draws, best = np.random.default_rng(0), [], [], with_best_noise(sets)
    for (source, nfe), part in trials(sets).groupby(["source", "nfe"]):
        by_set = {name: group for name, group in part.groupby("set")}
        if set(by_set) != set(sets) or part["seed"].nunique() == 1:
            continue
        draws.append(
            100 * resampled_means([(g["successes"], g["episodes"].iloc[0]) for g in by_set.values()], rng)
        )
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
            line = "--" if source.endswith(",l1") else "-"
            axis.errorbar(places, part["mean"], bars, color=color, marker=mark, ls=line, lw=1.6, label=label)
        finish(axis, title, xlabel="network evaluations per chunk (NFE)")
        axis.set(xscale="log", ylim=(0, None))
        axis.set_xticks(*2 * [sorted(frame["nfe"].unique())])
        axis.minorticks_off()
    picture.supylabel("solved in percent, 95% interval", fontsize=10)
    save(picture, "leaderboard")


def table(sets: Sets) -> str:
    """Return the standings in Markdown."""
    frame, won_and_lost = standings(sets), pairs(sets)
    names = [name for name in ("mean", "best noise", *sets) if frame[name].notna().any()]
    text = [f"| rank | method | NFE | {' | '.join(names)} | won : lost |"]
    text.append("|---" * (4 + len(names)) + "|")
    for _, row in frame.iterrows():
        place = f"{row['rank']:.0f} ({row['rank_low']:.0f}-{row['rank_high']:.0f})"
        setting = row["source"], row["nfe"]
        pair = won_and_lost.loc[setting] if setting in won_and_lost.index else None
        rates = ["" if np.isnan(row[name]) else f"{row[name] + 1e-6:.0f}" for name in names]
        cells = [place, SOURCES[row["source"]][0], str(row["nfe"]), *rates]
        cells.append("" if pair is None else f"{pair.won}:{pair.lost}")
        text.append(f"| {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def one_seed_table() -> str:
    """Return the mean success of a single training per set in Markdown, of the methods that have only one."""
    rows, won_and_lost = trials().query("seed == 0"), pairs()
    rates = rows.groupby(["source", "nfe", "set"])["success_rate"].mean().groupby(["source", "nfe"])
    means = 100 * rates.mean()[rates.size() == len(HUMAN)]
    text = ["| method | NFE 9 | won : lost | NFE 1 | won : lost |", "|---" * 5 + "|"]
    for source in (GAUSSIAN, *sorted({source for source, _ in means.index} - {*standings()["source"]})):
        cells = []
        for setting in ((source, 9), (source, 1)):
            played, compared = setting in means, setting in won_and_lost.index
            cells.append(f"{means[setting] + 1e-6:.0f}" if played else "")
            cells.append("{won}:{lost}".format(**won_and_lost.loc[setting]) if played and compared else "")
        text.append(f"| {SOURCES[source][0]} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def readme_table() -> str:
    """Return success of four sources on human and scripted demonstrations in Markdown, at NFE 9 / 3 / 1."""
    sources = (GAUSSIAN, *WARM)
    people = standings().assign(success=lambda frame: frame["mean"])
    groups = {"human": people} | {f"scripted, {name}": read_cells(runs) for name, runs in GROUPS.items()}
    text = [f"| demonstrations | {' | '.join(SOURCES[source][0] for source in sources)} |"]
    text.append("|---" * (1 + len(sources)) + "|")
    for name, rows in groups.items():
        text.append(f"| {name} | {' | '.join(at_nine_three_one(rows, source) for source in sources)} |")
    return "\n".join(text) + "\n"


def tables() -> dict[Path, list[str]]:
    """Return the table of each page."""
    return {PAGE: [table(HUMAN), one_seed_table(), table(SCRIPTED)], README: [readme_table()]}


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    draw()
    write(tables())
