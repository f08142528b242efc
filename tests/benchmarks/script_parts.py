"""Command lines of the benchmarks, and what they leave behind."""

from __future__ import annotations

import json
import re


def command_line(**options):
    """Words of a command line; ``None`` leaves an option out, and ``__`` stands for a point."""
    words = []
    for key, value in options.items():
        if value is not None:
            parts = value if isinstance(value, (list, tuple)) else [value]
            words += [f"--{key.replace('__', '.').replace('_', '-')}", *map(str, parts)]
    return words


def options(path, out, **extra):
    """Command line of a run that takes seconds."""
    values = {
        "dataset": path,
        "task": "lift",
        "out": out,
        "iterations": 30,
        "episodes": 1,
        "envs": 1,
        "nfe": 1,
        "logger": "none",
    }
    return command_line(**values | extra)


def refused(main, argv, capsys):
    """The line in which a script refuses a command line."""
    code = main([str(word) for word in argv])
    told = capsys.readouterr().err
    assert code == 2 and "Traceback" not in told, told
    line = told.splitlines()[-1]  # below the bars of what was begun
    assert re.match(r"\w+\.py: error: ", line), told
    return line


def stored(out):
    """The results in an output folder, with rows of facts and measures together."""
    result = json.loads((out / "results.json").read_text())
    for row in result["rows"]:
        assert set(row) - {"outcomes"} == {"facts", "measures"}
        assert not row["facts"].keys() & row["measures"].keys()
    return result | {"rows": [row["facts"] | row["measures"] for row in result["rows"]]}


def having(rows, measure):
    """The rows that have a measure."""
    return [row for row in rows if measure in row]


def written(folder):
    """When each file of weights and states was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")}


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")
