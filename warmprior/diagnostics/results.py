"""Measured success rates: rows on disk, and the table of the paper made from them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from warmprior.diagnostics._figure import prior_label
from warmprior.diagnostics.paper import paper_success
from warmprior.diagnostics.source_leak import INNER_STEP_BOUND, LEAK_BOUND
from warmprior.diagnostics.statistics import (
    SeedSummary,
    exceeds_one_sigma,
    summarize_seeds,
    top_k_mean,
)
from warmprior.diagnostics.table import markdown_table
from warmprior.io.files import as_json, read_json, write_atomic

__all__ = [
    "Results",
    "Row",
    "success_table",
    "summarize",
    "summarize_cell",
    "write_results",
]


@dataclass(frozen=True)
class Row:
    """One evaluation of one checkpoint.

    Attributes:
        task: short task name.
        data: ``"ph"`` or ``"mh"``.
        prior: name of the source distribution.
        sigma: its residual noise.
        chunk: ``H``.
        nfe: network evaluations per chunk.
        seed: training seed.
        checkpoint: iteration of the policy.
        episodes: how many were played.
        successes: how many succeeded.
        mean_steps: mean number of control steps of an episode.
        boundary_jump: mean distance between the last action of a chunk and the first of the next, in
            normalised action units; ``None`` if no episode has two chunks.
        inner_jump: mean distance between consecutive actions inside chunks; ``None`` at ``H = 1``.
        source_leak: :attr:`SourceLeak.leak` of the policy on training data; ``None`` if not measured.
        inner_step_ratio: :attr:`SourceLeak.inner_step_ratio`, likewise; ``None`` also at ``H = 1``.
    """

    task: str
    data: str
    prior: str
    sigma: float
    chunk: int
    nfe: int
    seed: int
    checkpoint: int
    episodes: int
    successes: int
    mean_steps: float
    boundary_jump: float | None = None
    inner_jump: float | None = None
    source_leak: float | None = None
    inner_step_ratio: float | None = None

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.episodes

    def record(self) -> dict[str, Any]:
        """The row as it is stored."""
        return asdict(self) | {"success_rate": self.success_rate}

    @property
    def cell(self) -> tuple[Any, ...]:
        """What was evaluated, without the outcome."""
        return (
            self.task,
            self.data,
            self.prior,
            self.sigma,
            self.chunk,
            self.nfe,
            self.seed,
            self.checkpoint,
            self.episodes,
        )


class Results:
    """``results.json``: facts about the run and one row per evaluation, saved after every row.

    Args:
        path: the file.
        meta: facts about the run.
        resume: keep the rows that the file has.
        identity: entries of ``meta`` that must be those of the file to resume.

    Raises:
        ValueError: if the file to resume is damaged or belongs to a run with another identity.
    """

    def __init__(
        self,
        path: str | Path,
        meta: dict[str, Any],
        *,
        resume: bool = False,
        identity: Sequence[str] = (),
    ) -> None:
        self.path = Path(path)
        self.meta = meta
        self.rows: list[Row] = []
        #: Further lists of rows to save beside these, by name.
        self.extra: dict[str, list[dict[str, Any]]] = {}
        if resume and self.path.exists():
            stored = read_json(self.path)
            try:
                theirs = {key: stored["meta"][key] for key in identity}
                self.meta = meta | {"wall_time_s": float(stored["meta"].get("wall_time_s", 0.0))}
                self.rows = _read_rows(stored["rows"])
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                reason = str(error) if type(error) is ValueError else repr(error)
                raise ValueError(
                    f"{self.path} is not a results file of this version: {reason}"
                ) from error
            mine = as_json({key: meta[key] for key in identity})  # as the stored values went
            for key in identity:
                if theirs[key] != mine[key]:
                    raise ValueError(
                        f"{self.path} was made with other options: its {key} is {theirs[key]}, here it "
                        f"is {mine[key]}. Give the same options, or another output folder."
                    )

    def find(self, cell: tuple[Any, ...]) -> Row | None:
        """The row of a cell (see :attr:`Row.cell`), if it was evaluated already."""
        return next((row for row in self.rows if row.cell == cell), None)

    def add(self, row: Row, order: Sequence[tuple[Any, ...]] = ()) -> None:
        """Add a row and save.

        Args:
            row: the new one.
            order: of the cells, whose rows come first; by default the row comes last.
        """
        self.rows.append(row)
        places = {cell: place for place, cell in enumerate(order)}
        self.rows.sort(key=lambda row: places.get(row.cell, len(places)))
        self.save()

    def save(self) -> None:
        """Write the file atomically."""
        write_results(self.path, self.meta, (row.record() for row in self.rows), **self.extra)


def _read_rows(records: list[dict[str, Any]]) -> list[Row]:
    """Rows as they are stored, after checking that they can have been measured.

    Raises:
        ValueError: naming the row and the entry, from 0 on.
    """
    rows: list[Row] = []
    for i, record in enumerate(records):
        try:
            rest = dict(record)
            rate = rest.pop("success_rate")
            row = Row(**rest)
            _check(row, rate)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"row {i}: {error}") from error
        same = next((j for j, other in enumerate(rows) if other.cell == row.cell), None)
        if same is None:
            rows.append(row)
        elif row != rows[same]:
            raise ValueError(f"row {i} contradicts row {same}; remove the wrong one")
    return rows


_LEAST = {"chunk": 1, "nfe": 1, "seed": 0, "checkpoint": 0, "episodes": 1, "successes": 0}
_OPTIONAL = ("boundary_jump", "inner_jump", "source_leak", "inner_step_ratio")


def _check(row: Row, rate: Any) -> None:
    def number(value: Any) -> bool:
        return isinstance(value, int | float) and math.isfinite(value) and value >= 0

    wrong = [name for name in ("task", "data", "prior") if not isinstance(getattr(row, name), str)]
    for name, least in _LEAST.items():
        value = getattr(row, name)
        wrong += [] if type(value) is int and value >= least else [name]
    for name in ("sigma", "mean_steps", *_OPTIONAL):
        value = getattr(row, name)
        wrong += [] if number(value) or (value is None and name in _OPTIONAL) else [name]
    if wrong:
        raise ValueError(f"{wrong[0]} cannot be {getattr(row, wrong[0])!r}")
    if row.successes > row.episodes:
        raise ValueError(f"{row.successes} successes in {row.episodes} episodes")
    if not number(rate) or not math.isclose(rate, row.success_rate):
        raise ValueError(f"its success_rate is {rate!r}, not {row.success_rate}")


def write_results(
    path: str | Path,
    meta: dict[str, Any],
    rows: Iterable[dict[str, Any]],
    **extra: Iterable[dict[str, Any]],
) -> None:
    """Write a results file atomically; what is NaN or infinite becomes ``null``, as JSON demands.

    Args:
        path: of the file.
        meta: facts about the run.
        rows: one per measurement.
        extra: further lists of rows.
    """

    def clean(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
        return [
            {
                k: None if isinstance(v, float) and not math.isfinite(v) else v
                for k, v in row.items()
            }
            for row in rows
        ]

    lists = {name: clean(part) for name, part in {"rows": rows, **extra}.items()}
    text = json.dumps({"meta": meta, **lists}, indent=1) + "\n"
    write_atomic(Path(path), lambda temporary: temporary.write_text(text))


def summarize(rows: Iterable[Row], top_k: int) -> dict[tuple[str, int], SeedSummary]:
    """Average the best ``top_k`` checkpoints per seed, then summarise over seeds.

    Args:
        rows: of one task, data and chunk length.
        top_k: how many checkpoints to average.

    Returns:
        ``{(prior, nfe): summary of success rates}``.
    """
    cells: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        cells.setdefault((row.prior, row.nfe), []).append(row)
    return {cell: summarize_cell(members, top_k) for cell, members in cells.items()}


def summarize_cell(rows: Sequence[Row], top_k: int) -> SeedSummary:
    """Average the best ``top_k`` checkpoints per seed, then summarise over seeds, of one cell.

    Args:
        rows: of one prior, sigma, chunk length and NFE.
        top_k: how many checkpoints to average.

    Raises:
        ValueError: if there is no row.
    """
    by_seed: dict[int, list[float]] = {}
    for row in rows:
        by_seed.setdefault(row.seed, []).append(row.success_rate)
    return summarize_seeds([top_k_mean(rates, top_k) for rates in by_seed.values()])


def _cell(summary: SeedSummary | None, base: SeedSummary | None, best: bool) -> str:
    if summary is None:
        return "-"
    text = f"{100 * summary.mean:.1f}"
    text = f"**{text}**" if best else text
    if base is None or summary is base:
        return text
    mark = "*" if exceeds_one_sigma(summary, base) else ""
    gain = round(100 * (summary.mean - base.mean), 1) + 0.0  # no minus before a zero
    return f"{text} ({gain:+.1f}{mark})"


def _paper_cell(row: Row, prior: str, nfe: int) -> str:
    value, base = (
        paper_success(row.task, row.data, p, nfe, row.chunk) for p in (prior, "gaussian")
    )
    if value is None or base is None:
        return "-"
    return f"{value:.1f}" if prior == "gaussian" else f"{value:.1f} ({value - base:+.1f})"


def success_table(
    results: Results, *, priors: Sequence[str], nfes: Sequence[int], top_k: int
) -> str:
    """The layout of the paper's Table 1 in Markdown, with the paper's own numbers in a row of their own.

    Args:
        results: rows of one task, data and chunk length; ``meta["data_source"]`` says where the
            demonstrations come from.

    Keyword Args:
        priors: columns, the baseline first.
        nfes: column groups.
        top_k: checkpoints averaged per seed.
    """
    meta, summaries = results.meta, summarize(results.rows, top_k)
    first = results.rows[0]
    columns = [(nfe, prior) for nfe in nfes for prior in priors]
    head = ["Success rate (%)"] + [f"NFE {nfe}: {prior_label(p)}" for nfe, p in columns]
    measured = []
    for nfe, prior in columns:
        group = [s for p in priors if (s := summaries.get((p, nfe))) is not None]
        summary, base = summaries.get((prior, nfe)), summaries.get((priors[0], nfe))
        best = summary is not None and summary.mean == max(s.mean for s in group)
        measured.append(_cell(summary, base, best))
    name = f"{first.task.replace('_', '-').title()}-{first.data.upper()}"
    source = meta["data_source"]
    lines = [[f"{name}, measured ({source} data)", *measured]]
    reported = [_paper_cell(first, prior, nfe) for nfe, prior in columns]
    if any(cell != "-" for cell in reported):
        lines.append([f"{name}, paper (official data)", *reported])
    for name, field, bound in (
        ("spread over draws of the source / data's", "source_leak", LEAK_BOUND),
        ("step inside chunks / data's", "inner_step_ratio", INNER_STEP_BOUND),
    ):
        cells = [_bounded(results.rows, prior, nfe, field, bound) for nfe, prior in columns]
        if any(cell != "-" for cell in cells):
            lines.append([f"{name} (bound {bound:g})", *cells])
    return markdown_table(head, lines, _notes(results, summaries, top_k))


def _bounded(rows: Sequence[Row], prior: str, nfe: int, field: str, bound: float) -> str:
    """Mean of a measure over the seeds' last checkpoints, marked where it exceeds its bound."""
    last = max(row.checkpoint for row in rows)
    cell = [row for row in rows if (row.prior, row.nfe, row.checkpoint) == (prior, nfe, last)]
    values = [value for row in cell if (value := getattr(row, field)) is not None]
    if not values:
        return "-"
    mean = math.fsum(values) / len(values)
    return f"{mean:.2f} (!)" if mean > bound else f"{mean:.2f}"


def _notes(results: Results, summaries: dict[Any, SeedSummary], top_k: int) -> list[str]:
    seeds = max(summary.seeds for summary in summaries.values())
    episodes = {row.episodes for row in results.rows}
    checkpoints = len({row.checkpoint for row in results.rows})
    chosen = (
        f"the best {min(top_k, checkpoints)} of {checkpoints} checkpoints"
        if checkpoints > 1
        else "the last checkpoint"
    )
    notes = [
        f"- H = {results.rows[0].chunk}; {seeds} seed(s); {max(episodes)} episodes per cell; {chosen} "
        "per seed. In parentheses the gain over the first column of each group, in bold the best.",
        "- `*` marks gains above the sum of both seed standard deviations (one-sigma rule)."
        if seeds > 1
        else "- One seed has no spread: no gain is marked. success.png shows the episodes' posterior.",
    ]
    measured = [row for row in results.rows if row.source_leak is not None]
    if measured:
        notes.append(
            "- Spread and steps tell how much of the source's noise reaches the actions (last checkpoints, "
            "training data): at or below the bound, none is seen. What exceeds it says more about the "
            "network's training than about the source."
        )
    short = [prior_label(name) for name in results.meta.get("short_of_training", ())]
    if short:
        notes.append(
            f"- {', '.join(short)}: short of training. Success still rises with more iterations than "
            "these (docs/evidence.md, 'Training budget')."
        )
    if results.meta["data_source"] != "official":
        notes.append(
            "- The measured row is from other demonstrations than the paper's, which are the official "
            "human ones: compare gains within a row, not numbers across rows."
        )
    if results.meta.get("options", {}).get("preset") != "paper":
        notes.append("- Network and training budget are smaller than the paper's.")
    return notes
