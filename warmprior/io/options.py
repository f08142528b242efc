"""Options that came after files had been written: what identifies a file names them once they are used."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

__all__ = ["LATER", "identity_of", "variations"]

LATER = {"later": True}
"""Metadata of a dataclass field that earlier versions did not have, and by whose default nothing changes.

While it has its default, :func:`identity_of` leaves it out: what was trained before is found again, and runs
that were begun before are continued.
"""


def identity_of(options: Any) -> dict[str, Any]:
    """The fields of a dataclass, and of those in it, but for later ones that have their defaults.

    Args:
        options: the dataclass.

    Examples:
        >>> from dataclasses import dataclass, field
        >>> @dataclass
        ... class Options:
        ...     steps: int = 3
        ...     speed: float = field(default=1.0, metadata=LATER)
        >>> identity_of(Options()), identity_of(Options(speed=2.0))
        ({'steps': 3}, {'steps': 3, 'speed': 2.0})
    """
    return {
        f.name: identity_of(value) if is_dataclass(value) else value
        for f in fields(options)
        if (value := getattr(options, f.name)) != f.default or "later" not in f.metadata
    }


def variations(options: Any) -> dict[str, Any]:
    """The later fields of a dataclass, and of those in it, that do not have their defaults.

    Args:
        options: the dataclass.

    Examples:
        >>> from dataclasses import dataclass, field
        >>> @dataclass
        ... class Options:
        ...     steps: int = 3
        ...     speed: float = field(default=1.0, metadata=LATER)
        >>> variations(Options(steps=4)), variations(Options(speed=2.0))
        ({}, {'speed': 2.0})
    """
    found: dict[str, Any] = {}
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            found |= variations(value)
        elif "later" in f.metadata and value != f.default:
            found[f.name] = value
    return found
