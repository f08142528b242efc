"""The options that all benchmarks share: a dataclass per concern.

Every option is declared once: here, in `DataOptions` (lab/demonstrations/data_options.py), or in the
library's `NetworkOptions` and `TrainingConfig`. Comments of fields are the help texts of the command line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from lab.demonstrations.data_options import (
    DataOptions,
    check_counts,
    check_encoder,
    check_place,
    is_simulated,
    naming,
)
from warmprior.io.distributed import check_batch, launched
from warmprior.options.defaults import EVALUATION_SEED
from warmprior.options.training import NetworkOptions, TrainingConfig

if TYPE_CHECKING:
    from lab.methods.methods import Method

SEEDS_PER_TRAINING = 10_000
"""The number of simulator seeds that each training seed has for its evaluation episodes."""

Flat = tyro.conf.OmitArgPrefixes  # --episodes, not --evaluation.episodes


def check_given(options: Any, *names: str) -> None:
    """Raise ValueError if an option that takes several values has none."""
    for name in names:
        if not getattr(options, name):
            raise ValueError(f"--{name} needs at least one value")


@dataclass(frozen=True)
class Sources:
    """The methods to compare."""

    # methods to compare, with options as in preview,correlation=0.5; gains are over the first one: gaussian,
    # past, preview, forecast, history, regression, mip, mip-past, warm-start, ot, bridge, reflow, step, cvae,
    # cvae-history, a2a, leap, or package.module:Class of your own on the PYTHONPATH
    prior: tuple[str, ...] = ("gaussian", "past", "preview")
    chunk: tuple[int, ...] = (8,)  # chunk lengths H
    sigma: tuple[float, ...] = ()  # noise of warm sources, a policy per value (default: past 0.5, preview 1)

    def __post_init__(self) -> None:
        check_counts(self, "chunk")
        check_given(self, "prior", "chunk")

    def methods(self) -> list[Method]:
        """Return all methods, chunk length by chunk length, without duplicates."""
        from lab.methods.methods import Method

        methods = [
            Method(text, chunk, sigma)
            for chunk in sorted(set(self.chunk))
            for text in self.prior
            for sigma in self.sigma or (None,)
        ]
        return list(dict.fromkeys(methods))


@dataclass(frozen=True)
class Evaluation:
    """Options of the evaluation."""

    seeds: int = 1  # number of training seeds, counted from --seed
    episodes: int = 25  # evaluation episodes per policy, NFE and temperature
    nfe: tuple[int, ...] = (9, 3, 1)  # network evaluations per chunk
    temperature: tuple[float, ...] = (1.0,)  # factors of the source's noise at decisions
    top_k: int = 1  # number of best checkpoints to average per seed, chosen on other episodes
    play_on: bool = False  # play on after success, up to the time limit
    grid: str = "uniform"  # times of the steps: uniform, dense-jump or dense-jump:TIME

    def __post_init__(self) -> None:
        check_counts(self, "seeds", "episodes", "nfe", "top_k")
        check_given(self, "nfe", "temperature")
        if self.episodes > SEEDS_PER_TRAINING:
            raise ValueError(f"--episodes must be at most {SEEDS_PER_TRAINING:,}, got {self.episodes}")

    def check(self) -> None:
        """Raise ValueError for temperatures or a grid that policies do not take."""
        from warmprior.modules.sampling import Sampling

        with naming("--grid", self.grid):
            Sampling(grid=self.grid)
        for temperature in self.temperature:
            with naming("--temperature", temperature):
                Sampling(temperature=temperature)

    def starts(self, training_seed: int) -> range:
        """Return the simulator seeds of the episodes that policies of a training seed play.

        They are the same for all methods, and differ between training seeds: only then do several trainings
        tell how far the success rate varies.
        """
        # Simulators take seeds below 2**32.
        first = EVALUATION_SEED + SEEDS_PER_TRAINING * (training_seed % 100_000)
        return range(first, first + self.episodes)

    @property
    def environment(self) -> dict[str, Any]:
        return {"terminate_on_success": False} if self.play_on else {}


@dataclass(frozen=True)
class Run:
    """Options of the computation, and of what it writes."""

    out: Path | None = None  # output folder (default: a numbered folder under runs/)
    resume: bool = False  # continue the run in --out, or the latest numbered folder, with its options
    workers: int | None = None  # processes, which change no result (default: one per core)
    device: str = "cpu"  # device of networks and data, such as cuda; under torchrun each process has its own
    videos: bool = True  # save a filmstrip and a video of one episode per method
    compile: bool = False  # use torch.compile in training
    logger: Literal["csv", "tensorboard", "wandb", "none"] = "csv"  # logger of the training curves
    engine: Literal["local", "ray"] = "local"  # run jobs on this machine, or on a Ray cluster
    ray_address: str | None = None  # HOST:PORT of the Ray head (default: $RAY_ADDRESS, else this machine)

    def __post_init__(self) -> None:
        check_counts(self, "workers")
        if self.ray_address is not None and self.engine != "ray":
            raise ValueError("--ray-address belongs to --engine ray: add it, or leave --ray-address out")
        if self.engine == "ray" and launched():
            raise ValueError("--engine ray distributes the work itself: start it without torchrun")
        if self.engine == "ray" and ":" in self.device:
            raise ValueError(f"--device {self.device}: with --engine ray, Ray chooses the GPU: use cuda")

    @property
    def folder(self) -> Path:
        """Return the output folder; `parse` has chosen one if --out was left out."""
        assert self.out is not None
        return self.out

    @property
    def policies(self) -> Path:
        """Return the folder of policies, next to the run, so that other runs share them."""
        return self.folder.absolute().parent / "policies"


@dataclass(frozen=True)
class Options:
    """All options of a comparison of sources."""

    data: Annotated[DataOptions, Flat] = field(default_factory=DataOptions)
    sources: Annotated[Sources, Flat] = field(default_factory=Sources)
    training: Annotated[TrainingConfig, Flat] = field(default_factory=TrainingConfig)
    evaluation: Annotated[Evaluation, Flat] = field(default_factory=Evaluation)
    run: Annotated[Run, Flat] = field(default_factory=Run)
    network: Annotated[NetworkOptions, Flat] = field(default_factory=NetworkOptions)
    # values of all options that are not given: quick, cpu, paper, or much-ado (paper, with the details of the
    # public code that the paper may build on); navigation1d.py has quick and paper; prior_space_rl.py has
    # quick, unit and paper
    preset: str = "quick"

    @property
    def name(self) -> str:
        """Return the name of the tasks, for folders."""
        file = self.data.dataset
        tasks = self.data.task
        if not tasks and file is not None:
            from warmprior.data import open_demonstrations

            tasks = (open_demonstrations(file).title,)
        tasks = tasks or ("square",)
        space = [] if self.data.actions == "delta" else [self.data.actions]
        observations = ["image"] if self.data.sees_images else []
        names = [task.replace(":", "-") for task in tasks]
        return "-".join([*names, *self.data.style, *space, *observations])

    @property
    def seeds(self) -> range:
        return range(self.training.seed, self.training.seed + self.evaluation.seeds)

    def trainings(self) -> list[TrainingConfig]:
        return [self.training]

    def check(self) -> None:
        from warmprior.training.networks import check_network

        self.data.check()
        self.evaluation.check()
        check_encoder(self.network, self.data)
        with naming("--batch-size", self.training.batch_size):
            check_batch(self.training.batch_size)
        with naming("--network", self.network.network):
            check_network(self.network)
        if self.data.actions != "delta" and any(":" in task for task in self.data.task):
            raise ValueError(
                "--actions absolute is for robosuite's tasks, and a task of your own has its own: add "
                "--actions delta"
            )
        if self.evaluation.play_on and not all(map(is_simulated, self.data.task)):
            raise ValueError("--play-on is for robosuite's tasks: leave it out")
        if self.training.weighting == "standardised" and not self.network.precondition:
            raise ValueError("--no-precondition needs --weighting velocity")
        for method in self.sources.methods():
            if self.training.times == "start" and not method.is_regression:
                raise ValueError(f"--times start trains no flow: leave out {method.name}")
            if method.has_two_steps and (
                not self.network.precondition or self.training.weighting == "velocity"
            ):
                raise ValueError(
                    f"{method.name} would weigh its second error a hundredfold: it needs preconditioning and "
                    "standardised errors"
                )
            if self.training.objective == "l1" and not method.is_straight:
                raise ValueError(f"--objective l1 needs a straight path: leave out {method.name}")
            if self.data.sees_images and method.needs_vector:
                raise ValueError(
                    f"{method.name} reads observations that are one vector: leave it out with images"
                )
            try:
                method.recipe(self.training)
            except ValueError as error:
                raise ValueError(f"{method.name} has no flow: leave it out ({error})") from error
            if method.pairs_in_batch and self.training.batch_size < 2:
                raise ValueError(f"{method.name} pairs within a batch: --batch-size must be at least 2")


# The folder of a finished run whose policies are used; none are trained.
FinishedRun = Annotated[Path | None, tyro.conf.arg(name="run")]


@dataclass(frozen=True)
class MeasuredOptions(Options):
    """Options of a comparison with measures on held-out observations."""

    validation: Path | None = None  # demonstrations to measure on, as for --dataset (default: generated)
    measured: int = 500  # number of observations to measure on; the paper's curvature has 2000

    def check(self) -> None:
        super().check()
        check_single(self, "task", "style", "chunk")
        check_counts(self, "measured")
        if self.validation is not None:
            check_place(self.validation, "--validation")


def check_single(options: Options, *names: str) -> None:
    """Raise ValueError for several values of options of which a study takes one, such as `task`."""
    parts = (options.data, options.sources, options.evaluation)
    for name in names:
        values = next(getattr(part, name) for part in parts if hasattr(part, name))
        if len(values) > 1:
            raise ValueError(f"this study has one --{name}, got {' '.join(map(str, values))}: choose one")


def with_parts[O](options: O, **parts: Any) -> O:
    """Return options with some values replaced: those of a part by a mapping, others directly."""
    replacements: Any = {
        part: replace(getattr(options, part), **values) if isinstance(values, Mapping) else values
        for part, values in parts.items()
    }
    return replace(options, **replacements)  # type: ignore[type-var]
