"""Tables of the benchmarks: rows of `results.jsonl` in, Markdown and a short text for a terminal out.

A row is one evaluation of one policy: what was measured (task, prior, seed, nfe, ...), and what came out.
Its columns, and those of all tables, are defined in `columns.py`. The first method is the baseline.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame, Series

from lab.columns import COLUMNS, IDENTITY, column
from lab.files import PartialFailure
from lab.methods import label
from lab.options import Options, with_parts
from lab.paper import paper_success
from lab.presets import IMAGES
from lab.rows import read_rows
from lab.statistics import paired_probability_better, probability_better
from warmprior.diagnostics import success_posterior
from warmprior.diagnostics.leaks import INNER_STEP_BOUND, LEAK_BOUND
from warmprior.io.files import read_json, write_atomic

FACTS = ["task", "data", "prior", "options", "sigma", "chunk"]  # of a method, beside its name
RELATIVE = ["kappa", "relative_curvature", "bound", "training_seconds"]  # also over the baseline's
BOUNDS = {"source_leak": LEAK_BOUND, "inner_step_ratio": INNER_STEP_BOUND}  # marked above
SHOWN = [  # below the success rates of report.md
    *("success", "better", "won", "lost", "paired", *BOUNDS, "memory_gain", "boundary_jump", "inner_jump"),
    *(f"{name}_ratio" for name in RELATIVE),
    *("coverage", "mean_error", "mean_revision_data", "mean_revision"),
]


# Rows


def text_of(row: Mapping[str, Any], name: str) -> str:
    """A text of a row, empty where it has none."""
    value = row.get(name)
    return value if isinstance(value, str) else ""


def setting_title(row: Mapping[str, Any]) -> str:
    """Task and style, with actions and observations where they are not the usual ones."""
    spaces = ((text_of(row, "actions"), "actions"), (text_of(row, "obs"), "observations"))
    title = f"{row['task'].replace('_', '-').title()}-{row['data'].upper()}"
    return ", ".join([title, *(f"{space} {words}" for space, words in spaces if space)])


def labelled(rows: DataFrame, *apart: str) -> DataFrame:
    """The rows with their `method` and `setting` in words.

    Sigma and H belong to the name of a method where several occur, unless a table has them `apart`.
    """
    sigmas = rows.groupby("prior")["sigma"].transform("nunique") > 1
    several = "chunk" not in apart and rows["chunk"].nunique() > 1
    methods, settings = [], []
    for row, by_sigma in zip(rows.to_dict("records"), sigmas, strict=True):
        guided = text_of(row, "guidance") == "rtc"
        parts = [label(row["prior"], text_of(row, "options"))]
        if guided:
            parts = ["RTC"] if row["prior"] == "gaussian" else [f"RTC + {parts[0]}"]
        parts += ["around zero"] if text_of(row, "centre") == "zero" else []
        parts += [f"sigma {row['sigma']:g}"] if by_sigma and "sigma" not in apart else []
        methods.append(", ".join([*parts, *([f"H {row['chunk']}"] if several else [])]))
        settings.append(setting_title(row) if text_of(row, "task") else "")
    return rows.assign(method=methods, setting=settings)


def per_seed(rows: DataFrame, top_k: int) -> DataFrame:
    """A row per training and way to play it, of its best `top_k` checkpoints.

    Everything that depends on the checkpoint is of the same ones. They played the same episodes, so that an
    episode counts once, by the mean of its outcomes: `solved`, from which all that a report says of success
    follows.
    """
    keys = [name for name in ("policy", "nfe", "delay", "guidance", "temperature") if name in rows]
    groups = rows.reset_index(drop=True).groupby(keys, sort=False, dropna=False)
    return DataFrame([_of_best(group, top_k) for _, group in groups]).infer_objects().reset_index(drop=True)


def _of_best(group: DataFrame, top_k: int) -> Series:
    last, best = group.loc[group["checkpoint"].idxmax()].copy(), group
    if len(group) > 1:
        best = group.sort_values(["success_rate", "checkpoint"], ascending=False).head(top_k)
        measured = best.select_dtypes("number").drop(columns=[*IDENTITY], errors="ignore")
        last.update(measured.mean())
    if "outcomes" in group and best["outcomes"].notna().all():
        solved = np.mean([np.array([*map(int, outcomes)]) for outcomes in best["outcomes"]], 0)
        last["solved"] = solved
    last["success"] = last["success_rate"] = best["success_rate"].mean()
    last["successes"] = best["successes"].mean()
    last["checkpoints"] = group["checkpoint"].nunique()
    return last


def at_fewest(rows: DataFrame) -> DataFrame:
    """The rows at the fewest network evaluations of every method, which may have a number of its own."""
    return rows[rows["nfe"] == rows.groupby("method")["nfe"].transform("min")]


def pooled(rows: DataFrame) -> DataFrame:
    """Curvatures averaged over the training seeds, or those of the only seed."""
    average = rows["seed"].isna()
    return rows[average if average.any() else rows["seed"] == rows["seed"].min()]


def summary(rows: DataFrame, top_k: int) -> DataFrame:
    """All that is known per setting, method (delay) and NFE, beside the first method's."""
    seeds = per_seed(labelled(rows), top_k)
    seeds = seeds.assign(**seeds.reindex(columns=[*RELATIVE, *BOUNDS, "memory_gain"]).astype(float))
    keys = [name for name in ("setting", "method", "delay", "nfe", "temperature") if name in seeds]
    groups = seeds.groupby(keys, sort=False)
    counted = {
        *keys,
        *FACTS,
        "solved",
        "seed",
        "iterations",
        "checkpoint",
        "episodes",
        "successes",
        "success_rate",
    }
    measures = [name for name in seeds.select_dtypes("number") if name not in {*counted, "checkpoints"}]
    spread = groups[measures].std().dropna(axis=1, how="all").add_suffix("_std")
    found = groups[[*FACTS, "checkpoints"]].first().join(groups[["episodes", "successes"]].sum())
    found = found.assign(seeds=groups.size()).join(groups[measures].mean()).join(spread).reset_index()
    counts = found[["successes", "episodes"]].to_numpy()
    intervals = [success_posterior(*pair).interval(0.95) for pair in counts]
    found["low"], found["high"] = zip(*intervals, strict=True)
    firsts = seeds.groupby(keys, sort=False, as_index=False).head(1).to_dict("records")
    found["paper"] = [paper_success(row) for row in firsts]
    return _beside(found, seeds, keys)


def _beside(found: DataFrame, seeds: DataFrame, keys: Sequence[str]) -> DataFrame:
    """A summary with what compares each method to the first one, at the same place and NFE."""
    first, place = found["method"].iloc[0], [name for name in keys if name != "method"]
    base = found[found["method"] == first].set_index(place)
    theirs = base.reindex(pd.MultiIndex.from_frame(found[place])).set_index(found.index)
    other = found["method"] != first
    found["gain"] = (found["success"] - theirs["success"]).where(other)
    deviations = [part.get("success_std", math.nan) for part in (found, theirs)]
    found["one_sigma"] = found["gain"] > deviations[0] + deviations[1]
    pairs = found[["successes", "episodes"]].join(theirs[["successes", "episodes"]], rsuffix="_first")
    found["better"] = [
        probability_better(*counts) if not math.isnan(gain) else math.nan
        for counts, gain in zip(pairs.to_numpy(), found["gain"], strict=True)
    ]
    # Episodes of equal seeds, of trainings with equal seeds.
    both = seeds[seeds["method"] != first].merge(
        seeds[seeds["method"] == first], on=[*place, "seed"], suffixes=("", "_first")
    )
    apart = [mine - first for mine, first in both[["solved", "solved_first"]].to_numpy()]
    both["won"] = [pairs.clip(min=0).sum() for pairs in apart]
    both["lost"] = [-pairs.clip(max=0).sum() for pairs in apart]
    found = found.join(both.groupby(list(keys))[["won", "lost"]].sum(), on=list(keys))
    found["paired"] = [
        math.nan if math.isnan(won) else paired_probability_better(won, lost)
        for won, lost in found[["won", "lost"]].to_numpy()
    ]
    # A flow is the same at any NFE, and the baseline may lack this one.
    flows = seeds[seeds["method"] == first].groupby("setting")[RELATIVE].mean()
    for name in RELATIVE:
        found[f"{name}_ratio"] = found[name] / found["setting"].map(flows[name]).replace(0.0, math.nan)
    return found


# Tables


def table(rows: DataFrame, keys: Sequence[str], names: Iterable[str], notes: Sequence[str] = ()) -> str:
    """A line per combination of `keys`, in the order of the rows, and a column per key and name.

    A cell has the mean of a column and, over several rows, its standard deviation. Names that no row knows
    are left out.
    """
    known = [name for name in names if name in rows and rows[name].notna().any()]
    lines = []
    for _, group in rows.groupby(list(keys), sort=False, dropna=False):
        start = {key: format(group[key].iloc[0], column(key)[0]) for key in keys}
        lines.append(start | {name: _cell(group, name) for name in known})
    return markdown(DataFrame(lines), notes)


def _cell(group: DataFrame, name: str) -> str:
    form, values = column(name)[0], group[name].dropna().astype(float)
    if values.empty:
        return "-"
    mean = values.mean()
    text = f"{mean:{form.replace('d', '.0f')}}"
    spread = values.std() if len(values) > 1 else group.get(f"{name}_std", Series([math.nan])).iloc[0]
    if not math.isnan(spread) and form != "d":
        text += f" ± {spread:{form.lstrip('+z')}}"
    if f"{name}_low" in group and not pd.isna(group[f"{name}_low"].iloc[0]):
        text += f" [{group[f'{name}_low'].iloc[0]:{form}}, {group[f'{name}_high'].iloc[0]:{form}}]"
    missing = f" ({len(group) - len(values)} not finite)" if len(values) < len(group) else ""
    return text + missing + (" (!)" if mean > BOUNDS.get(name, math.inf) else "")


def markdown(frame: DataFrame, notes: Sequence[str] = ()) -> str:
    """A table of texts in Markdown, with a list of notes below it."""
    lines = [list(frame.columns), ["---"] * len(frame.columns), *frame.to_numpy().tolist()]
    text = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([*text, *([""] if notes else []), *(f"- {note}" for note in notes)]) + "\n"


def wide(found: DataFrame, cells: Series, index: str, columns: str) -> DataFrame:
    """A pivot of texts of a summary, in its order; the largest NFE stands first."""
    found = found.assign(cell=cells).sort_values("nfe", ascending=False, kind="stable")
    order = found[columns].unique()
    pivot = found.pivot(index=index, columns=columns, values="cell")
    return pivot.reindex(index=pd.unique(found.sort_index()[index]), columns=order).fillna("-")


# Reports


def _placed(found: DataFrame) -> DataFrame:
    """A summary with the `place` where methods compare, and the `text` of a success with its gain."""
    delay = ", delay " + found["delay"].astype(str) if "delay" in found else ""
    found = found.assign(place=found["setting"] + delay, column="NFE " + found["nfe"].astype(str))
    if "temperature" in found and found.groupby("method")["temperature"].nunique().max() > 1:
        found["column"] += ", noise x " + found["temperature"].map("{:g}".format)
    best = found.groupby(["place", "column"])["success"].transform("max")
    texts = []
    for row, most in zip(found.to_dict("records"), best, strict=True):
        # Where nothing is solved, nobody is the best.
        mark = "**" if 0 < most <= row["success"] + 1e-9 else ""
        text = f"{mark}{100 * row['success']:.1f}{mark}"
        star = "*" if row["one_sigma"] else ""
        texts.append(text if math.isnan(row["gain"]) else f"{text} ({100 * row['gain']:+z.1f}{star})")
    return found.assign(text=texts)


def _count(number: float, word: str) -> str:
    return f"{number:,.0f} {word}{'' if number == 1 else 's'}"


def _experiment(found: DataFrame, top_k: int) -> str:
    most = found[["seeds", "checkpoints"]].max()
    episodes = _count((found["episodes"] / found["seeds"]).max(), "episode")
    chunks = ", ".join(map(str, found["chunk"].unique()))
    chosen = f"best {min(top_k, most['checkpoints'])} of {most['checkpoints']} checkpoints per seed"
    chosen = chosen if most["checkpoints"] > 1 else "last checkpoint"
    return f"H = {chunks}, {_count(most['seeds'], 'seed')} with {episodes} each, {chosen}"


def headline(found: DataFrame, top_k: int, width: int = 120) -> str:
    """Three lines: the experiment, the best methods, and how sure it is that they beat the first.

    Over several settings it averages success and pools episodes.
    """
    first, settings = found["method"].iloc[0], found["setting"].unique()
    best, chances = [], []
    sums = {"success": "mean", "successes": "sum", "episodes": "sum", "task": "size"}
    for nfe, group in _placed(found).sort_values("nfe", ascending=False).groupby("column", sort=False):
        totals = group.sort_index().groupby("method", sort=False).agg(sums)
        totals = totals[totals["task"] == totals["task"].max()]  # what was played everywhere
        name = totals["success"].idxmax()
        best.append(f"{name} {totals.loc[name, 'success']:.1%} at {nfe}")
        others = totals.drop(first, errors="ignore")
        if first in totals.index and len(others):
            name = others["success"].idxmax()
            counts = totals.loc[[name, first], ["successes", "episodes"]].to_numpy().flatten()
            gain = totals.loc[name, "success"] - totals.loc[first, "success"]
            chance = probability_better(*counts)
            chances.append(f"{name} {gain:+.1%}, {chance:.2f} at {nfe}")
    where = f"{len(settings)} settings ({', '.join(settings)})" if len(settings) > 1 else settings[0]
    lines = [
        f"{_count(found['method'].nunique(), 'method')} on {where}: {_experiment(found, top_k)}.",
        f"Best success: {'; '.join(best)}.",
        f"Gain over {first} and its probability: {'; '.join(chances) or 'nothing to compare'}.",
    ]
    return "\n".join(textwrap.shorten(line, width, placeholder=" ...") for line in lines)


def terminal_table(found: DataFrame, top_k: int, width: int = 120) -> str:
    """The headline, then a line per setting and method with a column per NFE."""
    rows, first = _placed(found), found["method"].iloc[0]
    several = rows["place"].nunique() > 1
    rows["line"] = rows["place"] + ", " + rows["method"] if several else rows["method"]
    frame = wide(rows, rows["text"], "line", "column").rename_axis(index=None, columns=None)
    frame.index = [textwrap.shorten(name, width * 2 // 3, placeholder=" ...") for name in frame.index]
    legend = f"Success (%), gain over {first}. **: the best. *: above both deviations over seeds."
    legend = textwrap.shorten(legend, width, placeholder=" ...")
    return "\n".join([headline(found, top_k, width), "", frame.to_string(line_width=width), "", legend])


def success_report(found: DataFrame, top_k: int, notes: Sequence[str] = (), source: str | None = None) -> str:
    """Table 1 in the paper's layout, with its numbers, and below it all measures of every method.

    `source` names the demonstrations: `official` ones are those of the paper.
    """
    rows, first = _placed(found), found["method"].iloc[0]
    rows["column"] = rows["column"] + ": " + rows["method"]
    paper = (100 * rows["paper"]).map("{:.1f}".format, na_action="ignore")
    lines = {f"measured ({source or 'own'} data)": rows["text"], "paper (official data)": paper}
    parts = [wide(rows, cells, "place", "column") for cells in lines.values()]
    for part, name in zip(parts, lines, strict=True):
        part.insert(0, "Success rate (%)", part.index + ", " + name)
    frame = pd.concat(parts).sort_index(kind="stable")
    frame = frame[(frame.iloc[:, 1:] != "-").any(axis=1)]
    rule = "`*` marks a gain above the sum of both standard deviations over seeds (the paper's rule)."
    if rows["seeds"].max() == 1:
        rule = "One seed has no spread: we mark no gain. success.png shows the episodes' posterior."
    head = f"{_experiment(found, top_k)}. In parentheses: the gain over {first} in points. Bold: the best."
    listed = [head, rule, *notes]
    if source not in ("official", None):
        listed.append(
            "The paper used the official human demonstrations, and we used others. Compare gains within a "
            "row, not numbers across rows."
        )
    keys = [name for name in ("setting", "delay", "nfe", "temperature", "method") if name in found]
    return f"{markdown(frame, listed)}\n{table(found, keys, SHOWN)}"


# What differs from run to run, or is in the first lines of a report.
NO_RECIPE = {"task", "data", "dataset", "download", "force_download", "demonstrations"}
NO_RECIPE |= {"seed", "seeds", "episodes", "nfe", "save_every", "log_every"}


def unlike(options: Options, paper: Options) -> list[str]:
    """What a table says of the recipe where it is not the paper's; it is the same for all sources."""
    if options.data.obs == "image" and paper.data.obs == "state":
        paper = with_parts(paper, **IMAGES["paper"], data={"obs": "image"})

    def recipe(one: Options) -> dict[str, Any]:
        parts = (one.data, one.network, one.training, one.evaluation)
        values = {name: value for part in parts for name, value in asdict(part).items()}
        values["weighting"] = one.training.weighting or (
            "standardised" if one.network.precondition else "velocity"
        )
        return {name: value for name, value in values.items() if name not in NO_RECIPE}

    def text(value: Any) -> str:
        return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)

    theirs = recipe(paper)
    found = [
        f"{name.replace('_', ' ')} {text(value)} ({text(theirs[name])})"
        for name, value in recipe(options).items()
        if value != theirs[name]
    ]
    words = "; ".join(found)
    return [f"Unlike the paper (its own in parentheses), for all sources: {words}."] if found else []


def write_report(out: Path, short: str, full: str, frame: DataFrame, failures: Sequence[str] = ()) -> None:
    """Write `report.md` and `results.csv`, and print the short text; then fail if anything is missing.

    The report ends with what the columns of its tables and of `results.csv` mean.
    """
    listed = "".join(f"- {failure}\n" for failure in failures)
    missing = f"\nMissing:\n\n{listed}" if failures else ""
    names = [*frame.columns, *(n for n in COLUMNS if n not in frame and f"| {n} |" in full)]
    meanings = "".join(f"- `{name}`: {column(name)[1]}\n" for name in names)
    full = f"{full.rstrip()}\n{missing}\nColumns, here and in results.csv:\n\n{meanings}"
    write_atomic(out / "report.md", lambda path: path.write_text(full, encoding="utf-8"))
    write_atomic(out / "results.csv", lambda path: frame.to_csv(path, index=False))
    print(f"\n{short.rstrip()}\n{missing}\nRows, report.md, results.csv and pictures: {out}", flush=True)
    if failures:
        raise PartialFailure(f"{len(failures)} failed (--resume tries again): {'; '.join(failures)}")


def policy_results(run: str | Path, policy: str | Path) -> list[dict[str, Any]]:
    """The rows of a run's results that one of its policies played, with the facts of its demonstrations.

    ``run`` is the folder of a benchmark, ``policy`` such as ``.../policies/lift-ph-.../policy_005000``.

    Raises:
        FileNotFoundError: if there are no results.
        ValueError: if they are damaged, or none is of the policy.

    Examples:
        >>> import json
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from lab.report import policy_results
        >>> row = {"task": "lift", "data": "ph", "policy": "lift-ph", "checkpoint": 20, "seed": 0,
        ...        "episodes": 4, "successes": 2, "success_rate": 0.5}
        >>> with TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "results.jsonl").write_text(json.dumps(row))
        ...     policy_results(folder, "policies/lift-ph/policy_000020")[0]["success_rate"]
        0.5
    """
    path, folder = Path(run) / "results.jsonl", Path(policy).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"{run} has no results.jsonl: name the folder of a finished run")
    rows = [
        row
        for row in read_rows(path)
        if "success_rate" in row
        and row.get("policy") == folder.parent.name
        and f"policy_{row['checkpoint']:06d}" == folder.name
    ]
    if not rows:
        raise ValueError(
            f"{path} has no row of {folder}: name the run that played it, and the policy where that run "
            "keeps it"
        )
    tasks = Path(run) / "tasks.json"
    for facts in read_json(tasks) if tasks.is_file() else ():
        if (facts["task"], facts["data"]) == (rows[0]["task"], rows[0]["data"]):
            rows = [{**row, "demonstrations": facts} for row in rows]
    return rows
