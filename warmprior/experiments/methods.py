"""What is compared: a source, and what else is composed with it, under a name, a label and a colour."""

from __future__ import annotations

import inspect
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from warmprior import keys
from warmprior.experiments.learned_sources import (
    A2APrior,
    CVAEPrior,
    ForecastPrior,
    ForecastStart,
    LeapPrior,
    Learner,
)
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import GaussianPrior, PastPrior, PreviewPrior, Prior, Source
from warmprior.modules.registry import find, options_of
from warmprior.modules.start import StartPoint
from warmprior.objectives.couplings import Coupling, OTCoupling, ReflowCoupling
from warmprior.rl.anchor import has_anchor
from warmprior.training.training_config import TrainingConfig
from warmprior.transforms.history_observation import HistoryObservation

__all__ = ["METHODS", "Composition", "Method", "PointPrior"]

PALETTE = ("#1b9e77", "#e7298a", "#66a61e", "#a6761d", "#e41a1c", "#377eb8", "#984ea3", "#17becf")
"""Colours of users' own priors."""


class PointPrior(GaussianPrior):
    """The source of a regression: the point 0."""

    name = "point"

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length)
        self.sigma = 0.0

    def distribution(self, history: Any, observation: Any = None) -> Source:
        """The point 0; nothing is drawn."""
        loc, scale, warm = super().distribution(history, observation)
        return _Point(loc, torch.zeros_like(scale), warm)


class _Point(Source):
    def sample(self, generator: torch.Generator | None = None) -> Tensor:
        return self.loc


@dataclass(frozen=True)
class Composition:
    """The parts of a method.

    Attributes:
        label: in tables and figures.
        color: in figures.
        prior: class of the source.
        start: class of the point where samplers start.
        coupling: makes the pairing of sources and targets, of options of its own and the teacher if any.
        teacher: name of the method whose policy the coupling needs.
        sees_history: whether the network sees the last actions.
        regresses: whether the field is trained at ``t = 0`` alone, for one network evaluation.
    """

    label: str
    color: str
    prior: type[Prior] = GaussianPrior
    start: type[StartPoint] | None = None
    coupling: Callable[..., Coupling] | None = None
    teacher: str | None = None
    sees_history: bool = False
    regresses: bool = False


def _reflow(teacher: WarmPriorActor, teacher_nfe: int = 9) -> ReflowCoupling:
    return ReflowCoupling(teacher, teacher_nfe)


METHODS: dict[str, Composition] = {
    "gaussian": Composition("Base", "#7f7f7f"),
    "past": Composition("WP-Past", "#1f77b4", PastPrior),
    "preview": Composition("WP-Preview", "#d95f02", PreviewPrior),
    "forecast": Composition("WP-Forecast", "#d62728", ForecastPrior),
    "history": Composition("History", "#6a51a3", sees_history=True),
    "regression": Composition("Regression", "#b8860b", PointPrior, regresses=True),
    "ot": Composition("OT-CFM", "#2ca02c", coupling=OTCoupling),
    "reflow": Composition("2-rectified flow", "#17becf", coupling=_reflow, teacher="gaussian"),
    "step": Composition("STEP", "#00695c", start=ForecastStart),
    "cvae": Composition("CVAE source", "#c51b7d", CVAEPrior),
    "a2a": Composition("A2A (action space)", "#7f3b08", A2APrior),
    "leap": Composition("Learnable prior", "#b8a9c9", LeapPrior),
}
"""All named ones. A prior of a user's own is a method as well, by ``package.module:Class``."""


@dataclass(frozen=True)
class Method:
    """One method of a comparison, with its options.

    Attributes:
        name: a key of :data:`METHODS`, or the name of a registered prior.
        chunk_length: ``H``.
        arguments: other options, of whichever part takes them; those at their defaults are left out, so
            that equal methods are equal.

    Raises:
        ValueError: if there is no such method, or an option is unknown or out of range.

    Examples:
        >>> method = Method.parse("past,correlation=0.5", 8, sigma=0.3)
        >>> method.label, method.options, method.sigma, method.describe()
        ('WP-Past', 'correlation=0.5', 0.3, 'past, sigma 0.3, H 8, correlation=0.5')
        >>> Method.parse("regression", 8).allowed_nfes([9, 3, 1])
        [1]
    """

    name: str
    chunk_length: int
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        known = self._takes()
        try:
            for key in self.arguments:
                if key not in known:
                    raise ValueError(f"{key} is unknown to it, or without effect")
            self.prior()
            if self.composition.start is not None:
                self.start()
            if self.pairs_in_batch:
                self.coupling()
        except (TypeError, ValueError, ArithmeticError) as error:
            given = {"chunk_length": self.chunk_length, **self.arguments}
            written = (f"{key}={value!r}" for key, value in given.items())
            raise ValueError(
                f"{self.name} cannot be built from {', '.join(written)} ({error}): it takes "
                f"{', '.join(['chunk_length', *known])}"
            ) from error
        defaults = known | {"sigma": self.composition.prior.default_sigma}
        own = {
            k: v
            for k, v in sorted(self.arguments.items())
            if v is not None and v != defaults.get(k)
        }
        object.__setattr__(self, "arguments", own)

    @classmethod
    def parse(cls, text: str, chunk_length: int, *, sigma: float | None = None) -> Method:
        """The method of a name and options, as in ``"preview,correlation=0.5"``.

        Args:
            text: the name, or ``package.module:Class`` of a prior, which is imported; options behind it.
            chunk_length: ``H``.

        Keyword Args:
            sigma: residual noise; left out where the method takes none.
        """
        name = text.partition(",")[0]
        if name not in METHODS:
            try:
                found = find(Prior, name)
            except ValueError as error:
                raise ValueError(f"{error}; methods: {', '.join(METHODS)}") from error
            name = found.name
            if name in METHODS and METHODS[name].prior is not found:
                raise ValueError(
                    f"{found.__name__} has the name of the method {name!r}: set another class attribute name"
                )
        arguments = options_of(text)
        if sigma is not None and cls.takes(text, "sigma"):
            if "sigma" in arguments:
                raise ValueError(f"sigma is given twice: also as {sigma}")
            arguments["sigma"] = sigma
        return cls(name, chunk_length, arguments)

    @classmethod
    def takes(cls, text: str, argument: str) -> bool:
        """Whether a method has such an option.

        Args:
            text: see :meth:`parse`.
            argument: its name.
        """
        name = text.partition(",")[0]
        prior = METHODS[name].prior if name in METHODS else find(Prior, name)
        return argument in _parameters(prior)

    @property
    def composition(self) -> Composition:
        """Its parts."""
        if self.name in METHODS:
            return METHODS[self.name]
        color = PALETTE[zlib.crc32(self.name.encode()) % len(PALETTE)]
        return Composition(self.name, color, find(Prior, self.name))

    @property
    def label(self) -> str:
        """In tables and figures."""
        return self.composition.label

    @property
    def sigma(self) -> float:
        """Residual noise of the source."""
        return float(self.prior().sigma)

    @property
    def prediction_length(self) -> int:
        """``P``."""
        return self.prior().prediction_length

    @property
    def teacher(self) -> Method | None:
        """The method whose policy it learns from."""
        name = self.composition.teacher
        return None if name is None else Method(name, self.chunk_length)

    @property
    def sees_history(self) -> bool:
        """Whether the network sees the last actions."""
        return self.composition.sees_history

    @property
    def is_flow(self) -> bool:
        """Whether the field is trained at all times."""
        return not self.composition.regresses

    @property
    def pairs_in_batch(self) -> bool:
        """Whether the windows of a batch are paired, so that it needs two of them."""
        return self.composition.coupling is OTCoupling

    @property
    def needs_vector(self) -> bool:
        """Whether it reads the observation, as one tensor: it cannot go with images."""
        parts = (self.composition.prior, self.composition.start)
        seen = any(getattr(part, "sees_observation", False) for part in parts)
        return seen or (self.pairs_in_batch and self.arguments.get("observation_weight", 1.0) > 0)

    @property
    def has_anchor(self) -> bool:
        """Whether agents search around a centre that moves, see :func:`~warmprior.rl.has_anchor`."""
        return has_anchor(SimpleNamespace(prior=self.prior(), start=self.start(), network=None))

    @property
    def remembers(self) -> bool:
        """Whether its chunks depend on what was done before."""
        part = self.composition.start or self.composition.prior
        return self.sees_history or (self.has_anchor and getattr(part, "sees_history", True))

    def recipe(self, training: TrainingConfig) -> TrainingConfig:
        """A recipe of behaviour cloning as it is for this method.

        A regression is trained at ``t = 0`` alone, and nothing is withheld where nothing is remembered.

        Args:
            training: that of all methods.
        """
        own: dict[str, Any] = {} if self.is_flow else {"times": "start"}
        own |= {} if self.remembers else {"cold_probability": 0.0}
        return replace(training, **own)

    @property
    def options(self) -> str:
        """The other arguments that are not at their defaults, as :meth:`parse` takes them."""
        options = (item for item in self.arguments.items() if item[0] != "sigma")
        return ",".join(f"{key}={json.dumps(value)}" for key, value in options)

    def describe(self) -> str:
        """The method in a few words, for progress bars and figures."""
        parts = [self.name, f"sigma {self.sigma:g}", f"H {self.chunk_length}", self.options]
        return ", ".join(filter(None, parts))

    def config(self) -> dict[str, Any]:
        """What it is, as JSON holds it; ``Method(**config)`` reverses it."""
        return {"name": self.name, "chunk_length": self.chunk_length, "arguments": self.arguments}

    def allowed_nfes(self, nfes: Sequence[int]) -> list[int]:
        """Those numbers of network evaluations per chunk for which its field means anything.

        Args:
            nfes: to choose from; their order stays.

        Raises:
            ValueError: if none is left.
        """
        allowed = [nfe for nfe in nfes if self.is_flow or nfe == 1]
        if not allowed:
            raise ValueError(
                f"{self.name} is trained for one network evaluation per chunk, and {list(nfes)} has none "
                "of 1: add NFE 1, or leave it out"
            )
        return allowed

    def prior(self, widths: Sequence[int] = ()) -> Prior:
        """A fresh source.

        Args:
            widths: ``d_a``, ``d_o`` and ``To``, for one that learns.
        """
        return self._part(self.composition.prior, widths)

    def start(self, widths: Sequence[int] = ()) -> StartPoint | None:
        """A fresh start point, if samplers do not start at the source.

        Args:
            widths: see :meth:`prior`.
        """
        kind = self.composition.start
        return None if kind is None else self._part(kind, widths)

    def coupling(self, teacher: WarmPriorActor | None = None) -> Coupling | None:
        """How sources and targets are paired, if not as they come.

        Args:
            teacher: policy of the :attr:`teacher`, where there is one.
        """
        make = self.composition.coupling
        if make is None:
            return None
        options = {k: v for k, v in self.arguments.items() if k in _parameters(make)}
        return make(**options) if teacher is None else make(teacher, **options)

    def actor(
        self, network: Any, prior: Prior, start: StartPoint | None, **options: Any
    ) -> WarmPriorActor:
        """A policy of the method.

        Args:
            network: the velocity network.
            prior: what :meth:`prior` gave.
            start: what :meth:`start` gave.
            options: further ones of :class:`~warmprior.WarmPriorActor`.
        """
        return WarmPriorActor(
            network,
            prior,
            start=start,
            max_nfe=None if self.is_flow else 1,
            observation_key=keys.CONDITIONED if self.sees_history else keys.OBSERVATION,
            **options,
        )

    def extra_width(self, action_dim: int) -> int:
        """By how much the network's observation is wider than the environment's."""
        return HistoryObservation.width(self.chunk_length, action_dim) * self.sees_history

    def __str__(self) -> str:
        return self.describe()

    def __hash__(self) -> int:
        return hash(self.describe())

    def _part(self, kind: Any, widths: Sequence[int]) -> Any:
        taken = _parameters(kind)
        options = {k: v for k, v in self.arguments.items() if k in taken}
        if widths and issubclass(kind, Learner):
            options["widths"] = list(widths)
        return kind(self.chunk_length, **options)

    def _takes(self) -> dict[str, Any]:
        """All options of its parts, with their defaults."""
        parts = (self.composition.prior, self.composition.start, self.composition.coupling)
        found: dict[str, Any] = {}
        for part in parts:
            found |= {} if part is None else _parameters(part)
        return found


def _parameters(part: Any) -> dict[str, Any]:
    """Options of a constructor or function, with their defaults."""
    parameters = inspect.signature(part).parameters.values()
    own = ("chunk_length", "teacher", "widths")  # these follow from the rest, and are no options
    return {
        p.name: p.default
        for p in parameters
        if p.name not in own and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }
