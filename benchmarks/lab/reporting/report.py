"""Tables of the benchmarks: from rows of `results.jsonl` to Markdown, and to a short text for a terminal.

A row is one evaluation of one policy: what was evaluated (task, prior, seed, nfe, ...), and the results. The
columns of rows and tables are defined in `columns.py`. Methods are compared with the first one.
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

from lab.io.errors import PartialFailure
from lab.measures.statistics import ENOUGH_TRAININGS, interval, sign_flip_test, spread_of, weights_elsewhere
from lab.methods.methods import label
from lab.options.options import Options, with_parts
from lab.options.presets import IMAGES
from lab.reporting.columns import COLUMNS, IDENTITY, RELATIVE, SHOWN, column
from lab.reporting.paper import PAPER_SUCCESS, paper_success
from lab.reporting.rows import RESULTS, read_rows
from warmprior.diagnostics.leaks import INNER_STEP_BOUND, LEAK_BOUND
from warmprior.io.files import read_json, write_atomic

FACTS = ["task", "data", "prior", "options", "sigma", "chunk"]  # columns that describe a method
BOUNDS = {"source_leak": LEAK_BOUND, "inner_step_ratio": INNER_STEP_BOUND}  # values above are marked (!)


# Rows


def text_of(row: Mapping[str, Any], name: str) -> str:
    """Return a text of a row, empty if it has none."""
    value = row.get(name)
    return value if isinstance(value, str) else ""


def setting_title(row: Mapping[str, Any]) -> str:
    """Return task and style, with actions and observations if they are unusual.

    >>> setting_title({"task": "square", "data": "mh"}), setting_title({"task": "pusht", "data": "human"})
    ('Square-MH', 'Pusht-Human')
    """
    spaces = ((text_of(row, "actions"), "actions"), (text_of(row, "obs"), "observations"))
    style = row["data"].upper() if row["data"] in ("ph", "mh") else row["data"].title()
    title = f"{row['task'].replace('_', '-').title()}-{style}"
    return ", ".join([title, *(f"{space} {words}" for space, words in spaces if space)])


def labelled(rows: DataFrame, *apart: str) -> DataFrame:
    """Return the rows with their `method` and `setting` in words.

    The name of a method includes sigma and H if several occur, unless a table has them as columns (`apart`).
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
    """Return a row per training and setting of play, averaged over its best `top_k` checkpoints.

    One half of the episodes chooses the checkpoints that the other half is reported of, so the choice does
    not raise the success rate. Other measures are averaged with the same weights. An episode counts once,
    with the mean of its outcomes (`solved`); reports derive all numbers on success from that.
    """
    keys = [name for name in ("policy", "nfe", "delay", "guidance", "temperature") if name in rows]
    groups = rows.reset_index(drop=True).groupby(keys, sort=False, dropna=False)
    return DataFrame([_of_best(group, top_k) for _, group in groups]).infer_objects().reset_index(drop=True)


def _of_best(group: DataFrame, top_k: int) -> Series:
    group = group.sort_values("checkpoint", ascending=False)
    last = group.iloc[0].copy()
    outcomes = np.array([[*map(int, text)] for text in group["outcomes"]])
    weights = weights_elsewhere(outcomes, top_k)
    if len(group) > 1:
        measured = group.select_dtypes("number").drop(columns=[*IDENTITY], errors="ignore")
        shares = weights.mean(1)
        for name, values in measured.items():
            counted = values.notna().to_numpy() & (shares > 0)
            last[name] = np.average(values[counted], weights=shares[counted]) if counted.any() else math.nan
    last["solved"] = (weights * outcomes).sum(0)
    last["success"] = last["success_rate"] = last["solved"].mean()
    last["successes"] = last["solved"].sum()
    last["checkpoints"] = group["checkpoint"].nunique()
    return last


def at_fewest(rows: DataFrame) -> DataFrame:
    """Return the rows at each method's smallest NFE."""
    return rows[rows["nfe"] == rows.groupby("method")["nfe"].transform("min")]


def pooled(rows: DataFrame) -> DataFrame:
    """Return the rows averaged over training seeds, or those of the only seed."""
    average = rows["seed"].isna()
    return rows[average if average.any() else rows["seed"] == rows["seed"].min()]


def summary(rows: DataFrame, top_k: int) -> DataFrame:
    """Return a row per setting, method and NFE (and delay, temperature), compared with the first method."""
    seeds = per_seed(labelled(rows), top_k)
    seeds = seeds.assign(**seeds.reindex(columns=[*RELATIVE, *BOUNDS, "memory_gain"]).astype(float))
    keys = [name for name in ("setting", "method", "delay", "nfe", "temperature") if name in seeds]
    groups = seeds.groupby(keys, sort=False)
    counted = {
        *keys,
        *FACTS,
        "solved",
        "first_episode",
        "seed",
        "iterations",
        "checkpoint",
        "episodes",
        "successes",
        "success_rate",
    }
    measures = [name for name in seeds.select_dtypes("number") if name not in {*counted, "checkpoints"}]
    spread = groups[measures].std().dropna(axis=1, how="all").add_suffix("_std")
    result = groups[[*FACTS, "checkpoints"]].first().join(groups[["episodes", "successes"]].sum())
    result = result.assign(seeds=groups.size()).join(groups[measures].mean()).join(spread).reset_index()
    result = result.join(groups["solved"].agg(list), on=keys)
    result = result.join(_intervals(result, keys, "solved").clip(0.0, 1.0).add_prefix("success_"))
    firsts = seeds.groupby(keys, sort=False, as_index=False).head(1).to_dict("records")
    result["paper"] = [paper_success(row) for row in firsts]
    return _beside(result, seeds, keys).drop(columns="solved")


def _intervals(rows: DataFrame, keys: Sequence[str], name: str) -> DataFrame:
    """Return the `low` and `high` ends of the mean of a column whose entries are a list, one per training.

    Rows that were played alike tell together how much trainings differ: those of all settings and methods.
    """
    played = [key for key in keys if key not in ("setting", "method")]
    ends = DataFrame(math.nan, rows.index, ["low", "high"])
    for _, group in rows[rows[name].notna()].groupby(played, dropna=False):
        cells = group[name].map(np.stack)
        spread = spread_of(list(cells))
        ends.loc[group.index] = [interval([cell], spread) for cell in cells]
    return ends


def _by_temperature(rows: DataFrame) -> bool:
    """Return True if a method was played at several temperatures."""
    return "temperature" in rows and rows.groupby("method")["temperature"].nunique().max() > 1


def baseline(rows: DataFrame) -> str:
    """Return the first method, also if it failed in some settings: none comes before it in any of them."""
    later = rows["method"] != rows.groupby("setting")["method"].transform("first")
    return next(name for name in rows["method"] if name not in set(rows["method"][later]))


def _beside(rows: DataFrame, seeds: DataFrame, keys: Sequence[str]) -> DataFrame:
    """Add to a summary the comparison of each method with the first one in the same setting and NFE."""
    first, place = baseline(rows), [name for name in keys if name != "method"]
    if not _by_temperature(rows) and "temperature" in place:  # a method may have its own
        place.remove("temperature")
    rows_of_first = rows[rows["method"] == first].set_index(place)
    first_rows = rows_of_first.reindex(pd.MultiIndex.from_frame(rows[place])).set_index(rows.index)
    # Episodes are paired by their seeds, and trainings by theirs.
    both = seeds[seeds["method"] != first].merge(
        seeds[seeds["method"] == first], on=[*place, "seed"], suffixes=("", "_first")
    )
    both["differences"] = [one - first for one, first in both[["solved", "solved_first"]].to_numpy()]
    both["won"] = [pairs.clip(min=0).sum() for pairs in both["differences"]]
    both["lost"] = [-pairs.clip(max=0).sum() for pairs in both["differences"]]
    compared = both.groupby(list(keys))
    rows = rows.join(compared[["won", "lost"]].sum(), on=list(keys))
    rows = rows.join(compared["differences"].agg(list), on=list(keys))
    rows = rows.join(_intervals(rows, keys, "differences").add_prefix("gain_"))
    rows["gains"] = [
        [float(pairs.mean()) for pairs in of] if isinstance(of, list) else [] for of in rows["differences"]
    ]
    rows["gain"] = [np.mean(gains) if gains else math.nan for gains in rows["gains"]]
    deviations = [part.get("success_std", math.nan) for part in (rows, first_rows)]
    rows["one_sigma"] = rows["gain"] > deviations[0] + deviations[1]
    rows = rows.drop(columns="differences")
    # A flow does not depend on NFE, and the first method may not be played at this one.
    flows = seeds[seeds["method"] == first].groupby("setting")[RELATIVE].mean()
    for name in RELATIVE:
        rows[f"{name}_ratio"] = rows[name] / rows["setting"].map(flows[name]).replace(0.0, math.nan)
    return rows


# Tables


def table(rows: DataFrame, keys: Sequence[str], names: Iterable[str], notes: Sequence[str] = ()) -> str:
    """Return a table in Markdown: a line per combination of `keys`, a column per key and name.

    An entry is the mean over the rows with, for several rows, their standard deviation. Columns without any
    value are left out.
    """
    present = [name for name in names if name in rows and rows[name].notna().any()]
    lines = []
    for _, group in rows.groupby(list(keys), sort=False, dropna=False):
        start = {key: format(group[key].iloc[0], column(key).form) for key in keys}
        lines.append(start | {name: _entry(group, name) for name in present})
    return markdown(DataFrame(lines), notes)


def _entry(group: DataFrame, name: str) -> str:
    form, values = column(name).form, group[name].dropna().astype(float)
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
    """Return a table of texts in Markdown, with a list of notes below it."""
    lines = [list(frame.columns), ["---"] * len(frame.columns), *frame.to_numpy().tolist()]
    text = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([*text, *([""] if notes else []), *(f"- {note}" for note in notes)]) + "\n"


def wide(rows: DataFrame, texts: Series, index: str, columns: str) -> DataFrame:
    """Return a pivot of texts in the order of the rows, with the largest NFE first."""
    rows = rows.assign(entry=texts).sort_values("nfe", ascending=False, kind="stable")
    order = rows[columns].unique()
    pivot = rows.pivot(index=index, columns=columns, values="entry").astype(object)
    return pivot.reindex(index=pd.unique(rows.sort_index()[index]), columns=order).fillna("-")


# Reports


def _placed(rows: DataFrame) -> DataFrame:
    """Add to a summary the `place` and `column` of its entries in a table, and their `text`."""
    delay = ", delay " + rows["delay"].astype(str) if "delay" in rows else ""
    rows = rows.assign(place=rows["setting"] + delay, column="NFE " + rows["nfe"].astype(str))
    if _by_temperature(rows):
        rows["column"] += ", noise x " + rows["temperature"].map("{:g}".format)
    best = rows.groupby(["place", "column"])["success"].transform("max")
    texts = []
    for row, most in zip(rows.to_dict("records"), best, strict=True):
        # If no method solves anything, none is marked as the best.
        mark = "**" if 0 < most <= row["success"] + 1e-9 else ""
        text = f"{mark}{100 * row['success']:.1f}{mark}"
        star = "*" if row["one_sigma"] else ""
        texts.append(text if math.isnan(row["gain"]) else f"{text} ({100 * row['gain']:+z.1f}{star})")
    return rows.assign(text=texts)


def counted(number: float, word: str) -> str:
    return f"{number:,.0f} {word}{'' if number == 1 else 's'}"


def _experiment(rows: DataFrame, top_k: int) -> str:
    most = rows[["seeds", "checkpoints"]].max()
    episodes = counted((rows["episodes"] / rows["seeds"]).max(), "episode")
    chunks = ", ".join(map(str, rows["chunk"].unique()))
    chosen = f"best {min(top_k, most['checkpoints'])} of {most['checkpoints']} checkpoints per seed"
    chosen = chosen if most["checkpoints"] > 1 else "last checkpoint"
    return f"H = {chunks}, {counted(most['seeds'], 'seed')} with {episodes} each, {chosen}"


def headline(rows: DataFrame, top_k: int, width: int = 120) -> str:
    """Return what the best methods gain, if it can be chance, how much they solve, and what was played.

    Over several settings, success is averaged, and trainings are taken together.
    """
    first, settings = baseline(rows), rows["setting"].unique()
    best, chances = [], []
    sums = {"success": "mean", "gains": list, "task": "size"}
    for nfe, group in _placed(rows).sort_values("nfe", ascending=False).groupby("column", sort=False):
        totals = group.sort_index().groupby("method", sort=False).agg(sums)
        totals = totals[totals["task"] == totals["task"].max()]  # methods that were played in all settings
        name = totals["success"].idxmax()
        success = totals.loc[name, "success"]
        best.append(f"{name} {success:.1%} at {nfe}" if success else f"none at {nfe}")
        others = totals.drop(first, errors="ignore")
        if first in totals.index and len(others):
            name = others["success"].idxmax()
            gains = [of for of in totals.loc[name, "gains"] if of]
            gain = np.mean([np.mean(of) for of in gains]) if gains else math.nan
            more = f"{abs(gain) * 100:.1f} points {'fewer' if gain < 0 else 'more'}"
            chances.append(f"{name} solves {more} at {nfe} ({verdict(*gains)})")
    where = f"{len(settings)} settings ({', '.join(settings)})" if len(settings) > 1 else settings[0]
    found = [
        f"Compared with the {first}, {', '.join(chances) or 'nothing else was played in all settings'}.",
        f"Best success: {'; '.join(best)}.",
    ]
    if not rows["success"].max() > 0:
        found = ["No method solves an episode, so nothing can be compared: train longer, or on more data."]
    lines = [
        *found,
        f"{counted(rows['method'].nunique(), 'method')} on {where}: {_experiment(rows, top_k)}.",
    ]
    whole: dict[str, Any] = {"subsequent_indent": "  ", "break_on_hyphens": False}  # WP-Past stays one word
    return "\n".join(textwrap.fill(line, width, **whole) for line in lines)


def verdict(*gains: Sequence[float]) -> str:
    """Return in words whether the gains of several trainings can be chance, a sequence per setting.

    >>> verdict([0.1, 0.2, 0.1], [0.3, 0.2, 0.1]), verdict([0.1])
    ('p = 0.031, 6 trainings', '1 training, too few to judge')
    """
    trainings = sum(map(len, gains))
    count = counted(trainings, "training")
    if trainings < ENOUGH_TRAININGS:
        return f"{count}, too few to judge"
    return f"p = {sign_flip_test(*gains):.2g}, {count}"


def terminal_table(results: DataFrame, top_k: int, width: int = 120) -> str:
    """Return the headline, then per setting a line per method with a column per NFE."""
    rows, first = _placed(results), baseline(results)
    parts = [headline(results, top_k, width)]
    for place, group in rows.groupby("place", sort=False):
        frame = wide(group, group["text"], "method", "column").rename_axis(index=None, columns=None)
        text = frame.to_string(line_width=width)  # wide tables go on below
        parts.append(text if rows["place"].nunique() == 1 else f"{place}\n{text}")
    legend = f"Success (%), gain over {first}. **: the best. *: gain above both deviations over seeds."
    return "\n\n".join([*parts, textwrap.fill(legend, width)])


def success_report(
    results: DataFrame, top_k: int, notes: Sequence[str] = (), source: str | None = None
) -> str:
    """Return Table 1 in the paper's layout, with the paper's numbers, and a table of all measures.

    `source` says where the demonstrations are from; the paper's are `official`.
    """
    rows, first = _placed(results), baseline(results)
    rows["column"] = rows["column"] + ": " + rows["method"]
    paper = (100 * rows["paper"]).map("{:.1f}".format, na_action="ignore")
    lines = {f"measured ({source or 'own'} data)": rows["text"], "paper (official data)": paper}
    parts = [wide(rows, texts, "place", "column") for texts in lines.values()]
    for part, name in zip(parts, lines, strict=True):
        part.insert(0, "Success rate (%)", part.index + ", " + name)
    frame = pd.concat(parts).sort_index(kind="stable")
    frame = frame[(frame.iloc[:, 1:] != "-").any(axis=1)]
    rule = "`*` marks a gain above the sum of both standard deviations over seeds (the paper's rule)."
    if rows["seeds"].max() == 1:
        rule = (
            "One training per method does not tell how much trainings differ: no gain is marked, and "
            "intervals are for other episodes of the same policies alone. For more, add --seeds 3."
        )
    head = f"{_experiment(results, top_k)}. In parentheses: the gain over {first} in points. Bold: the best."
    listed = [head, rule, *notes]
    if results["paper"].isna().all():
        tasks = ", ".join(dict.fromkeys(task for task, *_ in PAPER_SUCCESS))
        listed.append(
            f"The paper has no number for this experiment: its Table 1 has {tasks} (docs/paper.md)."
        )
    elif source not in ("official", None):
        listed.append(
            "The paper used the official human demonstrations; these are others. Compare gains within a row, "
            "not numbers across rows."
        )
    keys = [name for name in ("setting", "delay", "nfe", "temperature", "method") if name in results]
    first_sentence, *_ = headline(results, top_k, width=10_000).splitlines()
    return f"{first_sentence}\n\n{markdown(frame, listed)}\n{table(results, keys, SHOWN)}"


# Options that are not part of the recipe, or are in the first lines of a report.
NO_RECIPE = {"task", "style", "dataset", "download", "force_download", "demonstrations"}
NO_RECIPE |= {"seed", "seeds", "episodes", "nfe", "save_every", "log_every"}


def unlike(options: Options, paper: Options) -> list[str]:
    """Return a note on the options in which the recipe differs from the paper's, if any."""
    if options.data.sees_images and not paper.data.sees_images:
        paper = with_parts(with_parts(paper, **IMAGES["paper"]), data={"obs": "image"})

    def recipe(one: Options) -> dict[str, Any]:
        parts = (one.data, one.network, one.training, one.evaluation)
        values = {name: value for part in parts for name, value in asdict(part).items()}
        values["weighting"] = one.training.weighting or (
            "standardised" if one.network.precondition else "velocity"
        )
        return {name: value for name, value in values.items() if name not in NO_RECIPE}

    def text(value: Any) -> str:
        return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)

    paper_recipe = recipe(paper)
    changes = [
        f"{name.replace('_', ' ')} {text(value)} ({text(paper_recipe[name])})"
        for name, value in recipe(options).items()
        if value != paper_recipe[name]
    ]
    words = "; ".join(changes)
    return [f"Unlike in the paper (its values in parentheses), for all sources: {words}."] if changes else []


def write_report(out: Path, short: str, full: str, frame: DataFrame, failures: Sequence[str] = ()) -> None:
    """Write `report.md` and `results.csv`, and print the short text.

    The report ends with the meanings of the columns.

    Raises:
        PartialFailure: if there are failures, after everything is written.
    """
    listed = "".join(f"- {failure}\n" for failure in failures)
    missing = f"\nMissing:\n\n{listed}" if failures else ""
    names = [*frame.columns, *(n for n in COLUMNS if n not in frame and f"| {n} |" in full)]
    meanings = "".join(f"- `{name}`: {column(name).meaning}\n" for name in names)
    full = f"{full.rstrip()}\n{missing}\nColumns, here and in results.csv:\n\n{meanings}"
    write_atomic(out / "report.md", lambda path: path.write_text(full, encoding="utf-8"))
    write_atomic(out / "results.csv", lambda path: frame.to_csv(path, index=False))
    print(f"\n{short.rstrip()}\n{missing}\nRows, report.md, results.csv and pictures: {out}", flush=True)
    if failures:
        raise PartialFailure(f"{len(failures)} failed (try again with --resume): {'; '.join(failures)}")


def policy_results(run: str | Path, policy: str | Path) -> list[dict[str, Any]]:
    """Return the rows of a run that belong to one of its policies, with the facts of its demonstrations.

    ``run`` is the folder of a benchmark, ``policy`` such as ``.../policies/lift-ph-.../policy_005000``.

    Raises:
        FileNotFoundError: if there are no results.
        ValueError: if they are damaged, or none is of the policy.

    Examples:
        >>> import json
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from lab.reporting.report import policy_results
        >>> row = {"task": "lift", "data": "ph", "policy": "lift-ph", "checkpoint": 20, "seed": 0,
        ...        "episodes": 4, "successes": 2, "success_rate": 0.5}
        >>> with TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "results.jsonl").write_text(json.dumps(row))
        ...     policy_results(folder, "policies/lift-ph/policy_000020")[0]["success_rate"]
        0.5
    """
    path, folder = Path(run) / RESULTS, Path(policy).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"{run} has no {RESULTS}: name the folder of a finished run")
    rows = [
        row
        for row in read_rows(path)
        if "success_rate" in row
        and row.get("policy") == folder.parent.name
        and f"policy_{row['checkpoint']:06d}" == folder.name
    ]
    if not rows:
        raise ValueError(
            f"{path} has no row of {folder}: name the run that played this policy, and the policy's folder "
            "in that run's policies/"
        )
    tasks = Path(run) / "tasks.json"
    for facts in read_json(tasks) if tasks.is_file() else ():
        if (facts["task"], facts["data"]) == (rows[0]["task"], rows[0]["data"]):
            rows = [{**row, "demonstrations": facts} for row in rows]
    return rows
