"""What the benchmarks compare: sources, and what other papers combine with a source, by name.

`past,correlation=0.5`, `ot`, `regression`, ...: the table below composes them of the library's parts.
A source of your own is a class with one method, `--prior gaussian my_module:Damped` with `my_module.py`:

    class Damped(warmprior.PastPrior):
        name = "damped"

        def mean(self, history):
            loc, warm = super().mean(history)
            return 0.9 * loc, warm
"""

from __future__ import annotations

import inspect
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from lab.bridge import BridgeCoupling
from lab.learned_sources import A2APrior, CVAEPrior, Drawn, ForecastPrior, ForecastStart, LeapPrior, Learner
from lab.mip import SECOND, MIPCoupling, TwoStepCoupling
from warmprior import GaussianPrior, PastPrior, PreviewPrior, Prior, StartPoint, WarmPriorActor
from warmprior.checks import check_finite_numbers
from warmprior.io.files import digest_of
from warmprior.modules.option_text import find, options_of
from warmprior.modules.prior import Source
from warmprior.objectives import Coupling, OTCoupling, ReflowCoupling
from warmprior.rl import has_anchor
from warmprior.training import TrainingConfig


class ColdPrior(GaussianPrior):
    """N(0, I) for a policy that predicts `chunks` chunks per executed one."""

    name = "cold"

    def __init__(self, chunk_length: int, chunks: int) -> None:
        super().__init__(chunk_length)
        self.chunks = self.prediction_chunks = chunks


class TwoChunkPrior(ColdPrior):
    """N(0, I) for a policy that forecasts the next chunk as well."""

    name = "two-chunks"

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length, 2)


class WarmStart(StartPoint):
    r"""A warm start without training: the flow of N(0, I) is entered on the way, from the last forecast.

    .. math:: a_s = (1 - s) \varepsilon + s f,

    where :math:`f` is what the policy forecast last, as it is known, and held at its last action after that
    (One-Step Flow Policy, Li et al., 2026, arXiv:2603.12480). An episode begins with a forecast of 0.
    """

    name = "warm-start"
    sees_history = False  # in training, where it has no part

    def __init__(self, chunk_length: int, start_time: float = 0.5) -> None:
        super().__init__()
        check_finite_numbers(start_time=start_time)
        if not 0.0 < start_time < 1.0:
            raise ValueError(f"need 0 < start_time < 1, got {start_time}")
        self.chunk_length = chunk_length
        self.start_time = self.time = start_time
        self.noise_share = 1.0 - start_time

    def centre(self, history: Any, observation: Any) -> torch.Tensor:
        forecast, steps = history["forecast"], history["forecast_steps"]
        position = torch.arange(forecast.shape[-2], device=steps.device)
        known = torch.minimum(position, (steps - 1).clamp_min(0)).unsqueeze(-1)
        return self.time * forecast.gather(-2, known.expand_as(forecast))

    def forward(self, noise: torch.Tensor, history: Any, observation: Any) -> torch.Tensor:
        return self.centre(history, observation) + self.noise_share * noise


class PointPrior(GaussianPrior):
    """The source of a regression: the point 0, and nothing is drawn."""

    name = "point"

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length)
        self.sigma = 0.0

    def distribution(self, history: Any, observation: Any = None) -> Source:
        source = super().distribution(history, observation)
        none = torch.zeros_like(source.scale)
        return Drawn(source.loc, none, source.warm, by=lambda generator, temperature: source.loc)


def reflow(teacher: WarmPriorActor, teacher_nfe: int = 9) -> ReflowCoupling:
    """Pairs of a source sample and what the teacher's flow makes of it."""
    return ReflowCoupling(teacher, teacher_nfe)


def bridge(noise: float = 0.5, observation_weight: float = 10.0) -> BridgeCoupling:
    """Pairs of a Schroedinger bridge; its noise is not the sigma of a source."""
    return BridgeCoupling(noise, observation_weight)


@dataclass(frozen=True)
class Composition:
    """The parts of a method."""

    label: str  # in tables and figures
    color: str
    prior: type[Prior] = GaussianPrior
    start: type | None = None  # where samplers start, if not at the source
    coupling: Callable[..., Coupling] | None = None  # of sources and targets, if not as they come
    teacher: str | None = None  # the method whose policy the coupling needs
    sees_history: bool = False  # the network sees the last actions
    played: Mapping[str, Any] = field(default_factory=dict)  # options of `Sampling`, where it is no flow


TWO_STEPS = {"nfe": 2, "grid": f"dense-jump:{SECOND}", "temperature": 0.0}

METHODS: dict[str, Composition] = {
    "gaussian": Composition("Gaussian source", "#7f7f7f"),
    "past": Composition("WP-Past", "#1f77b4", PastPrior),
    "preview": Composition("WP-Preview", "#d95f02", PreviewPrior),
    "forecast": Composition("WP-Forecast", "#d62728", ForecastPrior),
    "history": Composition("History", "#6a51a3", sees_history=True),
    "regression": Composition("Regression", "#b8860b", PointPrior, played={"nfe": 1}),
    "mip": Composition("MIP", "#393b79", coupling=MIPCoupling, played=TWO_STEPS),
    "mip-past": Composition(
        "MIP from WP-Past", "#5254a3", PastPrior, coupling=TwoStepCoupling, played=TWO_STEPS
    ),
    "warm-start": Composition("Warm start", "#e6550d", TwoChunkPrior, start=WarmStart),
    "ot": Composition("OT-CFM", "#2ca02c", coupling=OTCoupling),
    "bridge": Composition("SB-CFM", "#98df8a", coupling=bridge),
    "reflow": Composition("2-rectified flow", "#17becf", coupling=reflow, teacher="gaussian"),
    "step": Composition("STEP", "#00695c", start=ForecastStart),
    "cvae": Composition("CVAE source", "#c51b7d", CVAEPrior),
    "a2a": Composition("A2A (action space)", "#7f3b08", A2APrior),
    "leap": Composition("LeaP", "#b8a9c9", LeapPrior),
}

OWN_COLORS = ["#1b9e77", "#e7298a", "#66a61e", "#a6761d", "#e41a1c", "#377eb8", "#984ea3", "#17becf"]


def composition(name: str) -> Composition:
    """The parts behind a name: of the table, or those of a user's own prior."""
    if name in METHODS:
        return METHODS[name]
    found = find(Prior, name)
    if found.__module__.partition(".")[0] in ("warmprior", "lab"):
        raise ValueError(f"{name} is a part of methods, and none itself")
    if found.mean is Prior.mean and found.distribution is Prior.distribution:
        raise ValueError(f"{name} has neither a mean nor a distribution of its own")
    if found.name in METHODS:
        raise ValueError(
            f"{name} has the name of the method {found.name!r}: set another class attribute name"
        )
    return Composition(found.name, color(found.name), found)


def label(name: str, options: str = "") -> str:
    """What tables and figures call a method: `WP-Past, correlation=0.5`."""
    return ", ".join(filter(None, (METHODS[name].label if name in METHODS else name, options)))


def color(name: str) -> str:
    """Its colour in figures; a user's own prior has one that depends on its name alone."""
    if name in METHODS:
        return METHODS[name].color
    return OWN_COLORS[zlib.crc32(name.encode()) % len(OWN_COLORS)]


@dataclass(frozen=True, eq=False)
class Method:
    """One method of a comparison: its name with options, as typed, the chunk length H and the residual noise.

    Methods are equal if they do the same: options at their defaults are left out.
    """

    text: str  # `past,correlation=0.5`, or package.module:Class of a prior of your own
    chunk_length: int
    sigma_asked: float | None = None  # ignored where the method takes none
    parts: Composition = field(init=False, repr=False)
    arguments: dict[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        typed = self.text.partition(",")[0]
        try:
            parts = composition(typed)
        except ValueError as error:
            names = ", ".join(METHODS)
            raise ValueError(f"--prior {self.text}: {error}; methods: {names}") from error
        object.__setattr__(self, "parts", parts)
        known: dict[str, Any] = {}
        for part in filter(None, (parts.prior, parts.start, parts.coupling)):
            known |= _parameters(part)
        known |= {"sigma": parts.prior.default_sigma} if "sigma" in known else {}
        given = options_of(self.text)
        if self.sigma_asked is not None and "sigma" in known:
            if "sigma" in given:
                raise ValueError(f"--prior {self.text} and --sigma {self.sigma_asked:g} both set sigma")
            given["sigma"] = float(self.sigma_asked)
        own = {k: v for k, v in sorted(given.items()) if v is not None and v != known.get(k)}
        object.__setattr__(self, "arguments", own)
        try:
            if unknown := given.keys() - known.keys():
                raise ValueError(f"{', '.join(sorted(unknown))} is unknown to it, or without effect")
            self.prior(), self.start()
            if self.pairs_in_batch:
                self.coupling()
        except (TypeError, ValueError, ArithmeticError) as error:
            raise ValueError(
                f"--prior {self.text} with H = {self.chunk_length}: {error}; its options are "
                f"{', '.join(known) or 'none'}"
            ) from error

    def __reduce__(self) -> Any:
        # A fresh process imports a prior of the user's own again, by what the user typed.
        return Method, (self.text, self.chunk_length, self.sigma_asked)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Method) and self.config() == other.config()

    def __hash__(self) -> int:
        return hash(str(self))

    def __str__(self) -> str:
        parts = [self.name, f"sigma {self.sigma:g}", f"H {self.chunk_length}", self.options]
        return ", ".join(filter(None, parts))

    def config(self) -> dict[str, Any]:
        """Everything that makes it differ from others, as JSON."""
        config = {"name": self.name, "chunk_length": self.chunk_length, "arguments": self.arguments}
        if self.text.partition(",")[0] not in METHODS:
            # Whoever edits a prior of their own wants it trained anew.
            file = inspect.getfile(self.parts.prior)
            config["code"] = digest_of(Path(file).read_text(encoding="utf-8"))
        return config

    @property
    def facts(self) -> dict[str, Any]:
        known = {"prior": self.name, "options": self.options, "sigma": self.sigma}
        return {**known, "chunk": self.chunk_length}

    @property
    def name(self) -> str:
        """A key of the table, or the name of a user's own prior."""
        typed = self.text.partition(",")[0]
        return typed if typed in METHODS else self.parts.prior.name

    @property
    def options(self) -> str:
        """Its other options that are not at their defaults, as they are typed."""
        return ",".join(f"{k}={json.dumps(v)}" for k, v in self.arguments.items() if k != "sigma")

    @cached_property
    def sigma(self) -> float:
        return float(self.prior().sigma)

    @cached_property
    def prediction_length(self) -> int:
        return self.prior().prediction_length

    @property
    def is_flow(self) -> bool:
        """It is a flow if the field is trained at all times: any number of steps then integrates it."""
        return not self.parts.played

    @property
    def is_regression(self) -> bool:
        """A regression is trained at ``t = 0`` alone."""
        return self.parts.prior is PointPrior

    @property
    def is_straight(self) -> bool:
        """Whether its path is the straight line, on which a velocity predicts the sample."""
        return self.parts.coupling is not bridge

    @property
    def pairs_in_batch(self) -> bool:
        """Whether the windows of a batch are paired, so that it needs two of them."""
        return self.parts.coupling in (OTCoupling, bridge)

    @property
    def needs_vector(self) -> bool:
        """Whether it reads the observation as one tensor, so that it cannot go with images."""
        parts = self.parts.prior, self.parts.start
        seen = any(getattr(part, "sees_observation", False) for part in parts)
        return seen or (self.pairs_in_batch and self.arguments.get("observation_weight", 1.0) > 0)

    @cached_property
    def has_anchor(self) -> bool:
        """Whether agents search around a centre that moves."""
        return has_anchor(SimpleNamespace(prior=self.prior(), start=self.start(), network=None))

    @property
    def remembers(self) -> bool:
        """Whether its chunks depend on what was done before."""
        part = self.parts.start or self.parts.prior
        return self.parts.sees_history or (self.has_anchor and getattr(part, "sees_history", True))

    @property
    def teacher(self) -> Method | None:
        name = self.parts.teacher
        return None if name is None else Method(name, self.chunk_length)

    def nfes(self, asked: Sequence[int]) -> list[int]:
        """Return with how many network evaluations it is played, the largest first; its own if no flow."""
        return sorted(set(asked), reverse=True) if self.is_flow else [self.parts.played["nfe"]]

    def temperatures(self, asked: Sequence[float]) -> Sequence[float]:
        """The factors of the source's noise that it is played with."""
        return [self.parts.played["temperature"]] if "temperature" in self.parts.played else asked

    def recipe(self, training: TrainingConfig) -> TrainingConfig:
        """The recipe of this method: no history is withheld in vain; what is no flow has its own times."""
        times = "start" if self.is_regression else "uniform"  # which a coupling's own replace
        own: dict[str, Any] = {} if self.is_flow else {"times": times}
        return replace(training, **own | ({} if self.remembers else {"cold_probability": 0.0}))

    def prior(self, widths: Sequence[int] = ()) -> Prior:
        """A fresh source; one that learns is given the widths d_a, d_o and To."""
        return self._make(self.parts.prior, widths)

    def start(self, widths: Sequence[int] = ()) -> Any:
        return None if self.parts.start is None else self._make(self.parts.start, widths)

    def coupling(self, teacher: WarmPriorActor | None = None) -> Coupling | None:
        """How sources and targets are paired, if not as they come."""
        make = self.parts.coupling
        return None if make is None else make(*([teacher] if teacher else []), **self._own(make))

    def _own(self, make: Any) -> dict[str, Any]:
        """Those of its options that a part takes."""
        return {k: v for k, v in self.arguments.items() if k in _parameters(make)}

    def _make(self, kind: Any, widths: Sequence[int]) -> Any:
        learns = widths and issubclass(kind, Learner)
        more = {"widths": list(widths)} if learns else {}
        return kind(self.chunk_length, **self._own(kind), **more)


def _parameters(part: Any) -> dict[str, Any]:
    """Options of a constructor or function, with their defaults; the rest follows from the method."""
    return {
        p.name: p.default
        for p in inspect.signature(part).parameters.values()
        if p.name not in ("chunk_length", "teacher", "widths")
        and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }
