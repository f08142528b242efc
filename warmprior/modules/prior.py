"""What every source distribution is: where the flow of an action chunk starts."""

from __future__ import annotations

import importlib
import inspect
import json
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from numbers import Integral
from types import MappingProxyType
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

__all__ = ["Prior"]

PALETTE = ("#1b9e77", "#e7298a", "#66a61e", "#a6761d", "#e41a1c", "#377eb8", "#984ea3", "#17becf")
"""Colours in figures of priors that choose none."""

NEXT_OPTION = re.compile(r",(?=\s*[^\W\d]\w*\s*=)")
"""What separates options behind a prior's name; other commas belong to a value."""

WARM_ARGUMENTS = frozenset({"sigma", "cold_probability", "correlation"})
"""Arguments without effect where nothing is ever warm."""


def check_finite_numbers(**values: Any) -> None:
    """Raise ValueError for the first of them that is no finite number."""
    for name, value in values.items():
        try:
            finite = not isinstance(value, bool) and math.isfinite(value)
        except (TypeError, ValueError, OverflowError):
            finite = False
        if not finite:
            raise ValueError(f"{name} must be a finite number, got {value!r}")


def check_whole_numbers(**values: Any) -> None:
    """Raise ValueError for the first of them that is no whole number of at least 1."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")


class Prior:
    r"""Base class of the source distributions; subclass it to try your own.

    A prior is a Gaussian around a mean on the *warm* positions and standard normal on the *cold* ones
    (`WarmPrior <https://sinnnj.github.io/WarmPrior/>`_, Eq. 1):

    .. math::
        a_0[\tau] = \mu_\tau + \sigma \varepsilon_\tau \;\; (\tau \in W), \qquad
        a_0[\tau] = \varepsilon_\tau \;\; (\tau \in C), \qquad \varepsilon \sim N(0, I).

    The same object serves the replay buffer (:meth:`training_mean`), the environment
    (:meth:`next_mean`) and the actor (:meth:`sample`), so the three cannot disagree. It holds no
    state of an episode. A subclass sets :attr:`name`, and overrides the two means; overriding
    :meth:`distribution` gives another Gaussian, :meth:`sample` any other source, and :meth:`couple` another
    pairing of source and data. What else benchmarks, figures and agents need to know of it, it tells by the
    attributes below.

    The constructor's arguments are recorded, so that :meth:`config` is complete for any subclass. One
    that is an ``nn.Module`` as well (call ``nn.Module.__init__`` first) is trained, saved and frozen with
    the policy; see :class:`~warmprior.LearnedPrior` for those that learn before the flow.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.

    Keyword Args:
        sigma: residual noise on warm positions, in units of the normalised action space. ``0`` is the
            deterministic limit.
        cold_probability: share of training samples whose mean is withheld, so that the network also
            learns the cold start. ``0`` is the paper's Algorithm 1.
        correlation: share of the residual noise's variance that all warm positions of a dimension have in
            common, in [0, 1]. ``0`` is the paper's white noise, which averages out over the chunk: a network
            that averages sees through it.

    Raises:
        ValueError: if ``chunk_length < 1``, ``sigma`` is not a finite number >= 0, or ``cold_probability`` or
            ``correlation`` is not in [0, 1].

    Examples:
        >>> import torch
        >>> class LastAction(Prior):  # a heuristic source: hold the last action
        ...     name = "last-action"
        ...     def training_mean(self, history, history_valid, target):
        ...         warm = history_valid[..., -1:, None].expand(*history.shape[:-1], 1)
        ...         return history[..., -1:, :].expand_as(history), warm
        ...     def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
        ...         last = chunk.gather(-2, self.positions(executed_steps - 1, chunk, 1))
        ...         return last.expand_as(chunk), torch.ones_like(chunk[..., :1], dtype=torch.bool)
        >>> prior = LastAction(4, sigma=0.1)
        >>> loc, warm = prior.next_mean(
        ...     torch.zeros(2, 4, 1),
        ...     torch.arange(4.0).view(1, 4, 1).expand(2, 4, 1),
        ...     torch.tensor([[4], [2]]),
        ...     torch.tensor([[4], [2]]),
        ... )
        >>> loc[..., 0].tolist()
        [[3.0, 3.0, 3.0, 3.0], [1.0, 1.0, 1.0, 1.0]]
    """

    name: ClassVar[str]
    """Of the prior in options, files and rows."""
    label: ClassVar[str]
    """In tables and figures; the name by default."""
    color: ClassVar[str]
    """In figures; of :data:`PALETTE` by default."""
    prediction_chunks: ClassVar[int] = 1
    """Predicted actions ``P`` per executed ones ``H``."""
    default_sigma: ClassVar[float] = 1.0
    """``sigma`` where none is given."""
    always_warm: ClassVar[bool] = False
    """Whether :meth:`anchor` holds where the window or decision has no mean, as in the first chunk of an
    episode."""
    ever_warm: ClassVar[bool] = True
    """Whether there is ever a mean. Otherwise ``sigma`` and ``cold_probability`` are without effect."""
    is_flow: ClassVar[bool] = True
    """Whether the field is trained at all times. Otherwise it is at ``t = 0`` alone, and one network
    evaluation is all that it is good for."""
    conditions_network: ClassVar[bool] = False
    """Whether the network sees the mean as well, in an observation that :class:`~warmprior.MeanObservation`
    extends in environments and replay buffers."""
    start_time: float = 0.0
    """Time at which samplers start to integrate, see :meth:`start`."""
    least_batch: ClassVar[int] = 1
    """Windows per training step that :meth:`couple` needs."""
    teacher: ClassVar[str | None] = None
    """Name of the prior whose trained policy :meth:`couple` needs; it is handed to :meth:`learn_from`."""
    _registry: ClassVar[dict[str, type[Prior]]] = {}
    _arguments: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Record the arguments, whatever the subclass does with them."""
        self = super().__new__(cls)
        self.__dict__["_arguments"] = _bound(cls, args, kwargs)
        return self

    def __init__(
        self,
        chunk_length: int,
        *,
        sigma: float | None = None,
        cold_probability: float = 0.0,
        correlation: float = 0.0,
    ) -> None:
        if chunk_length < 1:
            raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
        sigma = self.default_sigma if sigma is None else sigma
        shares = {"cold_probability": cold_probability, "correlation": correlation}
        check_finite_numbers(sigma=sigma, **shares)
        if sigma < 0:
            raise ValueError(f"sigma must be a finite number >= 0, got {sigma}")
        for name, share in shares.items():
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {share}")
        self.chunk_length = int(chunk_length)
        self.sigma = float(sigma)
        self.cold_probability = float(cold_probability)
        self.correlation = float(correlation)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__:
            return
        if not re.fullmatch(r"[\w.+-]+", cls.name):
            raise ValueError(f"a prior's name becomes that of files: {cls.name!r} cannot")
        taken = Prior._registry.get(cls.name)
        # The same class once more, as when a notebook's cell runs again, replaces itself.
        if taken is not None and _place(taken) != _place(cls):
            raise ValueError(
                f"a prior named {cls.name!r} exists already ({_place(taken)}): choose another name for "
                f"{_place(cls)}"
            )
        Prior._registry[cls.name] = cls
        if "label" not in cls.__dict__:
            cls.label = cls.name
        if "color" not in cls.__dict__:
            cls.color = PALETTE[zlib.crc32(cls.name.encode()) % len(PALETTE)]

    @staticmethod
    def registered() -> Mapping[str, type[Prior]]:
        """All imported priors by name."""
        return MappingProxyType(Prior._registry)

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
            >>> Prior.find("past").label
            'WP-Past'
        """
        name = name.partition(",")[0]
        module, colon, attribute = name.partition(":")
        if not colon:
            if name in Prior._registry:
                return Prior._registry[name]
            raise ValueError(
                f"unknown prior {name!r}: it is none of {', '.join(sorted(Prior._registry))}; name your own "
                "as package.module:Class"
            )
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"there is no prior at {name}: {error}") from error
        if not (isinstance(found, type) and issubclass(found, Prior)):
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
            >>> [Prior.make(name, 8, sigma=0.3) for name in ("past", "regression")]
            [PastPrior(chunk_length=8, sigma=0.3, cold_probability=0.0), RegressionPrior(chunk_length=8)]
            >>> Prior.make("past,correlation=0.5", 8).correlation
            0.5
        """
        found = Prior.find(name)
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

        Where nothing is ever warm, ``sigma``, ``cold_probability`` and ``correlation`` have none.

        Args:
            argument: its name.

        Examples:
            >>> [Prior.find(name).takes("sigma") for name in ("past", "gaussian", "regression")]
            [True, False, False]
            >>> [Prior.find(name).takes("correlation") for name in ("past", "gaussian", "history")]
            [True, False, False]
        """
        parameters = inspect.signature(cls.__init__).parameters
        kinds = [parameter.kind for parameter in parameters.values()]
        named = argument in parameters or inspect.Parameter.VAR_KEYWORD in kinds
        return named and (cls.ever_warm or argument not in WARM_ARGUMENTS)

    @classmethod
    def _takes(cls) -> list[str]:
        """All such arguments, for messages."""
        parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]  # without self
        return [
            f"**{parameter.name}" if parameter.kind is parameter.VAR_KEYWORD else parameter.name
            for parameter in parameters
            if cls.takes(parameter.name)
        ]

    @property
    def moves_source(self) -> bool:
        """Whether :meth:`anchor` is the centre of the source, so that an agent can search around it.

        It is not if nothing is ever warm, or if the mean conditions the network instead.
        """
        return self.ever_warm and not self.conditions_network

    @property
    def residual_sigma(self) -> float:
        """Typical deviation of :meth:`start` from :meth:`anchor`: what residuals without an agent are drawn
        with. ``sigma`` by default.
        """
        return self.sigma

    @property
    def is_gaussian(self) -> bool:
        """Whether the source is that of Eq. 1, drawn independently of the data given the mean."""
        return all(
            getattr(type(self), name) is getattr(Prior, name)
            for name in ("distribution", "sample", "couple", "start")
        )

    @property
    def prediction_length(self) -> int:
        """``P``, the number of actions that the network predicts."""
        return self.chunk_length * self.prediction_chunks

    def sized(self, action_dim: int, observation_dim: int, observation_steps: int) -> Prior:
        """The prior for data of these widths: itself, unless it has networks of its own.

        Args:
            action_dim: ``d_a``.
            observation_dim: ``d_o`` of what the network sees.
            observation_steps: ``To``.
        """
        return self

    def training_mean(
        self, history: Tensor, history_valid: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean of the source for a window cut from demonstrations.

        Args:
            history: the ``H`` actions before the window, ``[*B, H, d_a]``.
            history_valid: which of them lie inside the episode, bool ``[*B, H]``.
            target: the chunk to predict, ``[*B, P, d_a]``.

        Returns:
            ``loc`` ``[*B, P, d_a]`` and ``warm``, bool ``[*B, P, 1]``.
        """
        raise NotImplementedError

    def next_mean(
        self, loc: Tensor, chunk: Tensor, executed_steps: Tensor, elapsed_steps: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean of the source at the next decision, after ``k <= H`` actions of ``chunk`` were executed.

        Args:
            loc: mean at the decision just taken, ``[*B, P, d_a]``.
            chunk: the prediction just made, ``[*B, P, d_a]``.
            executed_steps: ``k``, int64 ``[*B, 1]``.
            elapsed_steps: actions executed since the reset, ``k`` included, int64 ``[*B, 1]``.

        Returns:
            ``loc`` ``[*B, P, d_a]`` and ``warm``, bool ``[*B, P, 1]``.
        """
        raise NotImplementedError

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the source (Eq. 1).

        Args:
            loc: mean of the window or decision, ``[*B, P, d_a]``; ignored on cold positions.
            warm: bool ``[*B, P, 1]``.
            observation: what the network sees, ``[*B, To, d_o]``; the paper's sources make no use of it.

        Returns:
            Both, each broadcastable to ``[*B, P, d_a]``.
        """
        one = torch.ones((), dtype=loc.dtype, device=loc.device)
        return torch.where(warm, loc, 0.0), torch.where(warm, self.sigma * one, one)

    def sample(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Draw the source ``a_0`` from :meth:`distribution`.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            generator: source of randomness on ``loc``'s device; PyTorch's global one by default.
            observation: see :meth:`distribution`.

        Returns:
            ``a_0``, ``[*B, P, d_a]``.
        """
        like: dict[str, Any] = {"dtype": loc.dtype, "device": loc.device, "generator": generator}
        eps = torch.randn(loc.shape, **like)
        if self.correlation:
            common = torch.randn((*loc.shape[:-2], 1, loc.shape[-1]), **like)
            own, shared = math.sqrt(1.0 - self.correlation), math.sqrt(self.correlation)
            eps = torch.where(warm, own * eps + shared * common, eps)
        mean, scale = self.distribution(loc, warm, observation)
        return mean + scale * eps

    def start(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Where samplers start to integrate, at :attr:`start_time`: by default a draw of the source.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            generator: see :meth:`sample`.
            observation: see :meth:`distribution`.

        Returns:
            A point at :attr:`start_time`, ``[*B, P, d_a]``.
        """
        return self.sample(loc, warm, generator, observation)

    def anchor(self, loc: Tensor, warm: Tensor, observation: Tensor | None = None) -> Tensor:
        """Mean of :meth:`start`, around which an agent searches: that of :meth:`distribution` by default.

        It counts on warm positions, or on all (:attr:`always_warm`), if the prior :attr:`moves_source`.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            observation: see :meth:`distribution`.

        Returns:
            A point at :attr:`start_time`, broadcastable to ``[*B, P, d_a]``.
        """
        return self.distribution(loc, warm, observation)[0]

    def couple(
        self,
        a0: Tensor,
        a1: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Pair the sources and targets of a batch; as they come by default.

        Called in training between :meth:`sample` and the loss. The observations belong to the targets:
        permute ``a0`` (optimal transport), or replace ``a1`` by what a teacher makes of ``a0`` (reflow).

        Args:
            a0: source samples, ``[*B, P, d_a]``.
            a1: targets, ``[*B, P, d_a]``.
            generator: source of randomness on their device; PyTorch's global one by default.
            observation: what the network sees, ``[*B, To, d_o]``.

        Returns:
            Both, paired.
        """
        return a0, a1

    def learn_from(self, policy: Any) -> None:
        """Take the trained policy of the :attr:`teacher` prior, for :meth:`couple`.

        Args:
            policy: a :class:`~warmprior.WarmPriorActor` of the same data.
        """
        raise ValueError(f"{self.name} has no teacher")

    def allowed_nfes(self, nfes: Sequence[int]) -> list[int]:
        """Those numbers of network evaluations per chunk for which the trained field means anything.

        Args:
            nfes: to choose from; their order stays.

        Raises:
            ValueError: if none is left.

        Examples:
            >>> Prior.find("regression")(8).allowed_nfes([9, 3, 1])
            [1]
        """
        allowed = [nfe for nfe in nfes if self.is_flow or nfe == 1]
        if not allowed:
            raise ValueError(
                f"{self.name} is trained for one network evaluation per chunk, and {list(nfes)} has none "
                "of 1: add NFE 1, or leave it out"
            )
        return allowed

    def withhold(self, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Turn a share ``cold_probability`` of the samples cold, whole samples at a time.

        Args:
            warm: bool ``[*B, P, 1]``.
            generator: source of randomness on ``warm``'s device.
        """
        if self.cold_probability == 0.0:
            return warm
        draw = torch.rand(warm.shape[:-2], generator=generator, device=warm.device)
        return warm & (draw >= self.cold_probability)[..., None, None]

    @staticmethod
    def positions(start: Tensor, like: Tensor, length: int) -> Tensor:
        """Gather index of the ``length`` time steps from ``start`` (``[*B, 1]``) on, along dim -2."""
        index = start + torch.arange(length, device=start.device)
        return index.unsqueeze(-1).expand(*index.shape, like.shape[-1])

    def config(self) -> dict[str, Any]:
        """Name and constructor arguments as JSON holds them; :meth:`from_config` reverses it.

        Raises:
            TypeError: if an argument is nothing that JSON can hold, or the class has no name of its own.

        Examples:
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
            >>> Prior.from_config({"name": "past", "chunk_length": 8})
            PastPrior(chunk_length=8, sigma=0.5, cold_probability=0.0)
        """
        kwargs = dict(config)
        name = kwargs.pop("name", None)
        if name not in Prior._registry:
            known = ", ".join(sorted(Prior._registry))
            raise ValueError(
                f"unknown prior {name!r}; known: {known}. Import the module that defines a custom "
                "prior before loading it."
            )
        return Prior._registry[name](**kwargs)

    untold: ClassVar[frozenset[str]] = frozenset({"chunk_length", "sigma", "cold_probability"})
    """Arguments that :attr:`options` leaves out, since others tell them."""

    @property
    def options(self) -> str:
        """The other arguments that are not at their defaults, as :meth:`make` takes them.

        Examples:
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


def _check_named(cls: type[Prior]) -> None:
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
    except (
        TypeError
    ):  # a copy, which brings its arguments along; or a mistake that the call itself tells
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
