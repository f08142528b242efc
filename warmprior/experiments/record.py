"""Recipes as JSON: what they are identified by, and in which options two of them differ."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from warmprior.data.opening import resolved_place
from warmprior.experiments.recipe import Flat, Recipe

__all__ = ["differences", "record", "refuse_ignored", "restore", "variation_notes"]

OF_A_START = {"run": ("out", "resume", "engine", "ray_address"), "data": ("force_download",)}
"""Options, by part, of one start of a run: they are not stored."""

CHANGEABLE = {"run": ("envs", "logger")}
"""Options, by part, that a continued run may change: they change no result."""


def record(recipe: Any, *, changeable: bool = False) -> dict[str, Any]:
    """A recipe as JSON holds it: what it is identified by.

    Args:
        recipe: a :class:`Recipe`, or a part of one.

    Keyword Args:
        changeable: add what may change when it is continued.

    Examples:
        >>> from warmprior.experiments import EvaluationOptions
        >>> record(EvaluationOptions())["nfe"]
        [9, 3, 1]
    """

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(v) for key, v in value.items()}
        if isinstance(value, (tuple, list)):
            return [plain(v) for v in value]
        # The same file from another working directory.
        return resolved_place(value) if isinstance(value, Path) else value

    tree = plain(asdict(recipe))
    if not isinstance(recipe, Recipe):
        return tree
    for left_out in (OF_A_START,) if changeable else (OF_A_START, CHANGEABLE):
        for part, names in left_out.items():
            for name in names:
                tree[part].pop(name)
    return tree


def restore[T](kind: type[T], tree: dict[str, Any]) -> T:
    """The inverse of :func:`record`.

    Args:
        kind: of the dataclass.
        tree: what :func:`record` gave.

    Raises:
        ValueError: if it is of another version of this library, naming the option.

    Examples:
        >>> from warmprior.experiments import EvaluationOptions
        >>> restore(EvaluationOptions, record(EvaluationOptions(episodes=3))).episodes
        3
    """
    hints, values = get_type_hints(kind), {}
    unknown = tree.keys() - {f.name for f in fields(kind)}  # type: ignore[arg-type]
    if unknown:
        raise ValueError(f"there is no option {min(unknown)}")
    for name, value in tree.items():
        if is_dataclass(hints[name]):
            value = restore(hints[name], value)  # type: ignore[arg-type]
        elif isinstance(value, list):
            value = tuple(value)
        elif isinstance(value, str) and Path in get_args(hints[name]):
            value = Path(value)
        values[name] = value
    return kind(**values)


def differences(kind: type, mine: dict[str, Any], theirs: dict[str, Any]) -> Iterator[str]:
    """The options in which two records differ, as the second has them on the command line.

    Args:
        kind: of the dataclass.
        mine: what :func:`record` gave.
        theirs: likewise.
    """
    hints, plain = get_type_hints(kind, include_extras=True), get_type_hints(kind)
    for name in mine.keys() | theirs.keys():
        value, other = mine.get(name), theirs.get(name)
        if value == other:
            continue
        if isinstance(value, dict) and isinstance(other, dict):
            flat = Flat in getattr(hints[name], "__metadata__", ())
            for told in differences(plain[name], value, other):
                yield told if flat else told.replace("--", f"--{name}.", 1)
            continue
        option = "--" + name.replace("_", "-")
        if other is None or other is False or other == []:
            yield f"no {option}"
        elif other is True:
            yield option
        else:
            yield f"{option} {' '.join(map(str, other)) if isinstance(other, list) else other}"


def refuse_ignored(
    recipe: Recipe,
    base: Recipe,
    parts: Iterable[str],
    told: str,
    *,
    but: Collection[str] = (),
    only: Collection[str] | None = None,
) -> None:
    """Refuse options that were given and would have no effect.

    Args:
        recipe: what is asked for.
        base: what it started from.
        parts: of the tree, that have no effect.
        told: why.

    Keyword Args:
        but: options of theirs that have an effect.
        only: options of theirs that have none; all others by default.

    Raises:
        ValueError: naming the options.
    """
    mine, theirs = record(recipe), record(base)

    def leaves(tree: dict[str, Any], part: str) -> dict[str, Any]:
        return tree[part] if isinstance(tree[part], dict) else {part: tree[part]}

    given = {
        name
        for part in parts
        for name in leaves(mine, part).keys() | leaves(theirs, part).keys()
        if leaves(mine, part).get(name) != leaves(theirs, part).get(name)
        and name not in but
        and (only is None or name in only)
    }
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(given))
        raise ValueError(f"{told}: leave out {options}")


BESIDE_THE_PAPER = (
    "actions",
    "obs",
    "cameras",
    "image_size",
    "fast_rendering",
    "encoder",
    "crop_size",
    "share_encoder",
    "times",
    "objective",
    "weighting",
    "self_distillation",
    "precision",
    "grid",
)
"""Options that tables name where they are not at their defaults."""


def _variations(recipe: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for f in fields(recipe):
        value = getattr(recipe, f.name)
        if is_dataclass(value):
            found |= _variations(value)
        elif f.name in BESIDE_THE_PAPER and value != f.default:
            found[f.name] = value
    return found


def variation_notes(recipe: Any, paper: Any = None) -> list[str]:
    """What tables say of options beside the paper's recipe, if there are any.

    Args:
        recipe: of all rows of the table.
        paper: the paper's, if it has such options itself.

    Examples:
        >>> from warmprior.experiments import EvaluationOptions, Recipe
        >>> variation_notes(Recipe(evaluation=EvaluationOptions(grid="dense-jump")))
        ['- Beside the paper, for all sources: --grid dense-jump.']
    """
    theirs = {} if paper is None else _variations(paper)
    given = [
        f"--{name.replace('_', '-')} {value}"
        for name, value in _variations(recipe).items()
        if theirs.get(name) != value
    ]
    return [f"- Beside the paper, for all sources: {', '.join(given)}."] if given else []
