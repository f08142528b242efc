"""Help of options: they stand in the order of the constructor, and say once what happens without them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

registry = ConstructorRegistry()
"""The rule for dataclasses, which ``tyro.cli`` takes."""

_reading: list[Any] = []  # types whose fields tyro's own rules are reading


def _shown(default: str) -> str:
    return "" if default in ("None", "") else f"(default: {default})"


def _option(kind: Any, words: str = "") -> Any:
    """Return the type of an option whose help names no ``None``, and no default that its ``words`` name."""
    hint: Any = "" if re.search(r"\bdefault\b", words) else _shown
    return Annotated[kind, tyro.conf.DisallowNone, tyro.conf.arg(help_behavior_hint=hint)]


def _words(field: StructFieldSpec) -> str:
    text = field.helptext() if callable(field.helptext) else field.helptext
    return text or ""


@registry.struct_rule
def _fields_of(info: StructTypeInfo) -> StructConstructorSpec | None:
    if info.type in _reading:
        return None  # tyro's own rule is next
    _reading.append(info.type)
    try:
        spec: Any = ConstructorRegistry.get_struct_spec(info)
    finally:
        _reading.pop()
    if not isinstance(spec, StructConstructorSpec):
        return None
    order = list(inspect.signature(info.type).parameters)  # what is given by keyword alone comes last
    fields = sorted(spec.fields, key=lambda field: order.index(field.name))
    return replace(spec, fields=tuple(replace(f, type=_option(f.type, _words(f))) for f in fields))


def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the same options, whose result runs the command.

    Examples:
        >>> import tyro
        >>> from warmprior.io.option_help import deferred
        >>> def add(x: int, /, y: int | None = None) -> None:
        ...     print(x + (y or 0))
        >>> tyro.cli(deferred(add), args=["3"])()
        3
    """

    def bound(*args: Any, **options: Any) -> Callable[[], None]:
        return lambda: command(*args, **options)

    hints = get_type_hints(command, include_extras=True)
    bound.__signature__ = inspect.signature(command)  # type: ignore[attr-defined]
    bound.__annotations__ = {name: _option(hint) for name, hint in hints.items()}
    bound.__doc__, bound.__name__, bound.__module__ = command.__doc__, command.__name__, command.__module__
    return bound
