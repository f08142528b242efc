"""The stored rows, the names and colours of sources, and the style of charts, for all charts and tables."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from comparisons import estimate
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame, Series, concat, read_json

from lab.methods.methods import METHODS

INK = "#767676"  # text and lines, which a white and a black page show equally well
matplotlib.rcParams |= {"savefig.transparent": True, "grid.color": INK, "grid.alpha": 0.3}
matplotlib.rcParams |= {
    f"{part}color": INK for part in ("text.", "axes.label", "axes.edge", "xtick.", "ytick.")
}
matplotlib.rcParams["svg.hashsalt"] = "warmprior"  # reproducible files
SVG = {"metadata": {"Date": None}}

DOCS = Path(__file__).parents[1]
DATA, OUT = DOCS / "results", DOCS / "_static" / "results"
GAUSSIAN, PAST, PREVIEW = "gaussian", "past", "preview"
CORRELATED = "past,correlation=0.5"
CVAE = "cvae"
L1 = ",l1"  # ends the names of sources that were trained with an L1 loss
_NAMED = {name: (each.label, each.color) for name, each in METHODS.items()}
_NAMED |= {CORRELATED: ("WP-Past, correlated noise", "#1b9e77")}
# Label, colour and marker in charts; tables have columns in this order.
SOURCES = {name: (*_NAMED[name], "o") for name in (GAUSSIAN, PAST, PREVIEW, CORRELATED, *_NAMED)}
SOURCES |= {f"{name}{L1}": (f"{text}, L1 loss", color, "v") for name, (text, color, _) in SOURCES.items()}
SOURCES |= {
    "mip": (*_NAMED["mip"], "s"),
    "mip-past": ("MIP from WP-Past", SOURCES["mip"][1], "D"),
    "mip-past,correlation=0.5": ("MIP from WP-Past, correlated noise", SOURCES["mip"][1], "P"),
}
WIDTH = 5.6  # inches, so that text is readable at 400 pixels


@cache
def read_played(name: str) -> DataFrame:
    """Return the rows of a run, with source, factor of its noise, and the outcome of every episode.

    The source of runs with an L1 loss, whose names end in ``_l1``, says so. All callers share the table.
    """
    rows = read_json(DATA / f"{name}.jsonl", lines=True, dtype={"outcomes": str})
    options = rows["options"].where(rows["options"] == "", "," + rows["options"])
    noise = rows.get("temperature", Series(1.0, rows.index)).fillna(1.0)  # 1 if unnamed
    loss = L1 if name.endswith("_l1") else ""
    rows = rows.assign(source=rows["prior"] + options + loss, noise=noise)
    return rows.assign(solved=[np.array([*map(int, outcomes)]) for outcomes in rows["outcomes"]])


def with_own_noise(rows: DataFrame) -> DataFrame:
    """Return the rows that were played with the noise of each source's training (MIP's is 0)."""
    return rows[rows["noise"] == rows.groupby("source")["noise"].transform("max")]


def read_cells(names: Iterable[str], common_seeds: bool = False) -> DataFrame:
    """Return success at the own noise of each source, a row per run, task, source and NFE.

    Its column ``success`` (percent) is over all seeds, or over those that all runs have; ``seeds`` is their
    number, and ``solved`` has their outcomes, ``[trainings, episodes]``.
    """
    runs = [with_own_noise(read_played(name)).assign(run=name) for name in names]
    rows = concat(runs)
    if common_seeds:
        rows = rows[rows["seed"].isin(set.intersection(*(set(run["seed"]) for run in runs)))]
    keys = ["run", "task", "data", "iterations", "source", "nfe"]
    cells = rows.groupby(keys, as_index=False, sort=False).agg(
        solved=("solved", np.stack), seeds=("seed", "nunique")
    )
    return cells.assign(success=[100 * solved.mean() for solved in cells["solved"]])


@cache
def read_arms(name: str) -> DataFrame:
    """Return the rows of a comparison of agents, with the agent in words and the number of the evaluation.

    Evaluation 0 is that of the frozen policy.
    """
    rows = read_json(DATA / f"{name}.jsonl", lines=True)
    around = np.where(rows["centre"] == "zero", ", around zero", "")
    arm = rows["algorithm"].str.upper() + ", " + rows["prior"].map(lambda prior: SOURCES[prior][0]) + around
    return rows.assign(arm=arm, evaluated=rows.groupby([arm, "seed"]).cumcount())


def at_nine_three_one(rows: DataFrame, source: str) -> str:
    """Return the mean success of a source over cells at NFE 9, 3 and 1, or at the only NFE that it has."""
    rates = rows[rows["source"] == source].groupby("nfe")["success"].mean()
    places = (9, 3, 1) if 1 in rates.index else rates.index
    return "/".join(f"{rates[nfe] + 1e-6:.0f}" for nfe in places)


def figure(width: float, height: float, columns: int, title: str, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a picture with a title, and its axes."""
    picture = Figure(figsize=(width, height), layout="constrained")
    picture.suptitle(title, fontsize=11.5, fontweight="bold")
    return picture, list(picture.subplots(rows, columns, squeeze=False).flat)


def save(picture: Figure, name: str) -> None:
    """Write the picture with one legend below."""
    shown = [pair for axis in picture.axes for pair in zip(*axis.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in reversed(shown)}
    labels = sorted(handles, key=[label for _, label in shown].index)
    lines_shown, tight = [handles[label] for label in labels], {"columnspacing": 1.0, "handlelength": 1.5}
    picture.legend(lines_shown, labels, loc="outside lower center", ncols=2, frameon=False, **tight)
    picture.savefig(OUT / f"{name}.svg", **SVG)


def finish(axis: Axes, title: str, **settings: object) -> None:
    """Set title, labels and a faint grid."""
    axis.set_title(title, fontsize=10.5)
    axis.set(**settings)
    axis.grid(axis="y")


def shown_sources(rows: DataFrame) -> list[str]:
    """Return the sources of some rows, in the order of :data:`SOURCES`."""
    return [source for source in SOURCES if source in set(rows["source"])]


def beside(k: int, count: int) -> float:
    """Return the factor on a logarithmic axis that sets the `k`-th of some marks beside the others."""
    return 1 + 0.03 * (k - (count - 1) / 2)


def lines(axis: Axes, rows: DataFrame, x: str, ticks: list[int]) -> None:
    """Draw the mean success over cells against a column, a line per source, with intervals."""
    for k, source in enumerate(shown := shown_sources(rows)):
        label, color, mark = SOURCES[source]
        solved = rows[rows["source"] == source].groupby(x)["solved"]
        estimates = solved.agg(lambda cells: estimate(cells, alike=rows["solved"]))
        means, *ends = np.array([*estimates]).T
        places = estimates.index.to_numpy(dtype=float) * beside(k, len(shown))
        bars = np.abs(np.array(ends) - means)
        axis.errorbar(places, means, bars, color=color, marker=mark, lw=1.6, elinewidth=1, label=label)
    axis.set(xscale="log", ylim=(-3, 103))
    axis.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axis.minorticks_off()
