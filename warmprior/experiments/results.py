"""What was measured: rows on disk, and their averages over checkpoints and seeds."""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from warmprior.diagnostics.statistics import SeedSummary, summarize_seeds, top_k_mean
from warmprior.io.files import read_json, write_atomic
from warmprior.training.checkpoint import check_identity

__all__ = [
    "Results",
    "Row",
    "facts_of_machine",
    "grouped",
    "mean_known",
    "played",
    "read_results",
    "select",
    "success_summary",
]

Fact = str | int | float | bool | None


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        facts: what was measured: task, prior, seed, ...
        measures: what came out; ``None`` where it is not known, as JSON has no NaN.
        outcomes: of the episodes played, a character each in the order of their seeds: ``1`` if solved,
            else ``0``. Rows of the same seeds compare episode by episode.

    See Also:
        :class:`~warmprior.experiments.Results`: the file of rows.

    Examples:
        >>> row = Row({"prior": "past"}, {"success_rate": 0.5, "kappa": float("nan")})
        >>> row["prior"], row["success_rate"], row["kappa"]
        ('past', 0.5, None)
    """

    facts: Mapping[str, Fact]
    measures: Mapping[str, float | None]
    outcomes: str = ""

    def __post_init__(self) -> None:
        known = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in self.measures.items()
        }
        object.__setattr__(self, "measures", known)

    def __getitem__(self, name: str) -> Any:
        return self.facts[name] if name in self.facts else self.measures[name]

    def get(self, name: str) -> Any:
        """A fact or measure; ``None`` if the row has none of this name."""
        return self.facts.get(name, self.measures.get(name))


def played(facts: Mapping[str, Fact], outcomes: Sequence[bool], **measures: Any) -> Row:
    """The row of an evaluation by episodes.

    Args:
        facts: of the row.
        outcomes: whether each episode succeeded, in the order of their seeds.
        measures: further ones.

    Examples:
        >>> row = played({"prior": "past"}, [True, False, True, True])
        >>> row["success_rate"], row.outcomes
        (0.75, '1011')
    """
    episodes, successes = len(outcomes), sum(outcomes)
    counts = {"episodes": episodes, "successes": successes, "success_rate": successes / episodes}
    return Row(facts, counts | measures, "".join("01"[solved] for solved in outcomes))


def select(rows: Iterable[Row], measure: str | None = None, **facts: Fact) -> list[Row]:
    """The rows that have a measure (known or not) and some facts.

    Args:
        rows: of any kind.
        measure: its name; any by default.
        facts: by name.

    See Also:
        :func:`~warmprior.experiments.grouped`: gathers what is found.

    Examples:
        >>> rows = [Row({"prior": p, "seed": s}, {"kappa": s + 0.5}) for p in "ab" for s in (0, 1)]
        >>> [row["kappa"] for row in select(rows, "kappa", prior="b")]
        [0.5, 1.5]
    """
    return [
        row
        for row in rows
        if (measure is None or measure in row.measures)
        and all(name in row.facts and row.facts[name] == value for name, value in facts.items())
    ]


def grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Rows by what a function makes of them, in the order of their first.

    See Also:
        - :func:`~warmprior.experiments.select`: narrows the rows first.
        - :func:`~warmprior.experiments.table`: draws groups as lines and columns.

    Examples:
        >>> rows = [Row({"prior": p, "seed": s}, {"kappa": s + 0.5}) for s in (0, 1) for p in "ba"]
        >>> {prior: len(found) for prior, found in grouped(rows, lambda row: row["prior"]).items()}
        {'b': 2, 'a': 2}
    """
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def mean_known(rows: Iterable[Row], measure: str) -> float | None:
    """Mean of a measure over the rows that know it; ``None`` if none does.

    See Also:
        :func:`~warmprior.experiments.mean_cell`: writes it into a table.

    Examples:
        >>> mean_known([Row({}, {"kappa": 1.0}), Row({}, {"kappa": None}), Row({}, {"kappa": 3.0})], "kappa")
        2.0
    """
    values = [value for row in rows if (value := row.get(measure)) is not None]
    return math.fsum(values) / len(values) if values else None


def success_summary(rows: Iterable[Row], top_k: int) -> SeedSummary:
    """Average the best ``top_k`` checkpoints per seed, then summarise over seeds.

    Args:
        rows: of one cell: they differ in seed and checkpoint alone.
        top_k: how many checkpoints to average.

    Raises:
        ValueError: if there is no row.

    See Also:
        - :func:`~warmprior.diagnostics.top_k_mean`: the mean of one seed.
        - :func:`~warmprior.diagnostics.summarize_seeds`: mean and spread over seeds.

    Examples:
        >>> rates = {(0, 10): 0.5, (0, 20): 0.7, (1, 10): 0.9, (1, 20): 0.1}
        >>> rows = [
        ...     Row({"seed": seed, "checkpoint": after}, {"success_rate": rate})
        ...     for (seed, after), rate in rates.items()]
        >>> success_summary(rows, top_k=1)
        SeedSummary(mean=0.8, std=0.1414..., seeds=2)
    """
    by_seed: dict[int, list[float]] = {}
    for row in rows:
        by_seed.setdefault(row["seed"], []).append(row["success_rate"])
    return summarize_seeds([top_k_mean(rates, top_k) for rates in by_seed.values()])


def facts_of_machine(**more: Any) -> dict[str, Any]:
    """Versions and hardware, as every results file tells them.

    Args:
        more: about the hardware.
    """
    versions = {"python": platform.python_version()}
    packages = (
        "warmprior",
        "torch",
        "torchrl",
        "tensordict",
        "robosuite",
        "mujoco",
        "numpy",
        "lerobot",
    )
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue  # an extra that this run does without
    hardware = {"machine": platform.machine(), "cores": os.cpu_count(), **more}
    if torch.cuda.is_available():
        hardware["gpu"] = torch.cuda.get_device_name()
    return {"versions": versions, "hardware": hardware}


class Results:
    """``results.json``: facts about the run and its rows, saved after every row.

    Args:
        path: the file.
        meta: facts about the run.
        identity: what must be equal in a file that is continued.
        resume: keep the rows that the file has.

    Raises:
        ValueError: if the file to resume is damaged, or belongs to a run with another identity or one whose
            policies were trained by other versions.

    See Also:
        - :class:`~warmprior.experiments.Row`: what it holds.
        - :func:`~warmprior.experiments.select`: finds rows.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     results = Results(Path(folder) / "results.json", {"machine": "mine"}, {"study": "noise"})
        ...     for steps in (120, 90):  # the second is the same measurement, made again
        ...         results.add(Row({"prior": "past", "seed": 0}, {"mean_steps": steps}))
        ...     meta, rows = read_results(results.path)
        >>> meta["identity"], [row["mean_steps"] for row in rows]
        ({'study': 'noise'}, [90])
    """

    def __init__(
        self,
        path: str | Path,
        meta: Mapping[str, Any],
        identity: Mapping[str, Any],
        *,
        resume: bool = False,
    ) -> None:
        self.path = Path(path)
        self.meta: dict[str, Any] = {**meta, "identity": identity, "wall_time_s": 0.0}
        self.rows: list[Row] = []
        self._started = time.monotonic()
        if resume and self.path.exists():
            theirs, self.rows = read_results(self.path)
            check_identity(self.path, theirs["identity"], identity)
            _check_policies(self.path, theirs, self.meta)
            self._started -= float(theirs["wall_time_s"])

    def find(self, facts: Mapping[str, Fact]) -> Row | None:
        """The row with exactly these facts, if there is one."""
        return next((row for row in self.rows if row.facts == facts), None)

    def add(self, *rows: Row, order: Callable[[Row], Any] | None = None) -> None:
        """Add rows, in place of those with the same facts, and save.

        Args:
            rows: new ones.
            order: sorts all rows; by default the new ones come last.
        """
        for row in rows:
            self.rows = [old for old in self.rows if old.facts != row.facts]
            self.rows.append(row)
        if order is not None:
            self.rows.sort(key=order)
        self.save()

    def save(self) -> None:
        """Write the file atomically."""
        self.meta["wall_time_s"] = time.monotonic() - self._started
        rows = [_stored(row) for row in self.rows]
        text = json.dumps({"meta": self.meta, "rows": rows}, indent=1, allow_nan=False) + "\n"
        write_atomic(self.path, lambda temporary: temporary.write_text(text))


def _check_policies(path: Path, theirs: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Refuse to continue a run whose policies would all be trained anew, beside rows of the old ones."""

    def folders(meta: Mapping[str, Any]) -> set[Any]:
        return {policy["folder"] for policy in meta.get("policies", ()) if "folder" in policy}

    if folders(theirs) <= folders(mine):
        return
    before, now = (
        {"warmprior": "?", "torch": "?", **m.get("versions", {})} for m in (theirs, mine)
    )
    changed = [name for name in ("warmprior", "torch") if before[name] != now[name]]
    told = " and ".join(f"{name} {before[name]}, not {now[name]}" for name in changed)
    raise ValueError(
        f"{path} was begun with {told or 'another build of this version'}: other policies would be "
        "trained now. Finish it with the versions it was begun with, or begin anew with another --out"
    )


def read_results(path: Path) -> tuple[dict[str, Any], list[Row]]:
    """Read a results file.

    Args:
        path: of the file.

    Returns:
        Facts about the run, and its rows.

    Raises:
        ValueError: if it is damaged or of another version.
    """
    stored = read_json(path)
    try:
        meta = stored["meta"]
        float(meta["wall_time_s"]), dict(meta["identity"])
        return meta, _read_rows(stored["rows"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        reason = str(error) if type(error) is ValueError else repr(error)
        raise ValueError(f"{path} is not a results file of this version: {reason}") from error


def _stored(row: Row) -> dict[str, Any]:
    """A row as JSON holds it."""
    stored: dict[str, Any] = {"facts": dict(row.facts), "measures": dict(row.measures)}
    return stored | {"outcomes": row.outcomes} if row.outcomes else stored


def _read_rows(records: Sequence[Any]) -> list[Row]:
    """Rows as they are stored, after checking that they can have been measured.

    Raises:
        ValueError: naming the row and the entry, from 0 on.
    """
    rows: list[Row] = []
    for i, stored in enumerate(records):
        try:
            if set(stored) | {"outcomes"} != {"facts", "measures", "outcomes"}:
                raise ValueError(f"it has {sorted(stored)} instead of facts and measures")
            row = Row(**stored)
            _check(row)
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"row {i}: {error}") from error
        same = next((j for j, other in enumerate(rows) if other.facts == row.facts), None)
        if same is not None and row != rows[same]:
            raise ValueError(f"row {i} contradicts row {same}; remove the wrong one")
        if same is None:
            rows.append(row)
    return rows


_TEXTS = ("task", "data", "prior", "options", "guidance")
_COUNTS = {"chunk": 1, "nfe": 1, "seed": 0, "iterations": 1, "checkpoint": 0, "episodes": 1}
_COUNTS |= {"successes": 0, "execute": 1, "delay": 0}
_NOT_NEGATIVE = ("sigma", "mean_steps", "boundary_jump", "inner_jump", "source_leak")


def _check(row: Row) -> None:
    """Refuse what cannot have been measured."""

    def number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    entries: dict[str, Any] = {**row.facts, **row.measures}
    for name, value in entries.items():
        fact = name in row.facts
        if name in _TEXTS:
            fine = isinstance(value, str)
        elif name in _COUNTS:
            pooled = name == "seed" and value is None
            fine = pooled or (type(value) is int and value >= _COUNTS[name])
        elif name in _NOT_NEGATIVE:
            fine = (value is None and not fact) or (number(value) and value >= 0)
        else:
            fine = value is None or number(value) or (fact and isinstance(value, str | bool))
        if not fine:
            raise ValueError(f"{name} cannot be {value!r}")
    if "success_rate" in row.measures:
        successes, episodes, rate = (
            row.get(name) for name in ("successes", "episodes", "success_rate")
        )
        if None in (successes, episodes, rate) or successes > episodes:
            raise ValueError(f"{successes} successes in {episodes} episodes")
        if not math.isclose(rate, successes / episodes):
            raise ValueError(f"its success_rate is {rate!r}, not {successes / episodes}")
    if not isinstance(row.outcomes, str) or row.outcomes.strip("01"):
        raise ValueError(f"outcomes cannot be {row.outcomes!r}")
    counted = len(row.outcomes), row.outcomes.count("1")
    if row.outcomes and counted != (row.get("episodes"), row.get("successes")):
        raise ValueError(
            f"its outcomes are {counted[1]} successes in {counted[0]} episodes, its counts "
            f"{row.get('successes')} in {row.get('episodes')}"
        )
