"""Draw and write the leaderboard: success of methods on human demonstrations, by NFE.

The README's table has its means next to those on scripted demonstrations.

PYTHONPATH=benchmarks python docs/figures/leaderboard.py    # or: make results; writes a picture and a table

95% intervals are from a bootstrap over training seeds and episodes. A rank is among all lines of the table,
and its interval is from the same bootstrap.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pages import write
from pandas import DataFrame, concat
from scipy.stats import rankdata
from shared import (
    CORRELATED,
    DOCS,
    GAUSSIAN,
    OUT,
    PAST,
    PREVIEW,
    SOURCES,
    WIDTH,
    beside,
    figure,
    finish,
    read,
    read_played,
    save,
    shown_sources,
)

from lab.statistics import resampled_means

PAGE, README = DOCS / "leaderboard.md", DOCS.parent / "README.md"
DOOR, FEWEST = "door, 25", "Push-T, 25"
FAMILIES = {  # human demonstrations and their number, and the rows of their runs
    DOOR: "door_20000",
    FEWEST: "pusht_25",
    "Push-T, 50": "pusht_50",
    "Push-T, 206": "pusht_206_45000",
}


def _played(family: str) -> DataFrame:
    """Return the rows of a family's runs at the noise that the source was trained with; MIP's is 0."""
    rows = read_played(FAMILIES[family]).assign(family=family)
    return rows[rows["noise"] == rows.groupby("source")["noise"].transform("max")]


def _fewest() -> DataFrame:
    """Return the recorded rows of Push-T with 25, whose trainings have no rows of their own yet."""
    rows = read("pusht")
    return rows[rows["demonstrations"] == 25]


def pairs() -> DataFrame:
    """Return episodes won and lost against the Gaussian source at the same NFE, over all families."""
    rows = concat([_played(family) for family in FAMILIES if family != FEWEST])
    base = rows[rows["source"] == GAUSSIAN]
    both = rows.merge(base, on=["family", "seed", "nfe"], suffixes=("", "_base"))
    for ahead, name in (1, "won"), (-1, "lost"):
        differences = both["solved"] - both["solved_base"]
        both[name] = [(ahead * difference > 0).sum() for difference in differences]
    counts = concat([_fewest().dropna(subset=["won"]), both[both["source"] != GAUSSIAN]])
    return counts.groupby(["source", "nfe"])[["won", "lost"]].sum().astype(int)


def trials() -> DataFrame:
    """Return the episodes that each training solved at the source's own noise, a row per seed and NFE."""
    pusht = _fewest()
    pusht = pusht.assign(family=FEWEST, rate=pusht["seed_success"].str.split()).explode("rate")
    pusht["successes"] = (pusht["rate"].astype(float) * pusht["episodes"] / 100).round().astype(int)
    pusht["seed"] = pusht.groupby(["family", "source", "nfe"]).cumcount()
    rows = concat([pusht, *map(_played, FAMILIES)])
    # The first seed of Push-T with 25 was trained twice, to compare versions.
    return rows.drop_duplicates(["family", "source", "nfe", "seed"])


def standings() -> DataFrame:
    """Return success per method and NFE in percent, by family and on average, with ranks and intervals."""
    rng, lines, draws = np.random.default_rng(0), [], []
    for (source, nfe), part in trials().groupby(["source", "nfe"]):
        families = {name: group for name, group in part.groupby("family")}
        if set(families) != set(FAMILIES):
            continue
        draws.append(
            100 * resampled_means([(g["successes"], g["episodes"].iloc[0]) for g in families.values()], rng)
        )
        rates = {name: 100 * g["successes"].sum() / g["episodes"].sum() for name, g in families.items()}
        lines.append({"source": source, "nfe": nfe, "mean": np.mean(list(rates.values())), **rates})
        lines[-1]["runs"] = len(part)
    frame, draws = DataFrame(lines), np.stack(draws)
    ends = {"mean": draws, "rank": rankdata(-draws, axis=0)}
    frame["rank"] = rankdata(-frame["mean"], "min")
    for name, values in ends.items():
        frame[f"{name}_low"], frame[f"{name}_high"] = np.percentile(values, (2.5, 97.5), axis=1)
    return frame.sort_values("mean", ascending=False, kind="stable")


def draw() -> None:
    """Draw the mean over families against the number of network evaluations."""
    frame = standings()
    picture, (axis,) = figure(WIDTH, 4.6, 1, "Human demonstrations: the mean of four sets")
    for k, source in enumerate(shown := shown_sources(frame)):
        label, color, mark = SOURCES[source]
        part = frame[frame["source"] == source].sort_values("nfe")
        bars = np.abs(part[["mean_low", "mean_high"]].to_numpy().T - part["mean"].to_numpy())
        places = part["nfe"] * beside(k, len(shown))
        axis.errorbar(places, part["mean"], bars, color=color, marker=mark, lw=1.6, label=label)
    finish(axis, "", xlabel="network evaluations per chunk (NFE)", ylabel="solved in percent, 95% interval")
    axis.set(xscale="log", ylim=(0, None))
    axis.set_xticks(*2 * [sorted(frame["nfe"].unique())])
    axis.minorticks_off()
    save(picture, "leaderboard")


def table() -> str:
    """Return the standings in Markdown."""
    names, won_and_lost = ("mean", *FAMILIES), pairs()
    text = [f"| rank | method | NFE | {' | '.join(names)} | won : lost | runs |"]
    text.append("|---" * (5 + len(names)) + "|")
    for _, row in standings().iterrows():
        place = f"{row['rank']:.0f} ({row['rank_low']:.0f} to {row['rank_high']:.0f})"
        setting = row["source"], row["nfe"]
        pair = won_and_lost.loc[setting] if setting in won_and_lost.index else None
        rates = [f"{row[name] + 1e-6:.0f}" for name in names]
        cells = [place, SOURCES[row["source"]][0], str(row["nfe"]), *rates]
        text.append(
            f"| {' | '.join(cells)} | {'' if pair is None else f'{pair.won} : {pair.lost}'} | {row['runs']} |"
        )
    return "\n".join(text) + "\n"


SHORT = {  # names in the README for settings of docs/results/means.csv
    "10: square, can and stack": "scripted, 10",
    "25: square, can and stack": "scripted, 25",
    "150 or 300: all eight settings": "scripted, 150 or 300",
}


def readme_table() -> str:
    """Return success of four sources on human and scripted demonstrations in Markdown."""
    sources = (GAUSSIAN, PAST, PREVIEW, CORRELATED)
    people = standings().assign(name="human", success=lambda frame: frame["mean"])
    scripted = read("means").assign(name=lambda frame: frame["setting"].map(SHORT))
    text = [f"| demonstrations | NFE | {' | '.join(SOURCES[source][0] for source in sources)} |"]
    text.append("|---" * (2 + len(sources)) + "|")
    for name in ("human", *SHORT.values()):
        rows = (people if name == "human" else scripted).query("name == @name")
        for nfe in (9, 3, 1):
            rates = rows[rows["nfe"] == nfe].set_index("source")["success"].reindex(sources)
            if rates.notna().any():
                rounded = (rates + 1e-6).round()
                cells = [f"**{n:.0f}**" if n == rounded.max() else f"{n:.0f}" for n in rounded]
                text.append(f"| {name} | {nfe} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def tables() -> dict[Path, str]:
    """Return the table of each page."""
    return {PAGE: table(), README: readme_table()}


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    draw()
    write(tables())
