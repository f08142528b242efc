"""Classes that can be built from a configuration: a name and constructor arguments."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Container, Mapping
from importlib import import_module
from typing import Any, ClassVar

__all__ = ["Registered", "from_config", "kept_arguments"]


class Registered:
    """The base class of objects that a saved policy stores as a class name and constructor arguments.

    An object keeps every argument of its constructor in an attribute of the same name, as estimators of
    scikit-learn do; ``config()`` reads them there. Arguments that pass through ``**options`` are those of the
    next constructor. Every direct subclass has a registry of its own subclasses, except those declared
    ``abstract=True``.

    Raises:
        ValueError: if a subclass takes the name of another, or a name that no file can have.

    Examples:
        >>> from warmprior.modules.registry import Registered, from_config
        >>> class Shape(Registered): ...
        >>> class Circle(Shape):
        ...     def __init__(self, radius=1.0):
        ...         self.radius = radius
        >>> Circle(radius=2.0).config(), from_config(Shape, {"name": "Circle"})
        ({'name': 'Circle', 'radius': 2.0}, Circle(radius=1.0))
    """

    name: ClassVar[str]
    """The name in options and files; by default that of the class."""
    classes: ClassVar[dict[str, type[Any]]]
    """The subclasses that can be built, by name."""

    def __init_subclass__(cls, *, abstract: bool = False, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if Registered in cls.__bases__:
            cls.classes = {}
        elif not abstract:
            cls.name = name = cls.__dict__.get("name", cls.__name__)
            if not re.fullmatch(r"[\w.+-]+", name):
                raise ValueError(
                    f"the name of {cls.__name__} appears in file names, which cannot hold {name!r}"
                )
            taken = cls.classes.get(name, cls)
            # The same class again, as when a notebook's cell runs twice, replaces itself.
            if (taken.__module__, taken.__qualname__) != (cls.__module__, cls.__qualname__):
                raise ValueError(f"{name!r} is the name of {taken}: choose another for {cls}")
            cls.classes[name] = cls

    def config(self) -> dict[str, Any]:
        """Return name and constructor arguments as JSON holds them; :func:`from_config` reverses it.

        An argument with a ``config()`` is saved as that. Raises TypeError if JSON cannot hold an argument.
        """
        values = {n: v.config() if hasattr(v, "config") else v for n, v in kept_arguments(self).items()}
        try:
            return json.loads(json.dumps({"name": self.name, **values}, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"{type(self).__name__} has an argument that cannot be saved ({error}): take numbers, text, "
                "lists or dictionaries, and build other objects from these"
            ) from error

    def __repr__(self) -> str:
        try:
            written = ", ".join(f"{name}={value!r}" for name, value in kept_arguments(self).items())
        except TypeError:
            written = "..."
        return f"{type(self).__name__}({written})"


def kept_arguments(part: object, known: Container[str] = ()) -> dict[str, Any]:
    """Return the constructor's arguments but the known ones, read from the attributes of the same names.

    Raises TypeError if the object does not keep an argument.
    """
    values: dict[str, Any] = {}
    for cls in type(part).__mro__:
        if "__init__" not in vars(cls):
            continue
        parameters = list(inspect.signature(vars(cls)["__init__"]).parameters.values())[1:]
        passed_on = [p for p in parameters if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
        for name in (p.name for p in parameters if p not in passed_on and p.name not in known):
            if (name == "name" and isinstance(part, Registered)) or not _keeps(part, name):
                raise TypeError(
                    f"{type(part).__name__} cannot be saved or copied: its constructor must keep the "
                    f"argument {name!r} as an attribute of this name (and a part's must call none 'name')"
                )
            values.setdefault(name, getattr(part, name))
        if not passed_on:
            break
    return values


def _keeps(part: object, name: str) -> bool:
    """Return True if an object itself has an attribute of this name, or a property."""
    default = getattr(type(part), name, part)
    return hasattr(part, name) and (name in vars(part) or default is part or isinstance(default, property))


def from_config[T: Registered](base: type[T], config: Mapping[str, Any]) -> T:
    """Build the object that :meth:`Registered.config` describes; nothing but the library is imported."""
    arguments = dict(config)
    name = arguments.pop("name", None)
    return registered(base, name, "import the module that defines it")(**arguments)


def registered[T: Registered](base: type[T], name: Any, advice: str) -> type[T]:
    """Return the subclass with a name; raise ValueError with the existing names and advice."""
    if name not in base.classes:
        # The library's own classes are known once their room is imported, and these are imported when used.
        import_module("warmprior").__all__  # noqa: B018
    if name not in base.classes:
        raise ValueError(
            f"unknown {kind(base)} {name!r}: it is none of {', '.join(sorted(base.classes))}; {advice}"
        )
    return base.classes[name]


def kind(base: type) -> str:
    """Return the name of a base class in words."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", base.__name__).lower()
