"""The options of runs that were started before: how they are recorded, read and compared."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from lab.options import Options, with_parts
from lab.tasks import (
    resolved_place,
)
from warmprior.io.files import read_json

OF_A_START = ("out", "resume", "envs", "videos", "logger", "engine", "ray_address")
"""Options of a run that may differ each time it is started: they change no result."""


def recorded(options: Options) -> dict[str, Any]:
    """Options as JSON holds them, without those of a start."""
    # A path is that of the same file from another working directory.
    tree: dict[str, Any] = json.loads(json.dumps(asdict(options), default=resolved_place))
    for name in OF_A_START:
        del tree["run"][name]
    del tree["data"]["force_download"]
    return tree


_ABSENT = object()  # no option is this


def differences(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> Iterator[str]:
    """The options in which two records differ."""
    for name in mine.keys() | theirs.keys():
        one, two = mine.get(name, _ABSENT), theirs.get(name, _ABSENT)
        if isinstance(one, dict) and isinstance(two, dict):
            yield from differences(one, two)
        elif one != two:
            yield "--run" if name == "policies" else "--" + name.replace("_", "-")


def check_same(one: Options, two: Options, said: str, otherwise: str) -> None:
    """Refuse options that differ where a run has its own."""
    if changed := sorted(set(differences(recorded(one), recorded(two)))):
        raise ValueError(f"{said} {', '.join(changed)}: leave these out, or {otherwise}")


def of_run(options: Options, run: Path) -> Options:
    """The options of a finished run, with those of its tasks, styles, chunks and methods that are asked for.

    Whatever else determines its policies has to be as in the run.
    """
    stored = stored_options(Options, run, None)
    some: dict[str, dict[str, Any]] = {"data": {}, "sources": {"prior": options.sources.prior}}
    for part, name in (("data", "task"), ("data", "data"), ("sources", "chunk")):
        asked = getattr(getattr(options, part), name)
        if {*asked} <= {*getattr(getattr(stored, part), name)}:
            some[part][name] = asked
    stored = with_parts(stored, **some)
    theirs: Any = {part: getattr(stored, part) for part in ("data", "network", "training", "sources")}
    same = with_parts(options, **theirs, run={"compile": stored.run.compile})
    check_same(same, options, f"--run {run} has its own", "leave out --run")
    return with_parts(stored, run={"out": run})


def stored_options[O: Options](kind: type[O], out: Path, study: str | None) -> O:
    """The options of the run in a folder: of one study, or what any study shares."""
    path = out / "options.json"
    if not path.is_file():
        raise ValueError(f"there is no run in {out}: name its folder")
    stored = read_json(path)
    if not isinstance(stored, dict):
        raise ValueError(f"{path} is damaged: it is no JSON object")
    theirs = stored.get("study")
    if study not in (None, theirs):
        raise ValueError(
            f"{path} holds a run of {theirs}: continue it with that script, or choose another --out"
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
    """The inverse of :func:`recorded`; a value of another type is refused."""
    return TypeAdapter(kind).validate_json(json.dumps(tree), strict=True)


def check_typed(stored: Options, out: Path, known: Sequence[str]) -> None:
    """What a file says is not imported: only what was typed, or what the script itself takes."""
    for name in (*stored.sources.prior, *stored.data.task):
        if ":" in name and name not in known:
            raise ValueError(f"{out} uses {name}: name it again, with --prior or --task as before")
