"""Classes that configurations name, and the arguments that their objects were built from."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

__all__ = ["Registered", "find", "from_config", "make", "options_of"]


class Registered:
    """Subclasses are known by name, and objects remember their constructor's arguments.

    Every direct subclass has a registry of its own subclasses, except for those declared ``abstract=True``.

    Raises:
        ValueError: when a subclass takes the name of another, or a name that no file can have.
        TypeError: when positional arguments behind ``*`` have no names in the base class to be saved by.

    Examples:
        >>> from warmprior.modules.registry import Registered, from_config
        >>> class Shape(Registered): ...
        >>> class Circle(Shape):
        ...     def __init__(self, radius=1.0): ...
        >>> Circle(radius=2.0).config(), from_config(Shape, {"name": "Circle"})
        ({'name': 'Circle', 'radius': 2.0}, Circle(radius=1.0))
    """

    name: ClassVar[str]
    """In options and files; that of the class by default."""
    _classes: ClassVar[dict[str, type[Any]]]
    _arguments: dict[str, Any]

    def __init_subclass__(cls, *, abstract: bool = False, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if Registered in cls.__bases__:
            cls._classes = {}
        elif not abstract:
            cls.name = name = cls.__dict__.get("name", cls.__name__)
            if not re.fullmatch(r"[\w.+-]+", name):
                raise ValueError(
                    f"the name of {cls.__name__} appears in file names, which cannot hold {name!r}"
                )
            taken = cls._classes.get(name, cls)
            # The same class again, as when a notebook's cell runs twice, replaces itself.
            if (taken.__module__, taken.__qualname__) != (cls.__module__, cls.__qualname__):
                raise ValueError(f"{name!r} is the name of {taken}: choose another for {cls}")
            cls._classes[name] = cls

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Remember the arguments by name."""
        self = super().__new__(cls)
        arguments: dict[str, Any] = {}
        self.__dict__["_arguments"] = arguments
        signature = inspect.signature(cls.__init__)
        try:
            bound = signature.bind(self, *args, **kwargs)
        except TypeError:  # a copy, which brings its arguments along, or a mistake: the call fails
            return self
        bound.apply_defaults()
        for name, parameter in list(signature.parameters.items())[1:]:
            value = bound.arguments[name]
            if parameter.kind is parameter.VAR_KEYWORD:
                arguments |= value
            elif parameter.kind is not parameter.VAR_POSITIONAL:
                arguments[name] = value
            elif value:
                arguments |= _named(cls, value)
        return self

    def config(self) -> dict[str, Any]:
        """Name and constructor arguments as JSON holds them; :func:`from_config` reverses it.

        An argument that the constructor chose, as for ``sigma=None``, is taken from the object's attribute of
        that name, if it is a number or text; one that has a ``config()`` is saved as that. A ``TypeError`` if
        JSON cannot hold one.
        """
        if "name" in self._arguments:
            raise TypeError(f"{type(self).__name__} takes an argument called name: rename it")
        values = {n: v.config() if hasattr(v, "config") else v for n, v in self._resolved().items()}
        try:
            return json.loads(json.dumps({"name": self.name, **values}, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"{type(self).__name__} has an argument that cannot be saved ({error}): take numbers, text, "
                "lists or dictionaries, and build other objects from these"
            ) from error

    def _resolved(self) -> dict[str, Any]:
        plain, resolved = (bool, int, float, str), dict(self._arguments)
        for name, value in self._arguments.items():
            kept = getattr(self, name, None)
            # Given values stay as they are: the constructor would convert them again.
            if isinstance(kept, plain) and (value is None or (isinstance(value, plain) and kept == value)):
                resolved[name] = kept
        return resolved

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(_written(self._resolved()))})"


def find[T: Registered](base: type[T], name: str) -> type[T]:
    """The subclass of a name, or at a place such as ``"mypackage.priors:Anchor"``, which is imported.

    Importing runs code, so use this for names that a user typed, and never for names in a file. A
    ``ValueError`` if there is none, or it is a base class.
    """
    module, colon, attribute = name.partition(":")
    if not colon:
        return _known(base, name, "name your own as package.module:Class")
    kind = _kind(base)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"there is no {kind} at {name}: {error}") from error
    if found not in base._classes.values():
        raise ValueError(f"{name} is no {kind} that can be built")
    return found


def make[T: Registered](base: type[T], text: str, *args: Any) -> T:
    """Build what a user typed: a name as for :func:`find`, and options behind it, as in :func:`options_of`.

    ``args`` are further arguments of the constructor. A ``ValueError`` names what is wrong and what the
    constructor takes.

    Examples:
        >>> from warmprior.modules.registry import make
        >>> from warmprior import Prior
        >>> make(Prior, "past,correlation=0.5", 8)
        PastPrior(chunk_length=8, sigma=0.5, correlation=0.5)
    """
    found, options = find(base, text.partition(",")[0]), options_of(text)
    try:
        return found(*args, **options)
    except (TypeError, ValueError, ArithmeticError) as error:
        written = ", ".join([*map(repr, args), *_written(options)]) or "nothing"
        taken = ", ".join(list(inspect.signature(found.__init__).parameters)[1:]) or "nothing"
        raise ValueError(
            f"{found.__name__} cannot be built from {written} ({error}): it takes {taken}"
        ) from error


def options_of(text: str) -> dict[str, Any]:
    """The options of ``name,option=value,...``, as JSON or plain text; a ``ValueError`` if they are none.

    A comma separates options if ``option=`` follows, and belongs to the value otherwise.
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


def from_config[T: Registered](base: type[T], config: Mapping[str, Any]) -> T:
    """Build what :meth:`Registered.config` describes, without importing anything; an unknown name raises."""
    arguments = dict(config)
    name = arguments.pop("name", None)
    return _known(base, name, "import the module that defines it")(**arguments)


def _known[T: Registered](base: type[T], name: Any, advice: str) -> type[T]:
    if name not in base._classes:
        known = ", ".join(sorted(base._classes))
        raise ValueError(f"unknown {_kind(base)} {name!r}: it is none of {known}; {advice}")
    return base._classes[name]


def _named(cls: type, values: Sequence[Any]) -> dict[str, Any]:
    """Arguments behind ``*``, by the names that the constructor of the base class has for them."""
    following = [base for base in cls.__mro__ if "__init__" in vars(base)][1]
    parameters = list(inspect.signature(vars(following)["__init__"]).parameters.values())[1:]
    names = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    if len(values) > len(names):
        raise TypeError(f"{cls.__name__} must name its arguments: what is behind * could not be saved")
    return dict(zip(names, values, strict=False))


def _kind(base: type) -> str:
    """The name of a base class in words."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", base.__name__).lower()


def _written(arguments: Mapping[str, Any]) -> list[str]:
    return [f"{name}={value!r}" for name, value in arguments.items()]
