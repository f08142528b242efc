"""Tables in Markdown, made from rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from warmprior.diagnostics.source_leak import INNER_STEP_BOUND, LEAK_BOUND
from warmprior.diagnostics.statistics import (
    exceeds_one_sigma,
    paired_probability_better,
    probability_better,
    summarize_seeds,
)
from warmprior.experiments.labels import source_labels, space_of, with_space
from warmprior.experiments.paper import PAPER_CURVATURE, paper_success
from warmprior.experiments.results import Row, grouped, mean_known, select, success_summary
from warmprior.experiments.straightness import RATIOS, pooled

__all__ = ["curvature_table", "flow_table", "mean_cell", "success_cell", "success_table", "table"]

Cell = Callable[[list[Row]], str | None]
"""Makes a cell of the rows that belong to it; ``None`` where there is nothing to tell."""


def table(
    rows: Iterable[Row],
    index: Callable[[Row], str],
    columns: Callable[[Row], str] | None,
    cells: Mapping[str, Cell],
    *,
    head: str = "",
    notes: Iterable[str] = (),
) -> str:
    r"""A table, and what there is to say about it.

    With ``columns`` there is a line per value of the index and kind of cell, without them a line per value
    of the index and a column per kind of cell. Values have the order of their first rows; lines without
    any cell are left out.

    Args:
        rows: what to show.
        index: names the line of a row.
        columns: names its column.
        cells: the kinds of cells, by name.

    Keyword Args:
        head: of the first column.
        notes: lines below the table.

    See Also:
        - :func:`~warmprior.experiments.mean_cell`: a cell of means.
        - :func:`~warmprior.experiments.success_cell`: a cell of success rates.

    Examples:
        >>> rows = [Row({"H": h, "prior": p}, {"rate": r})
        ...         for h, p, r in [(1, "past", 0.5), (8, "past", 0.25), (8, "preview", 1.0)]]
        >>> print(table(rows, lambda r: f"H = {r['H']}", lambda r: r["prior"],
        ...             {"": mean_cell("rate", ".2f")}, notes=["Shares."]))
        |  | past | preview |
        |---|---|---|
        | H = 1 | 0.50 | - |
        | H = 8 | 0.25 | 1.00 |
        <BLANKLINE>
        Shares.
        <BLANKLINE>
    """
    rows = list(rows)
    groups, lines = grouped(rows, index), []
    if columns is None:
        names = list(cells)
        for name, group in groups.items():
            lines.append([name, *(cell(group) for cell in cells.values())])
    else:
        names = list(dict.fromkeys(map(columns, rows)))
        for name, group in groups.items():
            for kind, cell in cells.items():
                parts = {c: [row for row in group if columns(row) == c] for c in names}
                line = [cell(part) if part else None for part in parts.values()]
                if any(line):
                    lines.append([", ".join(filter(None, (name, kind))), *line])
    text = [[head, *names], ["---"] * (len(names) + 1), *lines]
    shown = [f"| {' | '.join('-' if c is None else c for c in line)} |" for line in text]
    shown[1] = "|" + "---|" * (len(names) + 1)
    notes = list(notes)
    return "\n".join([*shown, "", *notes] if notes else shown) + "\n"


def mean_cell(measure: str, form: str, scale: float = 1.0) -> Cell:
    """Mean and, over several rows, standard deviation of a measure; the rows are those of seeds.

    Args:
        measure: its name.
        form: format of the numbers.
        scale: what to multiply them with.

    See Also:
        - :func:`~warmprior.experiments.table`: takes it for its cells.
        - :func:`~warmprior.experiments.mean_known`: the mean alone.

    Examples:
        >>> mean_cell("steps", ".1f")([Row({"seed": 0}, {"steps": 3.0}), Row({"seed": 1}, {"steps": 5.0})])
        '4.0 ± 1.4'
    """

    def cell(rows: list[Row]) -> str | None:
        found = [row.get(measure) for row in rows if measure in row.measures]
        known = [scale * value for value in found if value is not None]
        if not known:
            return None
        summary, lost = summarize_seeds(known), len(found) - len(known)
        spread = "" if summary.seeds == 1 else f" ± {summary.std:{form}}"
        return f"{summary.mean:{form}}{spread}" + (f" ({lost} not finite)" if lost else "")

    return cell


def success_cell(top_k: int) -> Cell:
    """Success rate in percent, with one standard deviation over several seeds.

    Args:
        top_k: checkpoints averaged per seed.

    See Also:
        - :func:`~warmprior.experiments.table`: takes it for its cells.
        - :func:`~warmprior.experiments.success_summary`: the numbers alone.

    Examples:
        >>> success_cell(top_k=1)([Row({"seed": 0}, {"success_rate": 0.75})])
        '75.0'
    """

    def cell(rows: list[Row]) -> str:
        summary = success_summary(rows, top_k)
        spread = f" ± {100 * summary.std:.1f}" if summary.seeds > 1 else ""
        return f"{100 * summary.mean:.1f}{spread}"

    return cell


def last_checkpoints(rows: Sequence[Row]) -> list[Row]:
    """The rows of the last checkpoint of every training."""
    return [row for row in rows if row["checkpoint"] == row["iterations"]]


def source_at_nfe(rows: Sequence[Row]) -> Callable[[Row], str]:
    """Names the column of a row in tables that compare sources at several NFEs."""
    label = source_labels(rows)
    return lambda row: f"NFE {row['nfe']}: {label(row)}"


def success_table(
    rows: Sequence[Row], *, top_k: int, source: str | None, notes: Iterable[str] = ()
) -> str:
    """The layout of the paper's Table 1, with the paper's own numbers in lines of their own.

    Args:
        rows: evaluations with one sigma and chunk length per prior; the baseline's first.

    Keyword Args:
        top_k: checkpoints averaged per seed.
        source: of the demonstrations, if it is known: ``"official"`` stands beside the paper's as an equal.
        notes: further ones.

    See Also:
        - :class:`~warmprior.experiments.Comparison`: makes the rows.
        - :func:`~warmprior.experiments.paper_success`: the paper's numbers.
        - :func:`~warmprior.experiments.plot_success_bars`: the same as a figure.

    Examples:
        >>> from warmprior.experiments.results import played
        >>> facts = {"task": "lift", "data": "ph", "options": "", "sigma": 1.0, "chunk": 8, "seed": 0,
        ...          "iterations": 100, "checkpoint": 100, "nfe": 1}
        >>> rows = [played(facts | {"prior": prior}, [True] * wins + [False] * (10 - wins))
        ...         for prior, wins in {"gaussian": 5, "past": 8}.items()]
        >>> for line in success_table(rows, top_k=1, source="scripted").splitlines()[:3]:
        ...     print(line)
        | Success rate (%) | NFE 1: Base | NFE 1: WP-Past |
        |---|---|---|
        | Lift-PH, measured (scripted data) | 50.0 | **80.0** (+30.0) |
    """
    rows = select(rows, "success_rate")
    # In the order of the groups: all sources at one NFE side by side.
    label = source_labels(rows)
    base = label(rows[0])
    rows = sorted(rows, key=lambda row: -row["nfe"])

    def beside(row: Row) -> list[Row]:
        return select(_of_problem(rows, row), nfe=row["nfe"])

    def measured(cell: list[Row]) -> str:
        sources = grouped(beside(cell[0]), label)
        summaries = {name: success_summary(group, top_k) for name, group in sources.items()}
        mine, baseline = summaries[label(cell[0])], summaries.get(base)
        text = f"{100 * mine.mean:.1f}"
        if mine.mean == max(summary.mean for summary in summaries.values()):
            text = f"**{text}**"
        if baseline is None or mine is baseline:
            return text
        mark = "*" if exceeds_one_sigma(mine, baseline) else ""
        gain = round(100 * (mine.mean - baseline.mean), 1) + 0.0  # no minus before a zero
        return f"{text} ({gain:+.1f}{mark})"

    def better(cell: list[Row]) -> str | None:
        sources = grouped(last_checkpoints(beside(cell[0])), label)
        if label(cell[0]) == base or base not in sources:
            return None
        counts = (
            sum(row[name] for row in sources[source])
            for source in (label(cell[0]), base)
            for name in ("successes", "episodes")
        )
        return f"{probability_better(*counts):.2f}"

    def paired(cell: list[Row]) -> str | None:
        sources = grouped(last_checkpoints(beside(cell[0])), label)
        if label(cell[0]) == base or base not in sources:
            return None
        counts = wins_and_losses(sources[label(cell[0])], sources[base])
        return counts and f"{counts[0]} : {counts[1]} ({paired_probability_better(*counts):.2f})"

    def paper(cell: list[Row]) -> str | None:
        row = cell[0]
        place, seen = (row["task"], row["data"]), row.get("obs") or "state"
        value, baseline = (
            paper_success(*place, p, row["nfe"], row["chunk"], seen)
            for p in (row["prior"], "gaussian")
        )
        if value is None or baseline is None or row.get("options"):
            return None
        gain = "" if row["prior"] == "gaussian" else f" ({value - baseline:+.1f})"
        return f"{value:.1f}{gain}"

    return table(
        rows,
        problem_title,
        source_at_nfe(rows),
        {
            "measured" + (f" ({source} data)" if source else ""): measured,
            f"probability of being better than {base}": better,
            f"episodes that only it : only {base} solves (probability)": paired,
            "paper (official data)": paper,
            f"spread over draws of the source / data's (bound {LEAK_BOUND:g})": _bounded(
                "source_leak", LEAK_BOUND
            ),
            f"step inside chunks / data's (bound {INNER_STEP_BOUND:g})": _bounded(
                "inner_step_ratio", INNER_STEP_BOUND
            ),
            "memory gain (0: ignores what it did, 1: repeats it)": _memory_gain,
            "jump between chunks / step inside": _jump,
        },
        head="Success rate (%)",
        notes=[*_success_notes(rows, top_k, source, base), *notes],
    )


def wins_and_losses(mine: Iterable[Row], theirs: Iterable[Row]) -> tuple[int, int] | None:
    """Episodes that only one of two sources solves, over the training seeds that both have.

    Args:
        mine: rows of one source, one per training seed.
        theirs: of the other.

    Returns:
        Those that only the first solves and those that only the second does; ``None`` if the rows do not
        tell the outcomes of the same episodes.
    """
    others = {row["seed"]: row.outcomes for row in theirs}
    pairs = [(row.outcomes, others.get(row["seed"], "")) for row in mine]
    pairs = [(a, b) for a, b in pairs if a and len(a) == len(b)]
    if not pairs:
        return None
    episodes = [episode for a, b in pairs for episode in zip(a, b, strict=True)]
    return episodes.count(("1", "0")), episodes.count(("0", "1"))


def flow_table(rows: Sequence[Row]) -> str:
    """What the sources do to the flow, beside the first one: a line per problem and measure.

    Args:
        rows: evaluations with one sigma and chunk length per prior; the baseline's first. With the times of
            :meth:`Comparison.timed` it tells these as well.

    Examples:
        >>> facts = {"task": "lift", "data": "ph", "options": "", "sigma": 1.0, "chunk": 8, "seed": 0,
        ...          "iterations": 100, "checkpoint": 100, "nfe": 1}
        >>> rows = [Row({"prior": prior} | facts, {"kappa": kappa, "coverage": 0.9})
        ...         for prior, kappa in {"gaussian": 4.0, "past": 1.0}.items()]
        >>> for line in flow_table(rows).splitlines()[:4]:
        ...     print(line)
        | Flow of the executed positions | Base | WP-Past |
        |---|---|---|
        | Lift-PH, curvature / Base's | 1.00 | 0.25 |
        | Lift-PH, actions inside the source's 90% interval | 0.90 | 0.90 |
    """
    rows = last_checkpoints(select(rows, "kappa"))
    # They hold at any NFE: those of the largest of each policy.
    policies = grouped(
        rows, lambda row: tuple(row.facts[k] for k in sorted(row.facts) if k != "nfe")
    )
    rows = [max(group, key=lambda row: row["nfe"]) for group in policies.values()]
    label = source_labels(rows)
    base = label(rows[0])

    def relative(measure: str) -> Cell:
        def cell(cell: list[Row]) -> str | None:
            baseline = [row for row in _of_problem(rows, cell[0]) if label(row) == base]
            value, reference = mean_known(cell, measure), mean_known(baseline, measure)
            return None if value is None or not reference else f"{value / reference:.2f}"

        return cell

    return table(
        rows,
        problem_title,
        label,
        {
            f"curvature / {base}'s": relative("kappa"),
            f"curvature per squared mean velocity / {base}'s": relative("relative_curvature"),
            f"bound of the branching cost / {base}'s": relative("bound"),
            "actions inside the source's 90% interval": mean_cell("coverage", ".2f"),
            f"training time / {base}'s": relative("training_seconds"),
            "mean to demonstrated action": mean_cell("mean_error", ".3f"),
            "mean to prediction, demonstrated states": mean_cell("mean_revision_data", ".3f"),
            "mean to prediction, rollouts": mean_cell("mean_revision", ".3f"),
        },
        head="Flow of the executed positions",
        notes=[
            "- At the mean that decisions meet, on observations of the training data. Distances are root "
            "mean squares over its warm positions, in normalised action units, at the largest NFE."
        ],
    )


def problem_title(row: Row) -> str:
    """Task, style and, where they are not the usual ones, actions and observations, as tables show them."""
    title = f"{row['task'].replace('_', '-').title()}-{row['data'].upper()}"
    return with_space(title, row)


def _of_problem(rows: Iterable[Row], row: Row) -> list[Row]:
    """Those of the problem of a row."""
    return [other for other in rows if problem_title(other) == problem_title(row)]


def _jump(rows: list[Row]) -> str | None:
    last = last_checkpoints(rows)
    jump, step = mean_known(last, "boundary_jump"), mean_known(last, "inner_jump")
    return f"{jump / step:.2f}" if jump is not None and step else None


def _memory_gain(rows: list[Row]) -> str | None:
    return mean_cell("memory_gain", "z.3f")(last_checkpoints(rows))


def _bounded(measure: str, bound: float) -> Cell:
    """Mean of a measure over the seeds' last checkpoints, marked where it exceeds its bound."""

    def cell(rows: list[Row]) -> str | None:
        mean = mean_known(last_checkpoints(rows), measure)
        if mean is None:
            return None
        return f"{mean:.2f} (!)" if mean > bound else f"{mean:.2f}"

    return cell


def _success_notes(rows: Sequence[Row], top_k: int, source: str | None, base: str) -> list[str]:
    seeds = len({row["seed"] for row in rows})
    checkpoints = len({row["checkpoint"] for row in rows})
    chosen = (
        f"the best {min(top_k, checkpoints)} of {checkpoints} checkpoints"
        if checkpoints > 1
        else "the last checkpoint"
    )
    chunks = ", ".join(str(chunk) for chunk in dict.fromkeys(row["chunk"] for row in rows))
    notes = [
        f"- H = {chunks}; {seeds} seed(s); {max(row['episodes'] for row in rows)} episodes per cell; "
        f"{chosen} per seed. In parentheses the gain over {base}, in bold the best of each group.",
        "- `*` marks gains above the sum of both seed standard deviations (one-sigma rule)."
        if seeds > 1
        else "- One seed has no spread: no gain is marked. success.png shows the episodes' posterior.",
    ]
    if any(row.get("source_leak") is not None for row in rows):
        notes.append(
            "- Spread and steps tell how much of the source's noise reaches the actions (last checkpoints, "
            "training data): at or below the bound, none is seen. What exceeds it says more about the "
            "network's training than about the source."
        )
    if any(row.get("memory_gain") is not None for row in rows):
        notes.append(
            "- Memory gain: how much of a shift of what was done or forecast before reappears in the actions "
            "(last checkpoints, training data). It helps where that knows more than the observation, and "
            "carries the policy's own errors on."
        )
    if len({row["prior"] for row in rows}) > 1:
        notes.append(
            f"- Probability: of a higher success rate than {base}'s, given the episodes of all "
            "seeds' last checkpoints (Beta posteriors, uniform prior, episodes taken as independent); "
            "below it that of winning an episode which only one of the two solves, of the same training "
            "and episode seeds."
        )
    if source not in ("official", None):
        notes.append(
            "- The measured rows are from other demonstrations than the paper's, which are the official "
            "human ones: compare gains within a row, not numbers across rows."
        )
    return notes


def curvature_table(rows: Sequence[Row], facts: Mapping[str, Any], *, source: str) -> str:
    """The layout of the paper's Table 2, with the paper's own numbers in a line of their own.

    The paper's are for ``H = 8`` and relative to the Gaussian source; otherwise they are left out.

    Args:
        rows: of :func:`straightness`.
        facts: of the policies' problem, as results tell them.

    Keyword Args:
        source: what the observations are, in words.

    Examples:
        >>> facts = {"options": "", "sigma": 1.0, "chunk": 4, "seed": 0, "mean": "training"}
        >>> def row(prior, *ratio):  # with the ends of its interval
        ...     ends = zip(("", "_low", "_high"), ratio)
        ...     measures = {name + end: value for end, value in ends for name in RATIOS}
        ...     return Row(facts | {"policy": prior, "prior": prior}, measures | {"observations": 500})
        >>> rows = [row("gaussian", 1.0, 1.0, 1.0), row("past", 0.4, 0.3, 0.5)]
        >>> table = curvature_table(rows, {"task": "lift", "style": "ph"}, source="new demonstrations")
        >>> for line in table.splitlines()[:3]:
        ...     print(line)
        | curvature relative to the first column | Base | WP-Past |
        |---|---|---|
        | Lift-PH, whole prediction, training mean | 1.000 | 0.400 [0.300, 0.500] |
    """
    chosen = pooled(rows)
    first = chosen[0]
    task, data, space = facts["task"], facts["style"], space_of(facts)
    title = problem_title(Row({"task": task, "data": data, **space}, {}))

    def ratio(name: str, mean: str) -> Cell:
        def cell(rows: list[Row]) -> str | None:
            if not select(chosen, mean=mean):
                return None
            # A policy without a mean is the same at both.
            row = next(iter(select(rows, mean=mean)), rows[0])
            value, low, high = (row[name + end] for end in ("", "_low", "_high"))
            if value is None:
                return "no motion"
            interval = (
                "" if row["policy"] == first["policy"] or low is None else _interval(low, high)
            )
            return f"{value:.3f}{interval}"

        return cell

    def paper(rows: list[Row]) -> str | None:
        told = PAPER_CURVATURE.get((task, data))
        if told is None or "obs" in space or first["prior"] != "gaussian" or first["chunk"] != 8:
            return None
        value = {"gaussian": 1.0, **told}.get(rows[0]["prior"])
        return None if value is None else f"{value:.3f}"

    several = len({row["seed"] for row in rows} - {None})
    averaged = f", averaged over {several} training seeds" if several > 1 else ", one seed"
    return table(
        chosen,
        lambda row: title,
        source_labels(chosen),
        {
            f"{what}, {mean} mean": ratio(name, mean)
            for name, (_, what) in RATIOS.items()
            for mean in ("training", "deployed")
        }
        | {"paper (official data)": paper},
        head="curvature relative to the first column",
        notes=[
            f"- {first['observations']} observations of {source}{averaged}; in brackets 95% bootstrap "
            "intervals over episodes.",
            "- Deployed mean: made from the policy's own prediction one decision earlier. The paper does "
            "not say which mean it uses, nor whether it counts a prediction of 2H whole.",
            "- Curvature shrinks with the length of the transport; divided by the squared mean velocity "
            "it does not.",
        ],
    )


def _interval(low: float, high: float) -> str:
    return "" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]"
