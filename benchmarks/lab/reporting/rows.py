"""Rows of results, written, and checked when they are read.

A row is one JSON object in a file of lines. Its columns are defined in `columns.py`; their formats say their
types. `write_rows` writes the file: for `compare` (`running/comparison.py`) once a row's episodes are played,
and for `prior_space_rl.py`, `navigation1d.py` and `budget.py`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lab.reporting.columns import IDENTITY, column
from warmprior.io.files import check_regular, write_atomic

RESULTS = "results.jsonl"
"""The file of a run with a row per evaluation."""

COUNTED = ("episodes", "successes", "success_rate")
"""Every row of played episodes has these columns."""

REQUIRED = ("sigma", *COUNTED)
"""Numbers that are never null."""

METHOD = ("task", "data", "prior", "options", "sigma", "chunk", "seed", "nfe")

PLAYED = (*METHOD, "temperature", "policy", "iterations", "checkpoint", *COUNTED, "outcomes")
"""A row of a policy has these columns: `policies.row` makes them."""

AGENT = (*METHOD, "algorithm", "centre", "delta", "evaluation", "environment_steps", *COUNTED)
"""A row of an agent's evaluation has these columns."""


def read_rows(
    path: Path, needed: Sequence[str] = (), whose: str = "a run of this script"
) -> list[dict[str, Any]]:
    """Read rows that have the `needed` columns; a ``ValueError`` names the file and the line of a bad row.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from lab.reporting.rows import read_rows
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "results.jsonl"
        ...     _ = path.write_text('{"seed": 0, "nfe": "nine"}')
        ...     read_rows(path)
        Traceback (most recent call last):
            ...
        ValueError: ...results.jsonl, line 1: nfe is 'nine', not a whole number: remove that line, ...
    """
    rows, first_lines = read_lines(path), dict[tuple[Any, ...], int]()
    for number, row in enumerate(rows, 1):
        try:
            _check(row, needed, whose)
            identity = tuple(row.get(name) for name in IDENTITY)
            if first_lines.setdefault(identity, number) != number:
                raise ValueError(f"it repeats line {first_lines[identity]}")
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number}: {error}: remove that line, and continue with --resume"
            ) from error
    return rows


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read a file of JSON objects, one per line; a ``ValueError`` names a damaged line."""
    check_regular(path)
    records = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            records.append(json.loads(line))
            if not isinstance(records[-1], dict):
                raise ValueError("it is no JSON object")
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"{path}, line {number} is damaged ({error}): remove that line, and continue with --resume"
            ) from error
    return records


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Write or replace a file of rows, and return it as a table."""
    # JSON has no NaN, so null stands for it.
    finite = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        for row in rows
    ]
    text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in finite)
    write_atomic(path, lambda path: path.write_text(text))
    return pd.DataFrame(read_rows(path))


def _check(row: Mapping[str, Any], needed: Iterable[str], whose: str) -> None:
    if missing := [name for name in needed if name not in row]:
        raise ValueError(f"it has no {', '.join(missing)}, so it is no row of {whose}")
    for name, value in row.items():
        try:
            form = column(name).form
        except KeyError:
            raise ValueError(f"it has a column {name!r} that columns.py does not define") from None
        # Null stands for a measure that could not be taken, and for the seed of a mean over several.
        null = "mean" in row if name == "seed" else form not in ("", "d") and name not in REQUIRED
        if not (_fits(value, form) or (null and value is None)):
            words = {"": "text", "d": "a whole number"}.get(form, "a finite number")
            raise ValueError(f"{name} is {value!r}, not {words}")
    if any(name in row for name in COUNTED):
        if missing := [name for name in (*COUNTED, "seed") if name not in row]:
            raise ValueError(f"it has no {', '.join(missing)}")
        won, played, outcomes = row["successes"], row["episodes"], row.get("outcomes")
        if not 0 <= won <= played or played < 1 or abs(row["success_rate"] - won / played) > 1e-9:
            raise ValueError(f"{won} successes in {played} episodes are no rate of {row['success_rate']}")
        if outcomes is not None and sorted(outcomes) != ["0"] * (played - won) + ["1"] * won:
            raise ValueError(f"outcomes {outcomes!r} do not have {won} successes in {played} episodes")


def _fits(value: Any, form: str) -> bool:
    """Return whether a value has the type that a column's format says."""
    if form == "":
        return isinstance(value, str)
    number = int if form == "d" else (int, float)
    return isinstance(value, number) and not isinstance(value, bool) and math.isfinite(value)
