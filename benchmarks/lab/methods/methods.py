"""The methods that the benchmarks compare by name: sources, and methods of other papers.

The table below composes them (`past,correlation=0.5`, `ot`, `regression`, ...) from the library's parts. A
source of your own is a class with one method, as in `--prior gaussian my_module:Damped` with `my_module.py`:

    class Damped(warmprior.PastPrior):
        name = "damped"

        def mean(self, history):
            loc, warm = super().mean(history)
            return 0.9 * loc, warm
"""

from __future__ import annotations

import inspect
import json
import sys
import sysconfig
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import torch

from lab.methods.bridge import BridgeCoupling
from lab.methods.learned_sources import A2APrior, CVAEHistoryPrior, ForecastPrior, ForecastStart, LeapPrior
from lab.methods.mip import SECOND, MIPCoupling, TwoStepCoupling
from warmprior import (
    CVAEPrior,
    GaussianPrior,
    OTCoupling,
    PastPrior,
    PreviewPrior,
    Prior,
    ReflowCoupling,
    StartPoint,
    WarmPriorActor,
)
from warmprior.checks import check_finite_numbers
from warmprior.io.files import digest_of, file_digest
from warmprior.modules.source import Source
from warmprior.objectives import Coupling
from warmprior.rl import has_anchor
from warmprior.training import TrainingConfig
from warmprior.training.option_text import find, options_of


class ColdPrior(GaussianPrior):
    """N(0, I) for a policy that predicts `chunks` chunks per executed chunk."""

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
    r"""A warm start without training: the flow of N(0, I) is entered at a later time, from the last forecast.

    .. math:: a_s = (1 - s) \varepsilon + s f,

    where :math:`f` is the policy's last forecast, extended by its last action (One-Step Flow Policy, Li et
    al., 2026, arXiv:2603.12480). At the start of an episode the forecast is 0.
    """

    name = "warm-start"
    sees_history = False  # training does not use it

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
        index = torch.minimum(position, (steps - 1).clamp_min(0)).unsqueeze(-1)
        return self.time * forecast.gather(-2, index.expand_as(forecast))

    def forward(self, noise: torch.Tensor, history: Any, observation: Any) -> torch.Tensor:
        return self.centre(history, observation) + self.noise_share * noise


class Point(Source):
    """A source that is its mean, and draws nothing."""

    def sample(self, generator: torch.Generator | None = None, temperature: float = 1.0) -> torch.Tensor:
        return self.loc


class PointPrior(GaussianPrior):
    """The source of a regression: the point 0, without randomness."""

    name = "point"

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length)
        self.sigma = 0.0

    def distribution(self, history: Any, observation: Any = None) -> Source:
        source = super().distribution(history, observation)
        return Point(source.loc, torch.zeros_like(source.scale), source.warm)


def reflow(teacher: WarmPriorActor, teacher_nfe: int = 9) -> ReflowCoupling:
    """Return the coupling of source samples with the actions that the teacher's flow maps them to."""
    return ReflowCoupling(teacher, teacher_nfe)


def bridge(noise: float = 0.1, observation_weight: float = 10.0) -> BridgeCoupling:
    """Return the coupling of a Schroedinger bridge; its noise is not the sigma of a source.

    Nine Euler steps leave noise of 0.5% of an action's half range, and with a noise of 0.5 they leave 7%.
    """
    return BridgeCoupling(noise, observation_weight)


@dataclass(frozen=True)
class Composition:
    """The parts of a method."""

    label: str  # name in tables and figures
    color: str
    prior: type[Prior] = GaussianPrior
    start: type | None = None  # start point of samplers; the source sample by default
    coupling: Callable[..., Coupling] | None = None  # how source and targets are paired; in order by default
    teacher: str | None = None  # method whose policy the coupling needs
    sees_history: bool = False  # true if the network sees the last actions
    played: Mapping[str, Any] = field(default_factory=dict)  # fixed options of `Sampling`, if it is no flow


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
    "cvae-history": Composition("CVAE source, history", "#f1b6da", CVAEHistoryPrior),
    "a2a": Composition("A2A (action space)", "#7f3b08", A2APrior),
    "leap": Composition("LeaP", "#b8a9c9", LeapPrior),
}

PACKAGES = {"warmprior", "lab", "torch", *sys.stdlib_module_names}  # their code is not the user's own
OWN_COLORS = ["#1b9e77", "#e7298a", "#66a61e", "#a6761d", "#e41a1c", "#377eb8", "#984ea3"]


def composition(name: str) -> Composition:
    """Return the parts of a method: from the table, or of a user's own prior."""
    if name in METHODS:
        return METHODS[name]
    prior = find(Prior, name)
    if prior.__module__.partition(".")[0] in ("warmprior", "lab"):
        raise ValueError(f"{name} is a part of methods, and none itself")
    if prior.mean is Prior.mean and prior.distribution is Prior.distribution:
        raise ValueError(f"{name} has neither a mean nor a distribution of its own")
    if prior.name in METHODS:
        raise ValueError(
            f"{name} has the name of the method {prior.name!r}: set another class attribute name"
        )
    return Composition(prior.name, color(prior.name), prior)


def own_files(kind: type) -> list[Path]:
    """Return the file of a user's class, and those of their own modules that it uses, through any others.

    Installed packages are not their own, but the one that has the class.
    """
    package, installed = kind.__module__.partition(".")[0], sysconfig.get_path("purelib")
    modules, files = [sys.modules[kind.__module__]], []
    for module in modules:  # the list grows
        file, root = getattr(module, "__file__", None), module.__name__.partition(".")[0]
        if file is None or root in PACKAGES or (root != package and file.startswith(installed)):
            continue
        files.append(Path(file))
        # A package also holds the parts that anyone has imported so far, which differ between processes.
        parts = ModuleType if hasattr(module, "__path__") else ()
        values = (value for value in vars(module).values() if not isinstance(value, parts))
        used = map(inspect.getmodule, values)
        modules += [other for other in dict.fromkeys(used) if other is not None and other not in modules]
    return files


def code_digest(kind: type) -> str:
    """Return a digest of a user's code: a policy is trained again when they edit it."""
    return digest_of(*map(file_digest, own_files(kind)))


def label(name: str, options: str = "") -> str:
    """Return the name of a method in tables and figures, such as `WP-Past, correlation=0.5`."""
    return ", ".join(filter(None, (METHODS[name].label if name in METHODS else name, options)))


def color(name: str, taken: Sequence[str] = ()) -> str:
    """Return the colour of a method in figures; a user's own prior gets a free one, by its name."""
    if name in METHODS:
        return METHODS[name].color
    first = zlib.crc32(name.encode()) % len(OWN_COLORS)
    order = OWN_COLORS[first:] + OWN_COLORS[:first]
    return next((one for one in order if one not in taken), order[0])


@dataclass(frozen=True, eq=False)
class Method:
    """A method of a comparison: its name and options as typed, the chunk length H and the residual noise.

    Methods are equal if they do the same, so options at their defaults do not count.
    """

    text: str  # `past,correlation=0.5`, or package.module:Class of a prior of your own
    chunk_length: int
    sigma_option: float | None = None  # ignored if the method takes none
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
        defaults: dict[str, Any] = {}
        for part in filter(None, (parts.prior, parts.start, parts.coupling)):
            defaults |= _parameters(part)
        defaults |= {"sigma": parts.prior.default_sigma} if "sigma" in defaults else {}
        typed_options = options_of(self.text)
        if self.sigma_option is not None and "sigma" in defaults:
            if "sigma" in typed_options:
                raise ValueError(f"--prior {self.text} and --sigma {self.sigma_option:g} both set sigma")
            typed_options["sigma"] = float(self.sigma_option)
        # 1 and 1.0 are the same policy.
        typed_options = {
            k: float(v) if isinstance(defaults.get(k), float) and type(v) is int else v
            for k, v in typed_options.items()
        }
        changed = {k: v for k, v in sorted(typed_options.items()) if v is not None and v != defaults.get(k)}
        object.__setattr__(self, "arguments", changed)
        try:
            if unknown := typed_options.keys() - defaults.keys():
                raise ValueError(f"{', '.join(sorted(unknown))} is unknown to it, or without effect")
            self.prior().config(), self.start()
            if self.pairs_in_batch:
                self.coupling()
        except (TypeError, ValueError, ArithmeticError) as error:
            raise ValueError(
                f"--prior {self.text} with H = {self.chunk_length}: {error}; its options are "
                f"{', '.join(defaults) or 'none'}"
            ) from error

    def __reduce__(self) -> Any:
        # A worker process imports a user's own prior again, by its typed name.
        return Method, (self.text, self.chunk_length, self.sigma_option)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Method) and self.config() == other.config()

    def __hash__(self) -> int:
        return hash(str(self))

    def __str__(self) -> str:
        parts = [self.name, f"sigma {self.sigma:g}", f"H {self.chunk_length}", self.options]
        return ", ".join(filter(None, parts))

    def config(self) -> dict[str, Any]:
        """Return everything that makes it differ from other methods, as JSON."""
        config = {"name": self.name, "chunk_length": self.chunk_length, "arguments": self.arguments}
        if self.text.partition(",")[0] not in METHODS:
            config["code"] = code_digest(self.parts.prior)
        return config

    @property
    def facts(self) -> dict[str, Any]:
        facts = {"prior": self.name, "options": self.options, "sigma": self.sigma}
        return {**facts, "chunk": self.chunk_length}

    @property
    def name(self) -> str:
        """Return a key of the table, or the name of a user's own prior."""
        typed = self.text.partition(",")[0]
        return typed if typed in METHODS else self.parts.prior.name

    @property
    def options(self) -> str:
        """Return its options that differ from their defaults, except sigma, as they are typed."""
        return ",".join(f"{k}={json.dumps(v)}" for k, v in self.arguments.items() if k != "sigma")

    @cached_property
    def sigma(self) -> float:
        return float(self.prior().sigma)

    @cached_property
    def prediction_length(self) -> int:
        return self.prior().prediction_length

    @property
    def is_flow(self) -> bool:
        """Return True if the field is trained at all times, so that any number of steps integrates it."""
        return not self.parts.played

    @property
    def is_regression(self) -> bool:
        """Return True if it is trained at ``t = 0`` alone."""
        return self.parts.prior is PointPrior

    @property
    def is_straight(self) -> bool:
        """Return True if its path is a straight line, on which a velocity predicts the sample."""
        return self.parts.coupling is not bridge

    @property
    def pairs_in_batch(self) -> bool:
        """Return True if it pairs the windows of a batch, and so needs two of them."""
        return self.parts.coupling in (OTCoupling, bridge)

    @property
    def needs_vector(self) -> bool:
        """Return True if it reads the observation as one tensor, and so does not work with images."""
        prior, start = self.parts.prior, self.parts.start
        reads = any(getattr(part, "sees_observation", False) for part in (prior, start))
        reads = reads or issubclass(prior, CVAEPrior)
        return reads or (self.pairs_in_batch and self.arguments.get("observation_weight", 1.0) > 0)

    @cached_property
    def has_anchor(self) -> bool:
        """Return True if agents search around a centre that moves."""
        return has_anchor(SimpleNamespace(prior=self.prior(), start=self.start(), network=None))

    @property
    def remembers(self) -> bool:
        """Return True if its chunks depend on the history."""
        part = self.parts.start or self.parts.prior
        return self.parts.sees_history or getattr(part, "sees_history", self.has_anchor)

    @property
    def teacher(self) -> Method | None:
        name = self.parts.teacher
        return None if name is None else Method(name, self.chunk_length)

    def nfes(self, nfes: Sequence[int]) -> list[int]:
        """Return the NFEs that it is played with, the largest first; a method without a flow has its own."""
        return sorted(set(nfes), reverse=True) if self.is_flow else [self.parts.played["nfe"]]

    def temperatures(self, temperatures: Sequence[float]) -> Sequence[float]:
        """Return the temperatures that it is played with; some methods have their own."""
        played = self.parts.played
        return [played["temperature"]] if "temperature" in played else list(dict.fromkeys(temperatures))

    @property
    def has_two_steps(self) -> bool:
        """Return True if it is trained at two times, and played in these two steps."""
        return self.parts.played == TWO_STEPS

    def recipe(self, training: TrainingConfig) -> TrainingConfig:
        """Return the recipe with this method's times, and without withholding a history that it ignores."""
        times = "start" if self.is_regression else "uniform"  # a coupling may replace these
        changes: dict[str, Any] = {} if self.is_flow else {"times": times}
        return replace(training, **changes | ({} if self.remembers else {"cold_probability": 0.0}))

    def prior(self) -> Prior:
        return self.parts.prior(self.chunk_length, **self._own(self.parts.prior))

    def start(self) -> Any:
        make = self.parts.start
        return None if make is None else make(self.chunk_length, **self._own(make))

    def coupling(self, teacher: WarmPriorActor | None = None) -> Coupling | None:
        """Make the coupling of source and targets; None if they pair in order."""
        make = self.parts.coupling
        return None if make is None else make(*([teacher] if teacher else []), **self._own(make))

    def _own(self, make: Any) -> dict[str, Any]:
        """Return the options that a part takes."""
        return {k: v for k, v in self.arguments.items() if k in _parameters(make)}


def _parameters(part: Any) -> dict[str, Any]:
    """Return the options of a constructor or function with defaults, except those that the method sets."""
    return {
        p.name: p.default
        for p in inspect.signature(part).parameters.values()
        if p.name not in ("chunk_length", "teacher", "widths")
        and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }
