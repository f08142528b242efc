"""The options that all benchmarks share: a dataclass per concern.

Every option is declared once: here, in `DataOptions` (lab/tasks.py), or in the library's `NetworkOptions` and
`TrainingConfig`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from lab.methods import Method
from lab.tasks import (
    DataOptions,
    check_counts,
    check_network,
    check_place,
    is_simulated,
)
from warmprior.data.opening import name_of_place
from warmprior.io.distributed import check_batch, launched
from warmprior.modules.ode import Sampling, check_grid
from warmprior.training import NetworkOptions, TrainingConfig

Flat = tyro.conf.OmitArgPrefixes  # --episodes, not --evaluation.episodes


def check_given(options: Any, *names: str) -> None:
    """Refuse an option that takes several values and has none."""
    for name in names:
        if not getattr(options, name):
            raise ValueError(f"--{name} needs at least one value")


@dataclass(frozen=True)
class Sources:
    """The methods to compare."""

    # By name (gaussian, past, preview, forecast, history, regression, ot, bridge, reflow, step, cvae, a2a,
    # leap) or, your own, as package.module:Class, which Python has to find (PYTHONPATH); options follow as
    # in preview,correlation=0.5. Gains are over the first.
    prior: tuple[str, ...] = ("gaussian", "past", "preview")
    chunk: tuple[int, ...] = (8,)  # chunk lengths H
    sigma: tuple[float, ...] = ()  # noise of the warm priors, a policy each (default: past 0.5, preview 1.0)

    def __post_init__(self) -> None:
        check_counts(self, "chunk")
        check_given(self, "prior", "chunk")

    def methods(self) -> list[Method]:
        """All of them, chunk length by chunk length, each once."""
        found = [
            Method(text, chunk, sigma)
            for chunk in sorted(set(self.chunk))
            for text in self.prior
            for sigma in self.sigma or (None,)
        ]
        return list(dict.fromkeys(found))


@dataclass(frozen=True)
class Evaluation:
    """How policies are played."""

    seeds: int = 1  # number of training seeds, from --seed on
    episodes: int = 25  # evaluation episodes per cell
    nfe: tuple[int, ...] = (9, 3, 1)  # network evaluations per chunk
    temperature: tuple[float, ...] = (1.0,)  # factors of the source's noise at decisions: a row each
    top_k: int = 1  # best checkpoints averaged per seed
    play_on: bool = False  # go on after success, up to the time limit; success at any step counts
    grid: str = "uniform"  # uniform, or dense-jump (one last step from half way; dense-jump:0.7 from there)

    def __post_init__(self) -> None:
        check_counts(self, "seeds", "episodes", "nfe", "top_k")
        check_given(self, "nfe", "temperature")
        for temperature in self.temperature:
            Sampling(temperature=temperature)
        check_grid(self.grid)

    @property
    def environment(self) -> dict[str, Any]:
        return {"terminate_on_success": False} if self.play_on else {}


@dataclass(frozen=True)
class Run:
    """Where and how to compute."""

    # What the other options start from: quick, cpu, paper, or much-ado (the paper's with the details of the
    # public code that it may stand on); navigation1d.py has quick and paper, prior_space_rl.py quick, unit
    # and paper.
    preset: str = "quick"
    out: Path | None = None  # output folder (default: a numbered one under runs/)
    resume: bool = False  # continue in --out, or in the latest default folder, with the options stored there
    envs: int | None = None  # worker processes, with the same results (default: one per core)
    device: str = "cpu"  # of networks and data, such as cuda; under torchrun each process takes its own
    videos: bool = True  # save a video and a filmstrip of one episode per method, which takes time
    compile: bool = False  # torch.compile the network in training
    logger: Literal["csv", "tensorboard", "wandb", "none"] = "csv"  # of the training curves
    engine: Literal["local", "ray"] = "local"  # where jobs run: processes of this machine, or a Ray cluster
    ray_address: str | None = None  # HOST:PORT of its head (default: $RAY_ADDRESS, or this machine alone)

    def __post_init__(self) -> None:
        check_counts(self, "envs")
        if self.ray_address is not None and self.engine != "ray":
            raise ValueError("--ray-address belongs to --engine ray")
        if self.engine == "ray" and launched():
            raise ValueError("--engine ray distributes the work itself: start it without torchrun")
        if self.engine == "ray" and ":" in self.device:
            raise ValueError(f"--device {self.device}: with --engine ray, Ray chooses the GPU: use cuda")

    @property
    def folder(self) -> Path:
        """The output folder, which `parse` has chosen where none was given."""
        assert self.out is not None
        return self.out

    @property
    def policies(self) -> Path:
        """Where policies lie: beside the run, so that others share them."""
        return self.folder.absolute().parent / "policies"


@dataclass(frozen=True)
class Options:
    """Everything that determines a comparison of sources."""

    data: Annotated[DataOptions, Flat] = field(default_factory=DataOptions)
    network: Annotated[NetworkOptions, Flat] = field(default_factory=NetworkOptions)
    training: Annotated[TrainingConfig, Flat] = field(default_factory=TrainingConfig)
    sources: Annotated[Sources, Flat] = field(default_factory=Sources)
    evaluation: Annotated[Evaluation, Flat] = field(default_factory=Evaluation)
    run: Annotated[Run, Flat] = field(default_factory=Run)

    @property
    def name(self) -> str:
        """Of the tasks, in names of folders."""
        file = self.data.dataset
        tasks = self.data.task or ("square" if file is None else name_of_place(file),)
        space = [] if self.data.actions == "delta" else [self.data.actions]
        seen = [] if self.data.obs == "state" else [self.data.obs]
        own = [task.replace(":", "-") for task in tasks]
        return "-".join([*own, *self.data.data, *space, *seen])

    @property
    def seeds(self) -> range:
        return range(self.training.seed, self.training.seed + self.evaluation.seeds)

    def trainings(self) -> list[TrainingConfig]:
        return [self.training]

    def check(self) -> None:
        self.data.check()
        check_network(self.network, self.data)
        check_batch(self.training.batch_size)
        try:
            with torch.device("meta"):  # nothing is computed
                self.network.without_images().make(1, 1, 2)
        except ValueError as error:
            raise ValueError(f"--hidden-dim {self.network.hidden_dim}: {error}") from error
        if self.data.actions != "delta" and any(":" in task for task in self.data.task):
            raise ValueError(
                "--actions absolute belongs to robosuite's tasks, and a task of your own has its own: add "
                "--actions delta"
            )
        if self.evaluation.play_on and not all(map(is_simulated, self.data.task)):
            raise ValueError("--play-on belongs to robosuite's tasks: leave it out")
        if self.training.weighting == "standardised" and not self.network.precondition:
            raise ValueError("--no-precondition needs --weighting velocity")
        for method in self.sources.methods():
            if self.training.times == "start" and not method.is_regression:
                raise ValueError(f"--times start trains no flow: leave out {method.name}, or take regression")
            l1, distilled = self.training.objective == "l1", self.training.self_distillation > 0
            if distilled and not method.is_flow:
                raise ValueError(f"--self-distillation needs a flow: leave out {method.name}")
            if (l1 or distilled) and not method.is_straight:
                asked = "--objective l1" if l1 else "--self-distillation"
                raise ValueError(f"{asked} needs a straight path: leave out {method.name}")
            if self.data.obs == "image" and method.needs_vector:
                raise ValueError(
                    f"{method.name} reads observations that are one vector: leave it out with --obs image"
                )
            try:
                method.recipe(self.training)
            except ValueError as error:
                raise ValueError(f"leave out {method.name}, which is no flow: {error}") from error
            if method.pairs_in_batch and self.training.batch_size < 2:
                raise ValueError(f"{method.name} pairs within a batch: --batch-size must be at least 2")


# A finished run, whose policies to take instead of training them.
FinishedRun = Annotated[Path | None, tyro.conf.arg(name="run")]


@dataclass(frozen=True)
class MeasuredOptions(Options):
    """A comparison with measures on observations that no policy was trained on."""

    validation: Path | None = None  # demonstrations to measure on, given as for --dataset (default: new ones)
    observations: int = 500  # how many to measure on; the paper's curvature has 2000

    def check(self) -> None:
        super().check()
        check_single(self, "task", "data", "chunk")
        check_counts(self, "observations")
        if self.validation is not None:
            check_place(self.validation, "--validation")


def check_single(options: Options, *names: str) -> None:
    """Refuse several of what a study has one of, such as `task` or `chunk`."""
    parts = (options.data, options.sources, options.evaluation)
    for name in names:
        values = next(getattr(part, name) for part in parts if hasattr(part, name))
        if len(values) > 1:
            raise ValueError(f"this study has one --{name}, got {' '.join(map(str, values))}")


def with_parts[O](options: O, **parts: Any) -> O:
    """Options with some leaves replaced: by part, or where they are no part's."""
    made: Any = {
        part: replace(getattr(options, part), **values) if isinstance(values, Mapping) else values
        for part, values in parts.items()
    }
    return replace(options, **made)  # type: ignore[type-var]
