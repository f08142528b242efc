import json
import re
from pathlib import Path


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
    values = {"dataset": path, "task": "lift", "out": out, "iterations": 30, "episodes": 1, "workers": 1}
    values |= {"nfe": 1, "logger": "none", "network": "mlp,hidden_dim=16", "save_every": 10}
    return command_line(**values | extra)


def refused(main, argv, capsys):
    """The line in which a script refuses a command line."""
    code = main([str(word) for word in argv])
    said = capsys.readouterr().err
    assert code == 2 and "Traceback" not in said, said
    line = said.splitlines()[-1]  # below the bars of what was begun
    assert re.match(r"\w+\.py: error: ", line), said
    return line


def stored(out, name="results"):
    return [json.loads(line) for line in (out / f"{name}.jsonl").read_text().splitlines()]


def described(out, name):
    return json.loads((out / f"{name}.json").read_text())


def written(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")}


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")


def flow(run, validation, **more):
    """The report on the flows of a finished run."""
    import curvature

    few = {"run": run, "validation": validation, "out": f"{run}-flow", "measured": 6}
    assert curvature.main(command_line(**few | more)) == 0
    return Path(f"{run}-flow", "report.md").read_text()
