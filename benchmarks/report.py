"""Tables of the benchmarks: rows of `results.jsonl` in, Markdown and a short text for a terminal out.

A row is one evaluation of one policy: what was measured (task, prior, seed, nfe, ...), and what came out.
Tables are pivots of a DataFrame of rows. The first method of the rows is the baseline.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from methods import label
from pandas import DataFrame
from paper import PAPER_CURVATURE, paper_success

from warmprior import diagnostics as stats
from warmprior.diagnostics.source_leak import INNER_STEP_BOUND, LEAK_BOUND
from warmprior.io.files import read_lines, write_atomic
from warmprior.io.script import PartialFailure

Cell = Callable[[DataFrame], str | None]  # the text of a cell, from the rows that belong to it

LEAKS = ["source_leak", "inner_step_ratio"]
JUMPS = ["boundary_jump", "inner_jump"]
SPREAD = ["memory_gain", "coverage", "mean_error", "mean_revision_data", "mean_revision"]
RELATIVE = ["kappa", "relative_curvature", "bound", "training_seconds"]  # over the baseline's
COMPARED = ["gain", "better", "won", "lost", "paired"]  # with the baseline
DEFAULT_SIGMA = {"gaussian": 1.0, "past": 0.5, "preview": 1.0}  # the paper's
NAVIGATION = {
    "switches at boundaries": "switch_rate",
    "rollouts on one side": "commit_rate",
    "collisions": "collision_rate",
    "route entropy (bit)": "route_entropy",
    "distance to data": "distance",
    "jump ratio": "jump_ratio",
    "kappa (H)": "kappa_executed",
    "kappa (H) / speed": "relative_executed",
    "collisions, history shifted": "shifted_collision_rate",
    "distance, history shifted": "shifted_distance",
}


# Rows


def read_rows(path: Path) -> DataFrame:
    """The rows of a file of JSON lines, as a table."""
    return DataFrame(read_lines(path))


def text_of(row: Mapping[str, Any], name: str) -> str:
    """A text of a row, empty where it has none."""
    value = row.get(name)
    return value if isinstance(value, str) else ""


def problem_title(row: Mapping[str, Any]) -> str:
    """Task and style, with actions and observations where they are not the usual ones."""
    spaces = ((text_of(row, "actions"), "actions"), (text_of(row, "obs"), "observations"))
    title = f"{row['task'].replace('_', '-').title()}-{row['data'].upper()}"
    return ", ".join([title, *(f"{space} {words}" for space, words in spaces if space)])


def prior_label(row: Mapping[str, Any]) -> str:
    """The method of a row in words, without sigma and H."""
    return label(row["prior"], text_of(row, "options"))


def labelled(rows: DataFrame, chunks: bool = True) -> DataFrame:
    """The rows with their `method` and `problem` in words.

    Sigma and H belong to the name where several occur; H never does with `chunks=False`.
    """
    sigmas = rows.groupby("prior")["sigma"].nunique()
    several = chunks and rows["chunk"].nunique() > 1

    def method(row: Mapping[str, Any]) -> str:
        guided = text_of(row, "guidance") not in ("", "none")
        if guided and row["prior"] == "gaussian":
            return "RTC"
        sigma = f", sigma {row['sigma']:g}" if sigmas[row["prior"]] > 1 else ""
        chunk = f", H {row['chunk']}" if several else ""
        return ("RTC + " if guided else "") + prior_label(row) + sigma + chunk

    records = rows.to_dict("records")
    problems = [problem_title(row) if text_of(row, "task") else "" for row in records]
    return rows.assign(method=[method(row) for row in records], problem=problems)


def last_checkpoints(rows: DataFrame) -> DataFrame:
    """The rows of the last checkpoint of every training."""
    return rows[rows["checkpoint"] == rows["iterations"]]


def pooled(rows: DataFrame) -> DataFrame:
    """Curvatures averaged over the training seeds, or those of the only seed."""
    average = rows["seed"].isna()
    return rows[average if average.any() else rows["seed"] == rows["seed"].min()]


def seed_success(rows: DataFrame, top_k: int) -> stats.SeedSummary:
    """Success over seeds, of each the mean of its best `top_k` checkpoints."""
    rates = rows.groupby("seed", sort=False)["success_rate"]
    return stats.summarize_seeds([stats.top_k_mean(list(seed), top_k) for _, seed in rates])


# The summary


def summary(rows: DataFrame, top_k: int) -> DataFrame:
    """All that is known per problem, method (delay, guidance) and NFE, beside the first method's."""
    rows = labelled(rows[rows["success_rate"].notna()])
    measures = [*LEAKS, *JUMPS, *SPREAD, *RELATIVE]
    rows = rows.reindex(columns=rows.columns.union([*measures, "outcomes"], sort=False))
    rows = rows.astype(dict.fromkeys(measures, float))
    base, records = rows[rows["method"] == rows["method"].iloc[0]], []
    place = [name for name in ("problem", "delay") if name in rows]
    keys = [n for n in ("problem", "method", "delay", "guidance", "nfe") if n in rows]
    facts = [*keys, "task", "data", "prior", "options", "sigma", "chunk"]
    counts = [
        "seed",
        "iterations",
        "checkpoint",
        "episodes",
        "successes",
        "success_rate",
        "execute",
    ]
    # Steps, and what a task of one's own measures of episodes.
    numbers = rows.select_dtypes("number").columns
    own = [name for name in numbers if name not in {*measures, *facts, *counts}]
    for _, mine in rows.groupby(keys, sort=False, dropna=False):
        first = mine.iloc[0]
        theirs = base[(base[place] == first[place]).all(axis=1)]
        beside = theirs[theirs["nfe"] == first["nfe"]]
        record = {name: first.get(name) for name in facts} | _success(mine, top_k) | _paper(first)
        record |= dict.fromkeys(COMPARED, math.nan) | {"one_sigma": False}
        if len(beside) and first["method"] != base["method"].iloc[0]:
            record |= _comparison(mine, beside, top_k)
        # A flow is the same at any NFE, and the baseline may lack this one.
        flow = theirs[theirs["nfe"] == theirs["nfe"].max()]
        last = last_checkpoints(mine)
        record |= _measures(last, last_checkpoints(flow)) | last[own].mean().to_dict()
        records.append(record)
    return DataFrame(records)


def _success(rows: DataFrame, top_k: int) -> dict[str, Any]:
    found, last = seed_success(rows, top_k), last_checkpoints(rows)
    count = rows["checkpoint"].nunique()
    record = {"success": found.mean, "success_std": found.std, "seeds": found.seeds}
    record |= {"checkpoints": count, "averaged": min(top_k, count)}
    won, played = int(last["successes"].sum()), int(last["episodes"].sum())
    low, high = stats.success_posterior(won, played).interval(0.95)
    return record | {"episodes": played, "successes": won, "low": low, "high": high}


def _comparison(mine: DataFrame, theirs: DataFrame, top_k: int) -> dict[str, Any]:
    success, baseline = seed_success(mine, top_k), seed_success(theirs, top_k)
    last = last_checkpoints(mine), last_checkpoints(theirs)
    counts = [int(rows[name].sum()) for rows in last for name in ("successes", "episodes")]
    record: dict[str, Any] = {"gain": success.mean - baseline.mean}
    record["one_sigma"] = stats.exceeds_one_sigma(success, baseline)
    record["better"] = stats.probability_better(*counts)
    # Outcomes of the same training and episode seeds.
    both = last[0].merge(last[1], on="seed")[["outcomes_x", "outcomes_y"]].dropna().to_numpy()
    pairs = [pair for a, b in both if len(a) == len(b) for pair in zip(a, b, strict=True)]
    if pairs:
        won, lost = pairs.count(("1", "0")), pairs.count(("0", "1"))
        record |= {"won": won, "lost": lost, "paired": stats.paired_probability_better(won, lost)}
    return record


def _measures(mine: DataFrame, flow: DataFrame) -> dict[str, float]:
    mean, theirs = mine[[*LEAKS, *JUMPS, *SPREAD, *RELATIVE]].mean(), flow[RELATIVE].mean()
    record = mean[[*LEAKS, "training_seconds", *SPREAD]].to_dict()
    record |= {f"{name}_std": mine[name].std() for name in SPREAD}
    record["jump_ratio"] = mean["boundary_jump"] / (mean["inner_jump"] or math.nan)
    return record | {f"{name}_ratio": mean[name] / (theirs[name] or math.nan) for name in RELATIVE}


def _paper(row: Mapping[str, Any]) -> dict[str, float]:
    """The paper's success and gain, as shares of 1, where it measured the same."""
    other = text_of(row, "options") or text_of(row, "actions") or "delay" in row
    if other or row["sigma"] != DEFAULT_SIGMA.get(row["prior"]):
        return {"paper": math.nan, "paper_gain": math.nan}
    at = row["nfe"], row["chunk"], text_of(row, "obs") or "state"
    found = (paper_success(row["task"], row["data"], p, *at) for p in (row["prior"], "gaussian"))
    value, base = (math.nan if percent is None else percent / 100 for percent in found)
    return {"paper": value, "paper_gain": math.nan if row["prior"] == "gaussian" else value - base}


# Pivots and cells


def cells(rows: DataFrame, index: str, columns: str | None, cell: Mapping[str, Cell]) -> DataFrame:
    """A pivot of texts in the order of the rows; lines without any text are left out.

    It has a line per index and kind of cell, and a column per value of `columns`. Without `columns` it has
    a line per index and a column per kind.
    """
    lines: dict[str, dict[str, str | None]] = {}
    for name, group in rows.groupby(index, sort=False):
        if columns is None:
            lines[name] = {kind: make(group) for kind, make in cell.items()}
            continue
        parts = dict(list(group.groupby(columns, sort=False)))
        for kind, make in cell.items():
            line = ", ".join(filter(None, (name, kind)))
            lines[line] = {column: make(part) for column, part in parts.items()}
    names = list(cell) if columns is None else rows[columns].unique()
    return DataFrame(list(lines.values()), list(lines), names).dropna(how="all")


def markdown(frame: DataFrame, head: str = "", notes: Sequence[str] = ()) -> str:
    """A table of texts in Markdown, with a list of notes below it."""
    lines = [(head, *frame.columns), *frame.fillna("-").itertuples(name=None)]
    text = [f"| {' | '.join(line)} |" for line in lines]
    text.insert(1, "|" + "---|" * len(lines[0]))
    return "\n".join([*text, *([""] if notes else []), *(f"- {note}" for note in notes)]) + "\n"


def mean_cell(measure: str, form: str, scale: float = 1.0) -> Cell:
    """Mean of a measure and, over several seeds, its standard deviation."""

    def cell(rows: DataFrame) -> str | None:
        known = [scale * value for value in rows[measure].dropna()] if measure in rows else []
        lost = f" ({len(rows) - len(known)} not finite)" if len(known) < len(rows) else ""
        return _spread(stats.summarize_seeds(known), form) + lost if known else None

    return cell


def success_cell(top_k: int) -> Cell:
    """Success in percent and, over several seeds, its standard deviation."""
    return lambda rows: _spread(seed_success(rows, top_k), ".1f", 100)


def _spread(found: stats.SeedSummary, form: str, scale: float = 1.0) -> str:
    std = f" ± {scale * found.std:{form}}" if found.seeds > 1 else ""
    return f"{scale * found.mean:{form}}{std}"


def _number(name: str, form: str, bound: float = math.inf) -> Cell:
    """A number of a summary with its deviation over seeds, or with a mark above its bound."""

    def cell(rows: DataFrame) -> str | None:
        row = rows.iloc[0]
        value, std = row[name], row.get(f"{name}_std", math.nan)
        spread = "" if math.isnan(std) else f" ± {std:{form}}"
        mark = " (!)" if value > bound else ""
        return None if math.isnan(value) else f"{value:{form}}{spread}{mark}"

    return cell


def _percent(row: Mapping[str, Any], name: str, gain: str, best: str = "{}") -> str | None:
    """A success of a summary with its gain, the best one as it is shown."""
    if math.isnan(row[name]):
        return None
    text = f"{100 * row[name]:.1f}"
    text = best.format(text) if row["best"] else text
    if math.isnan(row[gain]):
        return text
    return f"{text} ({100 * row[gain]:+z.1f}{'*' if gain == 'gain' and row['one_sigma'] else ''})"


def _count(number: float, word: str) -> str:
    return f"{number:,.0f} {word}{'' if number == 1 else 's'}"


def _beside(rows: DataFrame) -> DataFrame:
    """Rows by NFE, with the `column` of each where methods stand side by side."""
    rows = rows.sort_values("nfe", ascending=False, kind="stable")
    return rows.assign(column="NFE " + rows["nfe"].astype(str) + ": " + rows["method"])


# Reports


def _placed(summary: DataFrame) -> DataFrame:
    """A summary with the `place` where methods compare, and whether one is the `best` there."""
    delay = ", delay " + summary["delay"].astype(str) if "delay" in summary else ""
    summary = summary.assign(place=summary["problem"] + delay)
    best = summary.groupby(["place", "nfe"])["success"].transform("max")
    # Where nothing is solved, nobody is the best.
    return summary.assign(best=(summary["success"] > best - 1e-9) & (best > 0))


def _experiment(summary: DataFrame) -> str:
    most = summary[["seeds", "averaged", "checkpoints"]].max()
    chosen = f"best {most['averaged']} of {most['checkpoints']} checkpoints per seed"
    chunks = ", ".join(map(str, summary["chunk"].unique()))
    episodes = _count((summary["episodes"] / summary["seeds"]).max(), "episode")
    chosen = chosen if most["checkpoints"] > 1 else "last checkpoint"
    return f"H = {chunks}, {_count(most['seeds'], 'seed')} with {episodes} each, {chosen}"


def headline(summary: DataFrame, width: int = 120) -> str:
    """Three lines: the experiment, the best methods, and how sure it is that they beat the baseline.

    Over several problems it averages success and pools episodes.
    """
    base, problems = summary["method"].iloc[0], summary["problem"].unique()
    best, chances = [], []
    for nfe, group in _beside(summary).groupby("nfe", sort=False):
        totals = group.groupby("method", sort=False).agg(
            {"success": "mean", "successes": "sum", "episodes": "sum", "task": "size"}
        )
        totals = totals[totals["task"] == totals["task"].max()]  # what was played everywhere
        others = totals.drop(base, errors="ignore")
        name = others["success"].idxmax() if len(others) else base
        mine = totals.loc[name]
        text = f"{name} {100 * mine['success']:.1f}"
        if name != base and base in totals.index:
            theirs = totals.loc[base]
            gain = 100 * (mine["success"] - theirs["success"])
            text += f" ({gain:+z.1f} over {base})"
            if gain < 1e-9:
                text = f"{base} {100 * theirs['success']:.1f} ({name} {gain:+z.1f})"
            counts = (int(row[k]) for row in (mine, theirs) for k in ("successes", "episodes"))
            chances.append(f"{stats.probability_better(*counts):.2f} for {name} at NFE {nfe}")
        best.append(f"at NFE {nfe} {text}")
    where = ", ".join(problems)
    where = f"{len(problems)} problems ({where})" if len(problems) > 1 else where
    lines = [
        f"{_count(summary['method'].nunique(), 'method')} on {where}: {_experiment(summary)}.",
        f"Best success (%): {'; '.join(best)}.",
        f"Probability of beating {base}: {'; '.join(chances) or 'nothing to compare'}.",
    ]
    return "\n".join(textwrap.shorten(line, width, placeholder=" ...") for line in lines)


def terminal_table(summary: DataFrame, width: int = 120) -> str:
    """The headline, then a line per problem and method with a column per NFE."""
    rows = _placed(summary)
    several = rows["place"].nunique() > 1
    rows["line"] = rows["place"] + ", " + rows["method"] if several else rows["method"]
    rows["column"] = "NFE " + rows["nfe"].astype(str)
    kinds = {"": lambda cell: _percent(cell.iloc[0], "success", "gain", ">{}")}
    frame = cells(rows.sort_values("nfe", ascending=False, kind="stable"), "line", "column", kinds)
    lines = [line for _, part in rows.groupby("place", sort=False) for line in part["line"].unique()]
    frame = frame.loc[lines].fillna("-")
    frame.index = [textwrap.shorten(n, width * 2 // 3, placeholder=" ...") for n in frame.index]
    base = rows["method"].iloc[0]
    legend = f"Success (%), gain over {base}. >: the best. *: above both deviations over seeds."
    return "\n".join([headline(summary, width), "", frame.to_string(line_width=width), "", legend])


def success_report(summary: DataFrame, notes: Sequence[str] = (), source: str | None = None) -> str:
    """Table 1 in the paper's layout, with its numbers, and what the sources do to the flow.

    `source` names the demonstrations: `official` ones are those of the paper.
    """
    rows, base = _placed(summary), summary["method"].iloc[0]

    def paired(cell: DataFrame) -> str | None:
        row = cell.iloc[0]
        if math.isnan(row["won"]):
            return None
        return f"{row['won']:.0f} : {row['lost']:.0f} ({row['paired']:.2f})"

    measured = "measured" + (f" ({source} data)" if source else "")
    spread = f"spread over draws of the source / data's (bound {LEAK_BOUND:g})"
    steps = f"step inside chunks / data's (bound {INNER_STEP_BOUND:g})"
    kinds = {
        measured: lambda cell: _percent(cell.iloc[0], "success", "gain", "**{}**"),
        f"probability of being better than {base}": _number("better", ".2f"),
        f"episodes that only it : only {base} solves (probability)": paired,
        "paper (official data)": lambda cell: _percent(cell.iloc[0], "paper", "paper_gain"),
        spread: _number("source_leak", ".2f", LEAK_BOUND),
        steps: _number("inner_step_ratio", ".2f", INNER_STEP_BOUND),
        "memory gain (0: ignores what it did, 1: repeats it)": _number("memory_gain", "z.3f"),
        "jump between chunks / step inside": _number("jump_ratio", ".2f"),
    }
    notes = [*_success_notes(rows, base, source), *notes]
    text = markdown(cells(_beside(rows), "place", "column", kinds), "Success rate (%)", notes)
    relative = _number("relative_curvature_ratio", ".2f")
    kinds = {
        f"curvature / {base}'s": _number("kappa_ratio", ".2f"),
        f"curvature per squared mean velocity / {base}'s": relative,
        f"bound of the branching cost / {base}'s": _number("bound_ratio", ".2f"),
        "actions inside the source's 90% interval": _number("coverage", ".2f"),
        f"training time / {base}'s": _number("training_seconds_ratio", ".2f"),
        "mean to demonstrated action": _number("mean_error", ".3f"),
        "mean to prediction, demonstrated states": _number("mean_revision_data", ".3f"),
        "mean to prediction, rollouts": _number("mean_revision", ".3f"),
    }
    largest = rows.loc[rows.groupby(["place", "method"], sort=False)["nfe"].idxmax()]
    flow = cells(largest, "place", "method", kinds)
    note = (
        "At the largest NFE, on observations of the training data, with the mean that decisions meet. "
        "Distances are root mean squares over the warm positions of the mean, in normalised action units."
    )
    below = markdown(flow, "Flow of the executed positions", [note])
    return text if flow.empty else f"{text}\n{below}"


def _success_notes(rows: DataFrame, base: str, source: str | None) -> list[str]:
    rule = "`*` marks a gain above the sum of both standard deviations over seeds (the paper's rule)."
    if rows["seeds"].max() == 1:
        rule = "One seed has no spread: we mark no gain. success.png shows the episodes' posterior."
    leak = (
        "Spread and step show how much of the source's noise reaches the actions (last checkpoints, training "
        "data). Up to the bound we see none; `(!)` marks what is above it. That says more about the training "
        "of the network than about the source."
    )
    memory = (
        "Memory gain: we shift what the policy did or forecast before. This share of the shift reappears in "
        "its actions (last checkpoints, training data). Memory helps where it knows more than the "
        "observation. It also carries on the policy's own errors."
    )
    probability = (
        f"Probability: of a higher success rate than {base}'s, given the episodes of all seeds' last "
        "checkpoints (Beta posteriors, uniform prior, episodes taken as independent). The line below it "
        "compares episodes of the same training and episode seeds; its probability is that of winning an "
        "episode which only one of the two solves."
    )
    others = (
        "The paper used the official human demonstrations, and we used others. Compare gains within a row, "
        "not numbers across rows."
    )
    return [
        f"{_experiment(rows)}. In parentheses: the gain over {base} in points. Bold: the best of each group.",
        rule,
        *([leak] if rows[LEAKS].notna().any(axis=None) else []),
        *([memory] if rows["memory_gain"].notna().any() else []),
        *([probability] if rows["prior"].nunique() > 1 else []),
        *([others] if source not in ("official", None) else []),
    ]


def write_report(
    out: Path, short: str, full: str, frame: DataFrame | None = None, failures: Sequence[str] = ()
) -> None:
    """Write `report.md` and `results.csv`, and print the short text; then fail if anything is missing."""
    listed = "".join(f"- {failure}\n" for failure in failures)
    missing = f"\nMissing:\n\n{listed}" if failures else ""
    full = f"{full.rstrip()}\n{missing}"
    write_atomic(out / "report.md", lambda path: path.write_text(full, encoding="utf-8"))
    if frame is not None:
        write_atomic(out / "results.csv", lambda path: frame.to_csv(path, index=False))
    files = "report.md" if frame is None else "report.md, results.csv"
    print(f"\n{short.rstrip()}\n{missing}\nRows, {files} and pictures: {out}", flush=True)
    if failures:
        raise PartialFailure(f"{len(failures)} failed (--resume tries again): {'; '.join(failures)}")


# Tables of the studies


def sigma_table(rows: DataFrame, curvatures: DataFrame, top_k: int) -> str:
    """Success, curvature and branching bound of every source and sigma."""
    measured = [pooled(part) for _, part in curvatures.groupby("mean")]
    rows = pd.concat([rows, *measured])
    names = [f"{prior_label(row)}, sigma {row['sigma']:g}" for row in rows.to_dict("records")]
    curvature, bound = mean_cell("ratio_executed", ".3f"), mean_cell("bound_executed", ".2f")

    def at(mean: str, make: Cell) -> Cell:
        def cell(rows: DataFrame) -> str | None:
            found = rows[rows["mean"] == mean]
            # A policy without a mean is the same at both.
            return make(found if len(found) else rows[rows["mean"] == "training"])

        return cell

    kinds = {
        "success (%)": lambda rows: success_cell(top_k)(rows[rows["success_rate"].notna()]),
        "curvature, training mean": at("training", curvature),
        "deployed mean": at("deployed", curvature),
        "per squared mean velocity": at("training", mean_cell("ratio_relative", ".3f")),
        "bound, training mean": at("training", bound),
        "bound, deployed mean": at("deployed", bound),
    }
    note = (
        "Curvature (relative to the first source) and bound (in squared normalised action units) of the "
        "executed positions. -: the policy predicts no motion."
    )
    return markdown(cells(rows.assign(line=names), "line", None, kinds), "source", [note])


def chunk_table(rows: DataFrame, top_k: int) -> str:
    """Success and jumps at chunk boundaries for every chunk length."""
    rows = _beside(labelled(rows, chunks=False)).sort_values("chunk", kind="stable")
    rows["line"] = "H = " + rows["chunk"].astype(str)
    jump = mean_cell("boundary_jump", ".3f")
    kinds = {"success (%)": success_cell(top_k)}
    kinds["jump at boundaries"] = lambda rows: jump(last_checkpoints(rows))
    note = (
        "Jump: mean distance between the last action of a chunk and the first of the next one, in "
        "normalised action units, of the last checkpoints."
    )
    return markdown(cells(rows, "line", "column", kinds), "", [note])


def budget_table(rows: DataFrame, top_k: int) -> str:
    """Success and held-out error for every number of iterations."""
    rows = _beside(labelled(rows)).sort_values("iterations", kind="stable")
    rows["line"], success = rows["iterations"].astype(str), success_cell(top_k)
    kinds = {"": lambda rows: f"{success(rows)} ({rows['action_error'].mean():.4f})"}
    note = (
        "Success in percent. In parentheses: the mean squared error of the executed actions on held-out "
        "demonstrations, given the mean of the training, in squared normalised action units. The error "
        "favours the average of all good actions. So it grows with NFE where the data leave a choice."
    )
    return markdown(cells(rows, "line", "column", kinds), "iterations", [note])


def curvature_table(rows: DataFrame, facts: Mapping[str, Any], source: str) -> str:
    """Table 2 in the paper's layout, with its numbers; `facts` are of the task, `source` of the data."""
    chosen = labelled(pooled(rows)).assign(line=problem_title(facts))
    first = chosen.iloc[0]

    def ratio(name: str, mean: str) -> Cell:
        def cell(rows: DataFrame) -> str | None:
            # A policy without a mean is the same at both.
            row = rows.iloc[(rows["mean"] == mean).argmax()]
            value, low, high = (row[name + end] for end in ("", "_low", "_high"))
            if pd.isna(value):
                return "no motion"
            plain = row["policy"] == first["policy"] or pd.isna(low)
            return f"{value:.3f}" + ("" if plain else f" [{low:.3f}, {high:.3f}]")

        return cell

    known = PAPER_CURVATURE.get((facts["task"], facts["data"]), {}) | {"gaussian": 1.0}
    same = first["prior"] == "gaussian" and first["chunk"] == 8 and not text_of(facts, "obs")

    def paper(rows: DataFrame) -> str | None:
        value = known.get(rows["prior"].iloc[0])
        return f"{value:.3f}" if same and len(known) > 1 and value is not None else None

    words = {
        "ratio": "whole prediction",
        "ratio_executed": "executed H",
        "ratio_relative": "executed H, per squared mean velocity",
        "ratio_one_step": "error of one Euler step, executed H",
    }
    means = [mean for mean in ("training", "deployed") if mean in set(chosen["mean"])]
    kinds = {f"{words[name]}, {mean} mean": ratio(name, mean) for name in words for mean in means}
    seeds = rows["seed"].nunique()
    averaged = f"averaged over {seeds} training seeds" if seeds > 1 else "one seed"
    notes = [
        f"{_count(first['observations'], 'observation')} of {source}, {averaged}. In brackets: 95% "
        "bootstrap intervals over episodes.",
        "Deployed mean: from the policy's own prediction one decision earlier. The paper says neither which "
        "mean it uses, nor whether it counts a prediction of 2H whole.",
        "Curvature shrinks with the length of the transport. Divided by the squared mean velocity, it does "
        "not.",
    ]
    frame = cells(chosen, "line", "method", kinds | {"paper (official data)": paper})
    return markdown(frame, "curvature relative to the first column", notes)


def navigation_table(rows: DataFrame, curvatures: DataFrame, notes: Sequence[str] = ()) -> str:
    """What the policies of the toy do at every NFE; the curvature of a flow stands at the largest."""
    curved = curvatures[curvatures["mean"] == "training"].assign(nfe=rows["nfe"].max())
    both = labelled(pd.concat([rows, curved]))
    both["line"] = both["method"] + ", NFE " + both["nfe"].astype(str)

    def cell(measure: str) -> Cell:
        of_flow = measure in curvatures
        return lambda rows: mean_cell(measure, ".3f")(rows[rows["mean"].notna() == of_flow])

    kinds = {name: cell(measure) for name, measure in NAVIGATION.items()}
    return markdown(cells(both, "line", None, kinds), "policy", notes)


def delay_table(rows: DataFrame, top_k: int, guidance: str = "") -> str:
    """Success and jumps at every delay; `guidance` describes Real-Time Chunking's options."""
    order = [True, True, False, True]
    rows = labelled(rows).sort_values(["task", "data", "nfe", "delay"], ascending=order)
    nfe, delay = rows["nfe"].astype(str), rows["delay"].astype(str)
    rows["line"] = rows["task"] + " " + rows["data"] + ", NFE " + nfe + ", delay " + delay
    jump, inner = (mean_cell(name, ".3f") for name in JUMPS)
    kinds = {"success (%)": success_cell(top_k), "jump": lambda rows: jump(last_checkpoints(rows))}
    kinds["step inside"] = lambda rows: inner(last_checkpoints(rows))
    first, seeds = rows.iloc[0], _count(rows["seed"].nunique(), "seed")
    notes = [
        f"H = {first['chunk']}; {_count(first['execute'], 'action')} per decision at every delay; delays "
        f"count control steps; {seeds} with {_count(first['episodes'], 'episode')} each.",
        "Jump: mean distance between consecutive actions where a chunk takes effect. Step inside: the same "
        "elsewhere. Both in normalised action units, of the last checkpoints.",
    ]
    if guidance:
        own = "Without a sigma there, its weight is that of the source's own width."
        notes.append(f"RTC: {guidance}. {own}")
    return markdown(cells(rows, "line", "method", kinds), "", notes)


def agents(rows: DataFrame) -> DataFrame:
    """The rows of reinforcement learning with their `agent` in words."""
    names = [f"{row['algorithm'].upper()}, {prior_label(row)}" for row in rows.to_dict("records")]
    seeds = rows.groupby(names)["seed"].transform("nunique")
    counts = [f" ({_count(number, 'seed')})" for number in seeds]
    return rows.assign(agent=[name + count for name, count in zip(names, counts, strict=True)])


def agent_table(rows: DataFrame) -> str:
    """Success of the frozen policies, and of the agents at their last evaluations."""

    def last(kind: str) -> Cell:
        percent = mean_cell("success_rate", ".1f", 100)
        return lambda rows: percent(rows[rows["evaluation"] == kind].groupby("seed").tail(1))

    kinds: dict[str, Cell] = {
        "delta": lambda rows: f"{rows['delta'].iloc[0]:g}",
        "control steps": lambda rows: str(rows["environment_steps"].max()),
        "frozen policy (%)": last("base"),
        "greedy agent (%)": last("greedy"),
        "stochastic agent (%)": last("stochastic"),
    }
    return markdown(cells(agents(rows), "agent", None, kinds), "agent")
