"""The options of earlier runs: how they are recorded, read and compared."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from lab.demonstrations.data_options import resolved_place
from lab.options.options import Options, with_parts
from warmprior.io.files import read_json

OF_A_START = ("out", "resume", "workers", "videos", "logger", "engine", "ray_address")
"""Options that may differ each time a run is started, because they change no result."""


def recorded(options: Options) -> dict[str, Any]:
    """Return options as JSON, without those that may differ each time a run is started."""
    # Paths are absolute, so that a run can be resumed from another working directory.
    tree: dict[str, Any] = json.loads(json.dumps(asdict(options), default=resolved_place))
    for name in OF_A_START:
        del tree["run"][name]
    del tree["data"]["force_download"]
    return tree


_ABSENT = object()  # unequal to every option


def differences(one: Mapping[str, Any], two: Mapping[str, Any]) -> Iterator[str]:
    """Yield the options in which two records differ."""
    for name in one.keys() | two.keys():
        first, second = one.get(name, _ABSENT), two.get(name, _ABSENT)
        if isinstance(first, dict) and isinstance(second, dict):
            yield from differences(first, second)
        elif first != second:
            yield "--run" if name == "policies" else "--" + name.replace("_", "-")


def check_same(one: Options, two: Options, reason: str, alternative: str) -> None:
    """Raise ValueError, naming the options, if two sets of options differ."""
    if changed := sorted(set(differences(recorded(one), recorded(two)))):
        raise ValueError(f"{reason} {', '.join(changed)}: leave these out, or {alternative}")


def of_run(options: Options, run: Path) -> Options:
    """Return the options of a finished run, for the tasks, styles, chunks and methods that are asked for.

    All other options that determine its policies must equal the run's.

    Raises:
        ValueError: if one of them differs.
    """
    stored = stored_options(Options, run, None)
    # Policies do not depend on how long they are played.
    some: dict[str, dict[str, Any]] = {"data": {"horizon": options.data.horizon}}
    some["sources"] = {"prior": options.sources.prior}
    for part, name in (("data", "task"), ("data", "style"), ("sources", "chunk")):
        typed = getattr(getattr(options, part), name)
        if {*typed} <= {*getattr(getattr(stored, part), name)}:
            some[part][name] = typed
    stored = with_parts(stored, **some)
    stored_parts: Any = {part: getattr(stored, part) for part in ("data", "network", "training", "sources")}
    check_same(with_parts(options, **stored_parts), options, f"--run {run} has its own", "leave out --run")
    return with_parts(stored, run={"out": run})


def stored_options[O: Options](kind: type[O], out: Path, study: str | None) -> O:
    """Return the options of the run in a folder; without a study, only those that all studies share."""
    path = out / "options.json"
    if not path.is_file():
        raise ValueError(f"there is no run in {out}: name its folder")
    stored = read_json(path)
    if not isinstance(stored, dict):
        raise ValueError(f"{path} is damaged: it is no JSON object")
    stored_study = stored.get("study")
    if study not in (None, stored_study):
        raise ValueError(
            f"{path} holds a run of {stored_study}: continue it with that script, or choose another --out"
        )
    tree: Any = stored.get("options")
    if study is None and isinstance(tree, dict):
        tree = {part: value for part, value in tree.items() if part in {f.name for f in fields(kind)}}
    try:
        options = from_record(kind, tree)
        if changed := sorted(set(differences(recorded(options), tree))):
            raise ValueError(f"it differs in {', '.join(changed)}")
    except ValueError as error:
        reason = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            place = ".".join(map(str, ("options", *first["loc"])))
            reason = f"{place}: {first['msg'].removeprefix('Value error, ')}"
        raise ValueError(f"{path} is damaged, or of another version: {reason}") from error
    return options


def from_record[O: Options](kind: type[O], tree: Any) -> O:
    """Invert :func:`recorded`; raise ValueError for a value of another type."""
    return TypeAdapter(kind).validate_json(json.dumps(tree), strict=True)


def check_typed(stored: Options, out: Path, importable: Sequence[str]) -> None:
    """Raise ValueError if stored options name a class that may not be imported."""
    for name in (*stored.sources.prior, *stored.data.task, stored.network.network):
        if ":" in name and name not in importable:
            raise ValueError(f"{out} uses {name}: name it again, with --prior, --network or --task as before")
