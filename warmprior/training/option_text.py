"""Options as a user types them: the name of a registered class, followed by its arguments."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from typing import Any

from warmprior.modules.registry import Registered, kind, registered

__all__ = ["build", "find", "make", "options_of"]


def find[T: Registered](base: type[T], name: str) -> type[T]:
    """Return a subclass by its name, or import it from a place such as ``"mypackage.priors:Anchor"``.

    Importing runs code, so use this for names that a user typed, and never for names in a file. Raises
    ValueError if there is no such class, or it is a base class.
    """
    module, colon, attribute = name.partition(":")
    if not colon:
        return registered(base, name, "name your own as package.module:Class")
    try:
        cls = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"there is no {kind(base)} at {name}: {error}") from error
    if cls not in base.classes.values():
        raise ValueError(f"{name} is no {kind(base)} that can be built")
    return cls


def make[T: Registered](base: type[T], text: str, *args: Any) -> T:
    """Build an object from a name (:func:`find`) followed by options (:func:`options_of`).

    ``args`` are further arguments of the constructor. Raises ValueError, with what is wrong and what the
    constructor takes, or if the object cannot be saved. If the text may come from a file, look up its name
    with :func:`registered`, which imports nothing, and pass the class to :func:`build`.

    Examples:
        >>> from warmprior.training.option_text import make
        >>> from warmprior import Prior
        >>> make(Prior, "past,correlation=0.5", 8)
        PastPrior(chunk_length=8, sigma=0.5, correlation=0.5)
    """
    made = build(find(base, text.partition(",")[0]), text, *args)
    try:
        made.config()
    except TypeError as error:
        raise ValueError(str(error)) from error
    return made


def build[T: Registered](cls: type[T], text: str, *args: Any) -> T:
    """Build an object of a class with the options that follow a name, as :func:`make` does."""
    options = options_of(text)
    try:
        return cls(*args, **options)
    except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        written = ", ".join([*map(repr, args), *(f"{n}={v!r}" for n, v in options.items())]) or "nothing"
        taken = ", ".join(list(inspect.signature(cls.__init__).parameters)[1:]) or "nothing"
        raise ValueError(
            f"{cls.__name__} cannot be built from {written} ({error}): it takes {taken}"
        ) from error


def options_of(text: str) -> dict[str, Any]:
    """Return the options of ``name,option=value,...``, as JSON or plain text.

    A comma separates options if ``option=`` follows, and belongs to the value otherwise. Raises ValueError
    if the text has another form.
    """
    options: dict[str, Any] = {}
    _, comma, rest = text.partition(",")
    for part in re.split(r",(?=\s*[^\W\d]\w*\s*=)", rest) if comma else ():
        key, equals, value = part.partition("=")
        key = key.strip()
        if not equals or not key.isidentifier():
            raise ValueError(f"options are written as name,option=value, got {part!r} in {text!r}")
        if key in options:
            raise ValueError(f"the option {key} is given twice in {text!r}")
        try:
            options[key] = json.loads(value)
        except json.JSONDecodeError:
            options[key] = value
    return options
