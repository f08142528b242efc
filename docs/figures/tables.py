"""Tables of pages: the marked ones of a page, and one per run whose rows it names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame, read_json
from shared import DATA, GAUSSIAN, SOURCES, read_arms, read_played, shown_sources

from lab.measures.statistics import chosen_elsewhere

SLOPES = {"marginal": "over all data", "conditional": "given the observation", "none": "no preconditioning"}
OBSERVED = {2: "2 (the default)", 1: "1"}
SHOWN = {"perfect": "perfect (Algorithm 1)", "others": "of policies that have not seen the episode"}

TABLE = re.compile(r"(?<=<!-- table -->\n).*?(?=<!-- end -->)", re.S)
"""This matches a marked table of a page."""


def played_table(name: str) -> str:
    """Return success of a run in Markdown: percent, and episodes won and lost against the Gaussian source.

    There is a line per NFE and factor of the source's noise, and per NFE a line in which every source has its
    own best factor, chosen on other episodes, if the same episodes were played with every factor. Tasks and
    seeds are pooled.
    """
    rows = read_played(name)
    names = shown_sources(rows)
    text = ["| NFE | noise | " + " | ".join(SOURCES[source][0] for source in names) + " |"]
    text.append("|---" * (2 + len(names)) + "|")
    for nfe, part in rows.sort_values(["nfe", "noise"], ascending=False).groupby("nfe", sort=False):
        solved = _solved(part)
        text += [_played_line(nfe, f"{noise:g}", by_source, names) for noise, by_source in solved.items()]
        if best := own_best(part):
            text.append(_played_line(nfe, "own best", best, names))
    return "\n".join(text) + "\n"


def _solved(rows: DataFrame) -> dict[float, dict[str, np.ndarray]]:
    """Return the outcomes of the episodes of all tasks and seeds, by factor of the noise and source."""
    solved: dict[float, dict[str, np.ndarray]] = {}
    for (noise, source), group in rows.groupby(["noise", "source"], sort=False):
        outcomes = np.concatenate(list(group.sort_values(["task", "seed"])["solved"]))
        solved.setdefault(noise, {})[source] = outcomes
    return solved


def own_best(rows: DataFrame) -> dict[str, np.ndarray]:
    """Return the outcomes of each source with its best noise, for sources that played the same with each."""
    solved = _solved(rows)
    if len(solved) < 2:
        return {}
    every = {s: [of[s] for of in solved.values() if s in of] for s in shown_sources(rows)}
    full = {s: e for s, e in every.items() if len(e) == len(solved) and len({*map(len, e)}) == 1}
    return {source: chosen_elsewhere(np.stack(outcomes)) for source, outcomes in full.items()}


def _played_line(nfe: int, noise: str, solved: Mapping[str, np.ndarray], names: list[str]) -> str:
    most, gaussian = max(outcomes.mean() for outcomes in solved.values()), solved.get(GAUSSIAN)
    entries = []
    for source in names:
        outcomes = solved.get(source)
        if outcomes is None:
            entries.append("")
            continue
        rate = f"{100 * outcomes.mean() + 1e-6:.0f}"
        rate = f"**{rate}**" if outcomes.mean() == most and len(solved) > 1 else rate
        if source != GAUSSIAN and gaussian is not None and len(outcomes) == len(gaussian):
            rate += f" ({(outcomes > gaussian).sum()} : {(outcomes < gaussian).sum()})"
        entries.append(rate)
    return f"| {nfe} | {noise} | " + " | ".join(entries) + " |"


def study_table(column: str, name: str) -> str:
    """Return success of a run in Markdown, in percent: a line per setting and source, a column per value."""
    rows = read_played(name)
    if len(rows[["noise", "iterations"]].drop_duplicates()) > 1:
        raise ValueError(
            f"{name}: these rows differ in more than {column}, so no column per value holds them"
        )
    values = sorted(rows[column].unique(), reverse=column == "sigma")
    text = [f"| {'H' if column == 'chunk' else column} | {' | '.join(f'{v:g}' for v in values)} |"]
    text.append("|---" * (1 + len(values)) + "|")
    several = rows["nfe"].nunique() > 1
    for (task, data, nfe), part in rows.groupby(["task", "data", "nfe"], sort=False):
        for source in shown_sources(part):
            outcomes = (
                part[part["source"] == source]
                .groupby(column)["solved"]
                .agg(lambda solved: 100 * np.concatenate(list(solved)).mean())
            )
            entries = [f"{outcomes[v] + 1e-6:.0f}" if v in outcomes else "" for v in values]
            at = f", NFE {nfe}" if several else ""
            text.append(f"| {task} {data}, {SOURCES[source][0]}{at} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


def setting_table(column: str, labels: Mapping[Any, str], name: str) -> str:
    """Return success in Markdown, in percent, with that of each training: a line per NFE and setting."""
    rows = read_played(name)
    names = shown_sources(rows)
    text = [f"| NFE | {column.replace('_', ' ')} | {' | '.join(SOURCES[source][0] for source in names)} |"]
    text.append("|---" * (2 + len(names)) + "|")
    for nfe in sorted(rows["nfe"].unique(), reverse=True):
        for setting in (name for name in labels if (rows[column] == name).any()):
            entries = []
            for source in names:
                part = rows[(rows["nfe"] == nfe) & (rows[column] == setting) & (rows["source"] == source)]
                each = [f"{100 * rate:.0f}" for rate in part.sort_values("seed")["success_rate"]]
                one = f" ({', '.join(each)})" if len(each) > 1 else ""
                entries.append(f"{100 * part['success_rate'].mean() + 1e-6:.0f}{one}" if each else "")
            text.append(f"| {nfe} | {labels[setting]} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


def curve_table(name: str) -> str:
    """Return success in Markdown, in percent, after trainings of several lengths: a line per NFE and length.

    The mean of the episodes' best coverage, also in percent, follows in parentheses where it was measured.
    """
    rows = read_played(name)
    names = shown_sources(rows)
    text = [f"| NFE | iterations | {' | '.join(SOURCES[source][0] for source in names)} |"]
    text.append("|---" * (2 + len(names)) + "|")
    for (nfe, iterations), part in rows.groupby(["nfe", "iterations"], sort=True):
        entries = []
        for source in names:
            of = part[part["source"] == source]
            if of.empty:
                entries.append("")
                continue
            covered = of["episode_coverage"].mean() if "episode_coverage" in of else np.nan
            score = "" if np.isnan(covered) else f" ({100 * covered:.0f})"
            entries.append(f"{100 * of['success_rate'].mean() + 1e-6:.0f}{score}")
        text.append(f"| {nfe} | {iterations:,} | {' | '.join(entries)} |")
    return "\n".join(text) + "\n"


def curvature_table(name: str) -> str:
    """Return curvature relative to the Gaussian source in Markdown, at the mean of the data."""
    rows = read_json(DATA / f"{name}.jsonl", lines=True).query("mean == 'training'")
    text = ["| | whole | executed, 95% interval | per squared speed | one Euler step |"]
    text.append("|---" * 5 + "|")
    for _, row in rows[rows["prior"] != GAUSSIAN].iterrows():
        source = f"{row['prior']},{row['options']}" if row["options"] else row["prior"]
        interval = f"[{row['ratio_executed_low']:.2f}, {row['ratio_executed_high']:.2f}]"
        numbers = [row["ratio"], row["ratio_executed"], row["ratio_relative"], row["ratio_one_step"]]
        cells = [f"{number:.2f}" for number in numbers]
        cells[1] += f" {interval}"
        text.append(f"| {SOURCES[source][0]} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def forecasts_table(name: str) -> str:
    """Return errors of sources' means in Markdown, and of the chunks after them, by position and episodes."""
    rows = read_json(DATA / f"{name}.jsonl", lines=True)
    places = (0, 3, 7)
    columns = [f"{what}, a<sub>{k + 1}</sub>" for what in ("mean", "chunk") for k in places]
    text = [f"| | demonstrations | {' | '.join(columns)} |", "|---" * (2 + len(columns)) + "|"]
    for _, row in rows[rows["nfe"] == 9].iterrows():
        errors = [f"{row[what][k]:.2f}" for what in ("mean_error", "chunk_error") for k in places]
        text.append(f"| {SOURCES[row['prior']][0]} | {row['demonstrations']} | {' | '.join(errors)} |")
    return "\n".join(text) + "\n"


def agents_table(name: str) -> str:
    """Return success of agents in Markdown, in percent, by control steps: a line per training."""
    rows = read_json(DATA / f"{name}.jsonl", lines=True)
    recipe = ["source", "nfe", "residual_length", "updates", "noise_critic_steps"]
    heads = ["source, NFE", "residuals", "updates + distillation", "frozen policy", "control steps"]
    heads += ["greedy agent", "episodes of the training"]
    text = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (source, nfe, length, updates, distillation), part in rows.groupby(recipe, sort=False):
        played = part.dropna(subset="greedy_episodes")
        solved = 100 * played["greedy_successes"] / played["greedy_episodes"]
        trained = 100 * part["training_successes"] / part["training_episodes"]
        cells = [f"{SOURCES[source][0]}, {nfe}", f"{length}", f"{updates} + {distillation}"]
        cells += [f"{100 * part['base_successes'].iloc[0] / played['greedy_episodes'].iloc[0]:.0f}"]
        cells += [", ".join(f"{steps:,}" for steps in part["control_steps"])]
        cells += [", ".join(f"{rate:.0f}" for rate in each) for each in (solved, trained)]
        text.append(f"| {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def arms_table(name: str) -> str:
    """Return success of a comparison of agents in Markdown, in percent: a line per agent.

    Evaluations of all seeds are averaged in their order; the last is also given by seed.
    """
    rows = read_arms(name)
    steps = rows.groupby("evaluated")["environment_steps"].mean().round(-3)
    heads = ["agent", "frozen policy", *(f"{int(step):,}" for step in steps[1:]), "the last, by seed"]
    text = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for arm, part in rows.groupby("arm", sort=False):
        rates = 100 * part.groupby("evaluated")["success_rate"].mean() + 1e-6
        last = 100 * part.groupby("seed")["success_rate"].last() + 1e-6
        cells = ["" if np.isnan(rate) else f"{rate:.0f}" for rate in rates.reindex(steps.index)]
        cells += [", ".join(f"{rate:.0f}" for rate in last)]
        text.append(f"| {arm} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


KINDS: dict[str, Callable[[str], str]] = {
    "rows": played_table,  # by NFE and noise
    "sigma": partial(study_table, "sigma"),
    "chunk": partial(study_table, "chunk"),
    "slope": partial(setting_table, "slope", SLOPES),
    "observed": partial(setting_table, "observation_steps", OBSERVED),
    "shown": partial(setting_table, "forecast", SHOWN),  # to WP-Preview in training
    "curve": curve_table,
    "curvature": curvature_table,
    "forecasts": forecasts_table,
    "agents": agents_table,
    "arms": arms_table,
}
"""The tables of a run by their kind, which a page names before the run: ``<!-- KIND RUN -->``."""

PLAYED = re.compile(rf"(?<=<!-- )({'|'.join(KINDS)}) (\w+)( -->\n).*?(?=<!-- end -->)", re.S)
"""This matches the table of a run in a page."""


def with_tables(page: str, tables: Sequence[str]) -> str:
    """Return a page with its tables, in their order, and those of the runs whose rows it names."""
    if len(places := TABLE.findall(page)) != len(tables):
        raise ValueError(f"{len(tables)} tables for {len(places)} places in the page")
    texts = iter(tables)

    def table_of(match: re.Match[str]) -> str:
        kind, name, end = match.groups()
        return f"{kind} {name}{end}{KINDS[kind](name)}"

    page = TABLE.sub(lambda _: next(texts), page)
    return PLAYED.sub(table_of, page)


def write(pages: Mapping[Path, Sequence[str]]) -> None:
    """Write the tables into their pages."""
    for page, tables in pages.items():
        page.write_text(with_tables(page.read_text(), tables))
