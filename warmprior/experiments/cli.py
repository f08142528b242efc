"""Experiments from the command line: options, output folders, errors and interruptions."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import replace
from glob import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tyro

from warmprior.experiments.recipe import Recipe
from warmprior.experiments.record import differences, record, refuse_ignored, restore
from warmprior.io.distributed import from_leader, rank
from warmprior.io.files import check_writable, exclusive, read_json, write_atomic
from warmprior.io.ray_pool import check_ray
from warmprior.io.script import PartialFailure

__all__ = ["numbered_folder", "parse", "started", "write_report"]


def parse[R: Recipe](
    presets: Mapping[str, R],
    argv: Sequence[str] | None,
    *,
    study: str,
    program: str | None = None,
    description: str | None = None,
    preset: Callable[[R], R] | None = None,
    unused: Collection[str] = (),
) -> R:
    """The recipe that a command line asks for, checked, with its output folder.

    The options start from those of ``--preset``, or with ``--resume`` from the stored ones, which the
    command line may then only repeat, but for where and with how many workers to compute.

    Args:
        presets: by name; the first is the default.
        argv: the command line without the program; that of this process by default.

    Keyword Args:
        study: name of the experiment; a folder holds one.
        program: what ``--help`` calls it; the script by default.
        description: of ``--help``.
        preset: chooses the preset of what is asked for, where it depends on more than its name.
        unused: options that have no effect in this experiment, and are refused.

    Raises:
        ValueError: naming the option that cannot work, or that a continued run does not have.
        SystemExit: for options that do not exist, and for ``--help``.

    See Also:
        - :func:`~warmprior.experiments.started`: opens the folder for work.
        - :func:`~warmprior.experiments.record`: stores a recipe.

    Examples:
        >>> from warmprior.experiments import PRESETS
        >>> recipe = parse(PRESETS, ["--task", "lift", "--prior", "past", "--nfe", "1"], study="mine")
        >>> recipe.sources.prior, recipe.evaluation.nfe, recipe.run.out
        (('past',), (1,), PosixPath('runs/mine-lift-ph-quick...'))
        >>> parse(PRESETS, ["--episodes", "0"], study="mine")
        Traceback (most recent call last):
            ...
        ValueError: --episodes must be between 1 and 1,000,000, got 0
    """
    argv = sys.argv[1:] if argv is None else list(map(str, argv))

    def read(default: R) -> R:
        kind: Any = type(default)
        told = io.StringIO()
        try:
            with redirect_stderr(told):
                return tyro.cli(
                    kind, prog=program, default=default, args=argv, description=description
                )
        except SystemExit as stop:
            # What a dataclass refuses is told as all that we refuse; what no option is, by tyro.
            refused: Any = stop.__context__
            if isinstance(getattr(refused, "arg", None), str):
                raise ValueError(str(refused.message)) from None
            sys.stderr.write(told.getvalue())
            raise

    asked = read(next(iter(presets.values())))
    if asked.run.preset not in presets:
        told = ", ".join(presets)
        raise ValueError(f"--preset must be one of {told}, got {asked.run.preset!r}")
    base = presets[asked.run.preset] if preset is None else preset(asked)
    if not asked.data.generated:  # those of presets are numbers to generate
        base = replace(base, data=replace(base.data, demonstrations=()))
    recipe = read(base)
    out = from_leader(lambda: _output_folder(recipe, study))
    if recipe.run.resume:
        base = _stored(type(recipe), out, study)
        recipe = read(base)
        changed = sorted(differences(type(recipe), record(recipe), record(base)))
        if changed:
            raise ValueError(
                f"{out} was started with {', '.join(changed)}: leave these out, or choose another --out"
            )
    refuse_ignored(recipe, base, record(recipe), f"{study} makes no use of it", only=unused)
    if recipe.sources.sigma != base.sources.sigma:
        recipe.sources.check_sigma()
    name = recipe.run.logger
    if name in ("tensorboard", "wandb") and find_spec(name) is None:
        raise ImportError(f"--logger {name} needs the package {name}: pip install it")
    if recipe.run.engine == "ray":
        check_ray(recipe.run.ray_address)
    recipe.check()
    return replace(recipe, run=replace(recipe.run, out=out))


def _output_folder(recipe: Recipe, study: str) -> Path:
    """The folder to write to; never one that holds a run, unless it is to be continued."""
    run = recipe.run
    out = run.out
    if out is None:
        parts = [recipe.name, run.preset]
        prefix = [] if study == "robomimic" else [study]
        out = numbered_folder(Path("runs"), "-".join([*prefix, *parts]), latest=run.resume)
    if (out / "results.json").exists() and not run.resume:
        raise ValueError(f"{out} holds a run: add --resume to continue it, or choose another --out")
    return out


def _stored[R: Recipe](kind: type[R], out: Path, study: str) -> R:
    """The recipe of the run in a folder."""
    path = out / "options.json"
    if not path.is_file():
        raise ValueError(f"--resume: there is no run in {out}; name its folder with --out")
    tree = read_json(path)
    theirs = tree.pop("study", None) if isinstance(tree, dict) else None
    if theirs != study:
        raise ValueError(
            f"{out} holds a run of another study ({theirs}): continue it with that script, or choose "
            "another --out"
        )
    try:
        return restore(kind, tree)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not of this version: {error}") from error


def numbered_folder(parent: Path, name: str, *, latest: bool = False) -> Path:
    """The first free one of ``name``, ``name-2``, ``name-3``, ...; or the latest one taken."""

    def number(folder: Path) -> int:
        return int(folder.name[len(name) + 1 :] or 1)

    taken = [
        d
        for d in parent.glob(f"{escape(name)}*")
        if d.name == name or d.name[len(name) + 1 :].isdigit()
    ]
    if not taken:
        return parent / name
    last = max(taken, key=number)
    return last if latest else parent / f"{name}-{number(last) + 1}"


@contextmanager
def started(recipe: Recipe, study: str) -> Iterator[Path]:
    """The output folder, with the options in it, and without another process.

    Raises:
        OSError: if it cannot be written to, or another process works in it.

    See Also:
        - :func:`~warmprior.experiments.parse`: makes the recipe.
        - :func:`~warmprior.io.files.exclusive`: keeps other processes out.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import RunOptions
        >>> with TemporaryDirectory() as folder:
        ...     recipe = Recipe(run=RunOptions(out=Path(folder) / "run"))
        ...     with started(recipe, "mine") as out:
        ...         [path.name for path in out.iterdir()]
        Output folder: ...run
        ['options.json']
    """
    out = recipe.run.directory
    if rank():  # the first process is in it, for all
        yield out
        return
    check_writable(out)
    with exclusive(out):
        tree = {"study": study, **record(recipe, changeable=True)}
        text = json.dumps(tree, indent=1) + "\n"
        write_atomic(out / "options.json", lambda path: path.write_text(text))
        print(f"Output folder: {out}", flush=True)
        try:
            yield out
        except Exception:
            if not (out / "results.json").exists():  # nothing to continue, and nothing in the way
                (out / "options.json").unlink()
            raise


def write_report(out: Path, table: str, failures: Sequence[str] = ()) -> None:
    """Write the table of a run and show it.

    Args:
        out: its folder.
        table: in Markdown.
        failures: what is missing in it, and why (:attr:`Comparison.failures`).

    Raises:
        PartialFailure: if anything is, after the table is shown.

    See Also:
        :func:`~warmprior.experiments.success_table`: a table to write.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     write_report(Path(folder), "| Base | WP-Past |")
        ...     (Path(folder) / "table.md").read_text()
        <BLANKLINE>
        | Base | WP-Past |
        Results, table and pictures: ...
        '| Base | WP-Past |'
    """
    missing = "".join(f"- Missing: {failure}\n" for failure in failures)
    table += missing and f"\n{missing}"
    write_atomic(out / "table.md", lambda path: path.write_text(table))
    print(f"\n{table}\nResults, table and pictures: {out}", flush=True)
    if failures:
        raise PartialFailure(f"{len(failures)} failed (--resume tries again):\n{missing}")
