"""Help of options: an option that has no default says in words what happens without it, and shows none."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

registry = ConstructorRegistry()
"""The rule for dataclasses, which ``tyro.cli`` takes."""

_reading: list[Any] = []  # types whose fields tyro's own rules are reading


def _shown(default: str) -> str:
    return "" if default in ("None", "") else f"(default: {default})"


def _option(kind: Any) -> Any:
    """Return the type of an option whose help names neither ``None`` nor an empty default."""
    return Annotated[kind, tyro.conf.DisallowNone, tyro.conf.arg(help_behavior_hint=_shown)]


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
    return replace(spec, fields=tuple(replace(field, type=_option(field.type)) for field in spec.fields))


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
