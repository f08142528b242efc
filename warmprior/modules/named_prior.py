"""How priors are named, read from text, recorded and written down."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

if TYPE_CHECKING:
    from warmprior.modules.prior import Prior

__all__ = ["NamedPrior", "options_of"]

PALETTE = ("#1b9e77", "#e7298a", "#66a61e", "#a6761d", "#e41a1c", "#377eb8", "#984ea3", "#17becf")
"""Colours in figures of priors that choose none."""

NEXT_OPTION = re.compile(r",(?=\s*[^\W\d]\w*\s*=)")
"""What separates options behind a prior's name; other commas belong to a value."""


class NamedPrior:
    """What :class:`~warmprior.Prior` does with its name and arguments, whatever its source is.

    A subclass that sets :attr:`name` is registered under it. The constructor's arguments are recorded, so
    that :meth:`config` is complete for any subclass.

    Raises:
        ValueError: when a subclass takes the name of another, or one that no file can have.

    Examples:
        >>> from warmprior import PastPrior, Prior
        >>> Prior.registered()["past"] is Prior.find("past") is PastPrior
        True
    """

    name: ClassVar[str]
    """Of the prior in options, files and rows."""
    label: ClassVar[str]
    """In tables and figures; the name by default."""
    color: ClassVar[str]
    """In figures; of :data:`PALETTE` by default."""
    untold: ClassVar[frozenset[str]] = frozenset({"chunk_length", "sigma", "cold_probability"})
    """Arguments that :attr:`options` leaves out, since others tell them."""
    chunk_length: int
    sigma: float
    _registry: ClassVar[dict[str, type[Any]]] = {}
    _arguments: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Record the arguments, whatever the subclass does with them."""
        self = super().__new__(cls)
        self.__dict__["_arguments"] = _bound(cls, args, kwargs)
        return self

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            return
        if not re.fullmatch(r"[\w.+-]+", cls.name):
            raise ValueError(f"a prior's name becomes that of files: {cls.name!r} cannot")
        taken = NamedPrior._registry.get(cls.name)
        # The same class once more, as when a notebook's cell runs again, replaces itself.
        if taken is not None and _place(taken) != _place(cls):
            raise ValueError(
                f"a prior named {cls.name!r} exists already ({_place(taken)}): choose another name for "
                f"{_place(cls)}"
            )
        NamedPrior._registry[cls.name] = cls
        if "label" not in cls.__dict__:
            cls.label = cls.name
        if "color" not in cls.__dict__:
            cls.color = PALETTE[zlib.crc32(cls.name.encode()) % len(PALETTE)]

    @staticmethod
    def registered() -> Mapping[str, type[Prior]]:
        """All imported priors by name."""
        return MappingProxyType(NamedPrior._registry)

    @staticmethod
    def find(name: str) -> type[Prior]:
        """The class of that name, or at a place such as ``"mypackage.priors:Anchor"``, which is imported.

        Options after it, see :meth:`make`, play no role.

        Importing runs code: this is for what a user typed, and never for what a file says.

        Args:
            name: of the prior, or ``"module:Class"``.

        Raises:
            ValueError: if there is no such prior.

        Examples:
            >>> from warmprior import Prior
            >>> Prior.find("past").label
            'WP-Past'
        """
        name = name.partition(",")[0]
        module, colon, attribute = name.partition(":")
        if not colon:
            if name in NamedPrior._registry:
                return NamedPrior._registry[name]
            known = ", ".join(sorted(NamedPrior._registry))
            raise ValueError(
                f"unknown prior {name!r}: it is none of {known}; name your own as package.module:Class"
            )
        try:
            found: type[Prior] = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"there is no prior at {name}: {error}") from error
        if not (isinstance(found, type) and issubclass(found, NamedPrior)):
            raise ValueError(f"{name} is no subclass of warmprior.Prior")
        try:
            _check_named(found)
        except TypeError as error:
            raise ValueError(str(error)) from error
        return found

    @staticmethod
    def make(
        name: str, chunk_length: int, *, sigma: float | None = None, cold_probability: float = 0.0
    ) -> Prior:
        """One prior of a comparison: what its constructor takes of the options that compare sources.

        Args:
            name: see :meth:`find`; with further arguments as in ``"preview,correlation=0.5"``, as JSON or
                plain text. A comma separates them if ``option=`` follows, and belongs to the value otherwise.
            chunk_length: ``H``.

        Keyword Args:
            sigma: see :class:`Prior`; left out where it has no effect (:meth:`takes`).
            cold_probability: likewise.

        Raises:
            ValueError: if there is no such prior, or an argument is out of range, given twice, unknown or
                without effect, naming it and what the prior takes.

        Examples:
            >>> from warmprior import Prior
            >>> [Prior.make(name, 8, sigma=0.3) for name in ("past", "regression")]
            [PastPrior(chunk_length=8, sigma=0.3, cold_probability=0.0), RegressionPrior(chunk_length=8)]
            >>> Prior.make("past,correlation=0.5", 8).correlation
            0.5
        """
        found = NamedPrior.find(name)
        behind = options_of(name)
        beside: dict[str, Any] = {"sigma": sigma, "cold_probability": cold_probability}
        unset = {"sigma": None, "cold_probability": 0.0}
        taken = {key: value for key, value in beside.items() if found.takes(key)} | behind
        try:
            for key in behind:
                if not found.takes(key):
                    raise ValueError(f"{key} is unknown to it, or without effect")
                if key in beside and beside[key] != unset[key]:
                    raise ValueError(f"{key} is given twice: also as {beside[key]}")
            return found(chunk_length, **taken)
        except (TypeError, ValueError, ArithmeticError) as error:
            told = [f"{k}={v!r}" for k, v in taken.items() if k in behind or v != unset[k]]
            raise ValueError(
                f"{found.__name__} cannot be built from {', '.join(['chunk_length', *told])} ({error}): it "
                f"takes {', '.join(found._takes())}"
            ) from error

    @classmethod
    def takes(cls, argument: str) -> bool:
        """Whether the constructor has such an argument, and it has an effect.

        Args:
            argument: its name.

        Examples:
            >>> from warmprior import Prior
            >>> [Prior.find(name).takes("sigma") for name in ("past", "gaussian", "regression")]
            [True, False, False]
        """
        parameters = inspect.signature(cls.__init__).parameters
        kinds = [parameter.kind for parameter in parameters.values()]
        return argument in parameters or inspect.Parameter.VAR_KEYWORD in kinds

    @classmethod
    def _takes(cls) -> list[str]:
        """All such arguments, for messages."""
        parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]  # without self
        return [
            f"**{parameter.name}" if parameter.kind is parameter.VAR_KEYWORD else parameter.name
            for parameter in parameters
            if cls.takes(parameter.name)
        ]

    def config(self) -> dict[str, Any]:
        """Name and constructor arguments as JSON holds them; :meth:`from_config` reverses it.

        Raises:
            TypeError: if an argument is nothing that JSON can hold, or the class has no name of its own.

        Examples:
            >>> from warmprior import Prior
            >>> Prior.find("regression")(8).config()
            {'name': 'regression', 'chunk_length': 8}
        """
        _check_named(type(self))
        arguments = self._resolved()
        if "name" in arguments:
            raise TypeError(
                f"{type(self).__name__} takes an argument called name: call it otherwise"
            )
        try:
            return json.loads(json.dumps({"name": self.name, **arguments}, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"{type(self).__name__} has an argument that cannot be saved ({error}): take numbers, text, "
                "lists or dictionaries, and build the rest of them"
            ) from error

    @staticmethod
    def from_config(config: dict[str, Any]) -> Prior:
        """Build a prior from :meth:`config`'s output; subclasses are found by their :attr:`name`.

        Raises:
            ValueError: if no imported class has that name.

        Examples:
            >>> from warmprior import Prior
            >>> Prior.from_config({"name": "past", "chunk_length": 8})
            PastPrior(chunk_length=8, sigma=0.5, cold_probability=0.0)
        """
        kwargs = dict(config)
        name = kwargs.pop("name", None)
        if name not in NamedPrior._registry:
            known = ", ".join(sorted(NamedPrior._registry))
            raise ValueError(
                f"unknown prior {name!r}; known: {known}. Import the module that defines a custom "
                "prior before loading it."
            )
        return NamedPrior._registry[name](**kwargs)

    @property
    def options(self) -> str:
        """The other arguments that are not at their defaults, as :meth:`make` takes them.

        Examples:
            >>> from warmprior import Prior
            >>> Prior.make("past,correlation=0.5", 8, sigma=0.3).options
            'correlation=0.5'
        """
        parameters = inspect.signature(type(self).__init__).parameters
        return ",".join(
            f"{name}={json.dumps(value)}"
            for name, value in self._resolved().items()
            if name not in self.untold
            and self.takes(name)
            and not (name in parameters and parameters[name].default == value)
        )

    def describe(self) -> str:
        """The prior in a few words, for progress bars and figures.

        Examples:
            >>> from warmprior import Prior
            >>> Prior.from_config({"name": "past", "chunk_length": 8}).describe()
            'past, sigma 0.5, H 8'
        """
        told = f", {self.options}" if self.options else ""
        return f"{self.name}, sigma {float(self.sigma):g}, H {self.chunk_length}{told}"

    def _resolved(self) -> dict[str, Any]:
        """The constructor's arguments, with the default that was put in for ``None``."""
        own = {
            "chunk_length": int,
            "sigma": float,
            "cold_probability": float,
            "correlation": float,
        }
        resolved = {
            name: own[name](getattr(self, name) if value is None else value)
            if name in own
            else value
            for name, value in self._arguments.items()
        }
        # It came later: configurations, and what is named by them, stay as they were without it.
        if resolved.get("correlation") == 0.0:
            del resolved["correlation"]
        return resolved

    def __repr__(self) -> str:
        told = (f"{key}={value!r}" for key, value in self._resolved().items())
        return f"{type(self).__name__}({', '.join(told)})"


def options_of(name: str) -> dict[str, Any]:
    """Options behind the name of a prior.

    Raises:
        ValueError: if they are not written as ``name,option=value``, or one is given twice.

    Examples:
        >>> options_of("preview,correlation=0.5")
        {'correlation': 0.5}
    """
    options: dict[str, Any] = {}
    _, comma, rest = name.partition(",")
    for part in NEXT_OPTION.split(rest) if comma else ():
        key, equals, text = part.partition("=")
        key = key.strip()
        if not equals or not key.isidentifier():
            raise ValueError(
                f"options of a prior are written as name,option=value, got {part!r} in {name!r}"
            )
        if key in options:
            raise ValueError(f"the option {key} is given twice in {name!r}")
        try:
            options[key] = json.loads(text)
        except json.JSONDecodeError:
            options[key] = text
    return options


def _check_named(cls: type[NamedPrior]) -> None:
    # Under its parent's name a subclass would be saved, trained and compared as its parent.
    if "name" not in cls.__dict__:
        raise TypeError(f"{cls.__name__} has no name of its own: set the class attribute name")


def _place(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _bound(cls: type, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """Constructor arguments by name, defaults included."""
    signature = inspect.signature(cls.__init__)  # type: ignore[misc]
    try:
        bound = signature.bind(None, *args, **kwargs)
    except TypeError:
        # A copy, which brings its arguments along; or a mistake that the call itself tells.
        return {}
    bound.apply_defaults()
    arguments: dict[str, Any] = {}
    for name, parameter in list(signature.parameters.items())[1:]:  # without self
        value = bound.arguments[name]
        if parameter.kind is parameter.VAR_KEYWORD:
            arguments |= value
        elif parameter.kind is not parameter.VAR_POSITIONAL:
            arguments[name] = value
        elif value:
            raise TypeError(f"{cls.__name__} must name its arguments: *{name} could not be saved")
    return arguments
