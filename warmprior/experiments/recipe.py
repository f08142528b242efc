"""What determines an experiment: one tree of options, from which command line, files and identity come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
import tyro

from warmprior.data.opening import check_place, name_of_place
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.rendering import require_rendering
from warmprior.envs.tasks import get_task
from warmprior.experiments.condition import AT_ONCE, Condition
from warmprior.experiments.methods import Method
from warmprior.io.distributed import check_batch, check_device, launched
from warmprior.io.extras import require
from warmprior.modules import (
    ChiTransformer,
    ImageEncoder,
    VelocityMLP,
    VelocityNetwork,
    VisionNetwork,
    imagenet_weights,
    load_imagenet,
)
from warmprior.modules.grid import check_grid
from warmprior.training.training_config import TrainingConfig

__all__ = [
    "DataOptions",
    "EvaluationOptions",
    "HeldOutOptions",
    "MeasuredRecipe",
    "NetworkOptions",
    "PolicyOptions",
    "Recipe",
    "RunOptions",
    "SourceOptions",
]

Flat = tyro.conf.OmitArgPrefixes
"""Marks a part of the tree whose options carry their own names alone on the command line."""


def check_counts(options: Any, *names: str, least: int = 1, most: int = 1_000_000) -> None:
    """Refuse counts that cannot be meant.

    Args:
        options: the dataclass that holds them.
        names: of its fields; ``None`` is fine.
        least: the smallest count.
        most: the largest.

    Raises:
        ValueError: naming the option.
    """
    for name in names:
        value = getattr(options, name)
        for count in value if isinstance(value, tuple) else (value,):
            if count is not None and not least <= count <= most:
                raise ValueError(
                    f"--{name.replace('_', '-')} must be between {least} and {most:,}, got {count}"
                )


GENERATED = 150
"""Scripted demonstrations, where no other number is asked for."""


def check_images(method: Method) -> None:
    """Refuse a method that cannot go with observations that have images.

    Raises:
        ValueError: naming it.
    """
    if method.needs_vector:
        raise ValueError(
            f"{method.name} reads observations that are one vector: leave it out with --obs image"
        )


@dataclass(frozen=True)
class DataOptions:
    """What policies are trained on.

    Attributes:
        task: manipulation tasks; by default square, or the file's.
        data: ph (one operator) or mh (six operators); of MimicGen's files source (human) or core (made of
            the source).
        dataset: a robomimic HDF5 file, or a LeRobotDataset: lerobot:FOLDER, or lerobot:USER/NAME of the hub.
            Instead of generated data.
        download: fetch the official files from the hub instead.
        force_download: fetch them again, in place of a broken local copy.
        demonstrations: how many to generate, or to take of a file from its first on (default: all of it); two
            numbers for ph and mh.
        actions: of the policies: the recorded pose deltas, or the absolute poses that they ask for.
        obs: what policies see: the state of robot and objects, or that of the robot and images.
        cameras: of the images; by default the task's two, or four with two arms.
        image_size: side of the images in pixels.
        fast_rendering: render without reflections, shadows and smooth edges, three to five times faster.

    See Also:
        :func:`~warmprior.experiments.find_problems`: reads what they name.

    Examples:
        >>> options = DataOptions(data=("ph", "mh"), demonstrations=(20, 60))
        >>> options.count("ph"), options.count("mh"), options.generated
        (20, 60, True)
        >>> DataOptions(task=("tool_hang",)).check()
        Traceback (most recent call last):
            ...
        ValueError: there is no scripted expert for tool_hang: add --download for the official data, or ...
    """

    task: tuple[str, ...] = ()
    data: tuple[Literal["ph", "mh", "source", "core"], ...] = ("ph",)
    dataset: Path | None = None
    download: bool = False
    force_download: bool = False
    demonstrations: tuple[int, ...] = ()
    actions: Literal["delta", "absolute"] = "delta"
    obs: Literal["state", "image"] = "state"
    cameras: tuple[str, ...] = ()
    image_size: int = 84
    fast_rendering: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "demonstrations", "image_size")
        if len(self.demonstrations) > 2:
            raise ValueError(
                f"--demonstrations takes one number, or one for ph and one for mh, got "
                f"{self.demonstrations}"
            )

    def check(self) -> None:
        """Refuse options that cannot work, before anything is generated or downloaded.

        Raises:
            ValueError: naming the options.
            FileNotFoundError: if the file does not exist.
            ImportError: if MimicGen's data are to be fetched without its package, which plays its tasks.
        """
        if self.force_download and not self.download:
            raise ValueError("--force-download belongs to --download")
        if self.obs == "image":
            try:
                require_rendering()
            except RuntimeError as error:
                raise ValueError(f"--obs image needs the simulator's images: {error}") from error
            if self.actions == "absolute":
                raise ValueError("--obs image goes with --actions delta, as in the paper")
            if len(set(self.cameras)) < len(self.cameras):
                raise ValueError(f"--cameras names one twice: {' '.join(self.cameras)}")
        elif self.cameras or self.fast_rendering:
            raise ValueError("--cameras and --fast-rendering belong to --obs image")
        for task in self.task:
            if self.dataset is None and not (get_task(task).scripted or self.download):
                raise ValueError(
                    f"there is no scripted expert for {task}: add --download for the official data, or "
                    "--dataset FILE"
                )
            if self.download and is_mimicgen(get_task(task).env_name):
                find_mimicgen()
        if self.generated:
            for style in self.data:
                if style not in ("ph", "mh"):
                    raise ValueError(
                        f"--data {style} is that of MimicGen's files: add --download, or --dataset FILE"
                    )
        if self.dataset is None:
            return
        if self.download:
            raise ValueError("--dataset reads a file: leave out --download")
        if len(self.task) > 1 or len(self.data) > 1:
            raise ValueError(
                "--dataset is of one task and style: name at most one --task and --data"
            )
        check_place(self.dataset, "--dataset")

    @property
    def generated(self) -> bool:
        """Whether scripted experts make the data."""
        return self.dataset is None and not self.download

    def first(self, style: str) -> int | None:
        """Demonstrations to take of a file of a style; ``None`` for all of it."""
        return self.demonstrations[-1 if style == "mh" else 0] if self.demonstrations else None

    def count(self, style: str) -> int:
        """Scripted demonstrations of a style."""
        return self.first(style) or GENERATED


PRETRAINED = "resnet18-imagenet"

_NETWORKS: dict[str, tuple[type[VelocityNetwork], str]] = {
    "mlp": (VelocityMLP, "hidden_dim"),
    "chi_transformer": (ChiTransformer, "embedding_dim"),
}


@dataclass(frozen=True)
class NetworkOptions:
    """The velocity network.

    Attributes:
        network: its kind.
        hidden_dim: its width; the class's own by default.
        precondition: by the second moments of source and data, see PreconditionedNetwork.
        observation_steps: To, observations per decision.
        encoder: of images, a network per camera: ResNet-18 from ImageNet's weights, which torchvision
            downloads once, from random ones, or a small network.
        crop_size: side of the random window of an image that is seen in training, the central one else.
        share_encoder: one encoder for all cameras.

    See Also:
        - :class:`~warmprior.PreconditionedNetwork`: what ``precondition`` does.
        - :class:`~warmprior.ChiTransformer`: the paper's network.

    Examples:
        >>> options = NetworkOptions(network="chi_transformer", hidden_dim=48)
        >>> network = options.make(action_dim=7, observation_dim=23, prediction_length=8)
        >>> seen, noisy = torch.zeros(1, options.observation_steps, 23), torch.zeros(1, 8, 7)
        >>> type(network).__name__, network(torch.zeros(1), noisy, seen).shape
        ('ChiTransformer', torch.Size([1, 8, 7]))
    """

    network: Literal["mlp", "chi_transformer"] = "mlp"
    hidden_dim: int | None = None
    precondition: bool = True
    observation_steps: int = 2
    encoder: Literal["resnet18-imagenet", "resnet18", "small"] = "resnet18-imagenet"
    crop_size: int = 76
    share_encoder: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "hidden_dim", "observation_steps", "crop_size")

    def without_images(self) -> NetworkOptions:
        """With the defaults for what has no effect where no images are seen."""
        usual = NetworkOptions()
        names = ("encoder", "crop_size", "share_encoder")
        return replace(self, **{name: getattr(usual, name) for name in names})

    def make(
        self,
        action_dim: int,
        observation_dim: int,
        prediction_length: int,
        images: Mapping[str, int] | None = None,
    ) -> VelocityNetwork:
        """A network with fresh weights.

        Args:
            action_dim: ``d_a``.
            observation_dim: ``d_o``, that of the vector beside the images if there are some.
            prediction_length: ``P``.
            images: their names and sides in pixels.
        """
        kind, width = _NETWORKS[self.network]
        options = {} if self.hidden_dim is None else {width: self.hidden_dim}
        encoder = None
        if images:
            encoder = ImageEncoder(
                list(images),
                observation_dim,
                image_size=next(iter(images.values())),
                crop_size=self.crop_size,
                backbone="small" if self.encoder == "small" else "resnet18",
                share=self.share_encoder,
            )
            if self.encoder == PRETRAINED:
                load_imagenet(encoder)
            observation_dim = encoder.observation_dim
        network = kind(
            action_dim, observation_dim, prediction_length, self.observation_steps, **options
        )
        return network if encoder is None else VisionNetwork(encoder, network)


@dataclass(frozen=True)
class SourceOptions:
    """The methods to compare.

    Attributes:
        prior: by name (gaussian, past, preview, forecast, history, regression, ot, reflow, step, cvae, a2a,
            leap) or, your own, as package.module:Class, which Python has to find (PYTHONPATH); options
            follow as in preview,correlation=0.5. Gains are over the first.
        chunk: chunk lengths H.
        sigma: residual noise of the warm priors, one policy each (default: past 0.5, preview 1.0).

    See Also:
        - :class:`~warmprior.Prior`: the class of one of your own.
        - :class:`~warmprior.PastPrior`: the paper's first source.

    Examples:
        >>> options = SourceOptions(("gaussian", "preview,correlation=0.5"), chunk=(8, 4))
        >>> [(method.label, method.options, method.chunk_length) for method in options.methods()]
        [('Base', '', 4), ('WP-Preview', 'correlation=0.5', 4),
         ('Base', '', 8), ('WP-Preview', 'correlation=0.5', 8)]
        >>> SourceOptions(("gaussian",), sigma=(0.5,)).check_sigma()
        Traceback (most recent call last):
            ...
        ValueError: --sigma belongs to warm priors; gaussian take none
    """

    prior: tuple[str, ...] = ("gaussian", "past", "preview")
    chunk: tuple[int, ...] = (8,)
    sigma: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("prior", "chunk"):
            if not getattr(self, name):
                raise ValueError(f"--{name} needs at least one value")

    def check_sigma(self) -> None:
        """Refuse a ``sigma`` that no prior takes.

        Raises:
            ValueError: naming them.
        """
        if self.sigma and not any(Method.takes(name, "sigma") for name in self.prior):
            raise ValueError(f"--sigma belongs to warm priors; {', '.join(self.prior)} take none")

    def methods(self) -> list[Method]:
        """All of them, chunk length by chunk length.

        Raises:
            ValueError: if there is no such method, or an argument is out of range.

        Examples:
            >>> [m.describe() for m in SourceOptions(("gaussian", "past"), sigma=(1.0, 0.5)).methods()]
            ['gaussian, sigma 1, H 8', 'past, sigma 1, H 8', 'past, sigma 0.5, H 8']
        """
        check_counts(self, "chunk")
        names = dict.fromkeys(self.prior)
        noisy = {name: Method.takes(name, "sigma") for name in names}
        return [
            Method.parse(name, chunk, sigma=sigma)
            for chunk in sorted(set(self.chunk))
            for name in names
            for sigma in (dict.fromkeys(self.sigma) if noisy[name] and self.sigma else (None,))
        ]


@dataclass(frozen=True)
class EvaluationOptions:
    """How policies are evaluated.

    Attributes:
        seeds: number of training seeds, from --seed on.
        episodes: evaluation episodes per cell.
        nfe: network evaluations per chunk.
        top_k: best checkpoints averaged per seed.
        play_on: go on after success, up to the time limit; solved is solved at any step.
        grid: of the integration: uniform, or dense-jump (one last step from half way; dense-jump:0.7 from
            there).

    See Also:
        - :func:`~warmprior.training.evaluate`: plays the episodes.
        - :func:`~warmprior.experiments.success_summary`: averages the checkpoints.

    Examples:
        >>> EvaluationOptions(nfe=(1, 9, 1)).nfes, EvaluationOptions(play_on=True).environment
        ([9, 1], {'terminate_on_success': False})
        >>> EvaluationOptions(episodes=0)
        Traceback (most recent call last):
            ...
        ValueError: --episodes must be between 1 and 1,000,000, got 0
    """

    seeds: int = 1
    episodes: int = 25
    nfe: tuple[int, ...] = (9, 3, 1)
    top_k: int = 1
    play_on: bool = False
    grid: str = "uniform"

    def __post_init__(self) -> None:
        check_counts(self, "seeds", most=1_000)
        check_counts(self, "episodes", "nfe", "top_k")
        if not self.nfe:
            raise ValueError("--nfe needs at least one number of network evaluations")
        check_grid(self.grid)

    @property
    def environment(self) -> dict[str, Any]:
        """Options of the environment."""
        return {"terminate_on_success": False} if self.play_on else {}

    @property
    def nfes(self) -> list[int]:
        """The numbers of network evaluations, the largest first."""
        return sorted(set(self.nfe), reverse=True)


@dataclass(frozen=True)
class RunOptions:
    """Where and how to compute.

    Attributes:
        preset: the budget that the other options start from.
        out: output folder (default: a numbered one under runs/).
        resume: continue in --out, or in the latest default folder, with the options stored there.
        envs: worker processes that train and play, with the same results (default: one per core).
        device: of networks and data, such as cuda; one per process under torchrun.
        compile: torch.compile the network in training.
        logger: TorchRL logger of the training curves.
        engine: who computes, with the same results: processes of this machine, or Ray, on one or many.
        ray_address: HOST:PORT of a Ray cluster's head (default: $RAY_ADDRESS, or this machine alone).

    See Also:
        :func:`~warmprior.experiments.parse`: finds the folder and the stored options.

    Examples:
        >>> RunOptions(out=Path("runs/square"), logger="none").directory
        PosixPath('runs/square')
        >>> RunOptions(ray_address="node-1:6379")
        Traceback (most recent call last):
            ...
        ValueError: --ray-address belongs to --engine ray
    """

    preset: str = "quick"
    out: Path | None = None
    resume: bool = False
    envs: int | None = None
    device: str = "cpu"
    compile: bool = False
    logger: Literal["csv", "tensorboard", "wandb", "none"] = "csv"
    engine: Literal["local", "ray"] = "local"
    ray_address: str | None = None

    def __post_init__(self) -> None:
        check_counts(self, "envs")
        check_device(self.device)
        if self.ray_address is not None and self.engine != "ray":
            raise ValueError("--ray-address belongs to --engine ray")
        if self.engine == "ray" and launched():
            raise ValueError("--engine ray distributes the work itself: start it without torchrun")
        if self.engine == "ray" and torch.device(self.device).index is not None:
            raise ValueError(
                f"--device {self.device}: Ray chooses which GPU a training gets; name none with --engine ray"
            )

    @property
    def directory(self) -> Path:
        """The output folder, once it is chosen."""
        assert self.out is not None, "the command line chooses one"
        return self.out


@dataclass(frozen=True)
class HeldOutOptions:
    """Observations to measure on, which no policy was trained on.

    Attributes:
        validation: held-out demonstrations, as --dataset names them (default: newly generated ones).
        observations: how many; the paper's curvature has 2000.
        steps: Euler steps of a curvature.
        draws: source samples per observation.

    See Also:
        :func:`~warmprior.experiments.observe`: draws the observations.

    Examples:
        >>> HeldOutOptions(steps=1)
        Traceback (most recent call last):
            ...
        ValueError: --steps must be between 2 and 1,000,000, got 1
        >>> HeldOutOptions(validation=Path("nowhere.hdf5"))
        Traceback (most recent call last):
            ...
        FileNotFoundError: --validation nowhere.hdf5: no such file
    """

    validation: Path | None = None
    observations: int = 500
    steps: int = 100
    draws: int = 1

    def __post_init__(self) -> None:
        check_counts(self, "observations", "draws")
        check_counts(self, "steps", least=2)
        if self.validation is not None:
            check_place(self.validation, "--validation")


@dataclass(frozen=True)
class PolicyOptions:
    """Which policies to take.

    Attributes:
        run: a finished run of robomimic.py, whose policies to take instead of training them.

    See Also:
        :func:`~warmprior.experiments.finished_policies`: reads them.

    Examples:
        >>> from warmprior.experiments import finished_policies
        >>> finished_policies(PolicyOptions(run=Path("nowhere")).run)
        Traceback (most recent call last):
            ...
        FileNotFoundError: --run nowhere: it has no results.json; name a run of robomimic.py
    """

    run: Path | None = None


@dataclass(frozen=True)
class Recipe:
    """Everything that determines a comparison of sources; its leaves are the options.

    Attributes:
        data: what policies are trained on.
        network: the velocity network.
        training: behaviour cloning.
        sources: what is compared.
        evaluation: how.
        run: where and how to compute.

    See Also:
        - :class:`~warmprior.experiments.Comparison`: runs it.
        - :func:`~warmprior.experiments.parse`: makes it of a command line.
        - :func:`~warmprior.experiments.comparison_preset`: starts from a budget.

    Examples:
        >>> recipe = Recipe(
        ...     data=DataOptions(task=("lift",)), sources=SourceOptions(("gaussian", "ot")),
        ...     training=TrainingConfig(seed=5, batch_size=1), evaluation=EvaluationOptions(seeds=3))
        >>> recipe.name, list(recipe.seeds)
        ('lift-ph', [5, 6, 7])
        >>> recipe.check()
        Traceback (most recent call last):
            ...
        ValueError: ot pairs within a batch: --batch-size must be at least 2
    """

    data: Annotated[DataOptions, Flat] = field(default_factory=DataOptions)
    network: Annotated[NetworkOptions, Flat] = field(default_factory=NetworkOptions)
    training: Annotated[TrainingConfig, Flat] = field(default_factory=TrainingConfig)
    sources: Annotated[SourceOptions, Flat] = field(default_factory=SourceOptions)
    evaluation: Annotated[EvaluationOptions, Flat] = field(default_factory=EvaluationOptions)
    run: Annotated[RunOptions, Flat] = field(default_factory=RunOptions)

    @property
    def name(self) -> str:
        """Of the problems, in names of folders."""
        file = self.data.dataset
        tasks = self.data.task or ("square" if file is None else name_of_place(file),)
        space = [] if self.data.actions == "delta" else [self.data.actions]
        seen = [] if self.data.obs == "state" else [self.data.obs]
        return "-".join([*tasks, *self.data.data, *space, *seen])

    @property
    def seeds(self) -> range:
        """The training seeds."""
        return range(self.training.seed, self.training.seed + self.evaluation.seeds)

    def check(self) -> None:
        """Refuse what cannot work, before any work.

        Raises:
            ValueError: naming the option.
        """
        self.data.check()
        if self.training.weighting == "standardised" and not self.network.precondition:
            raise ValueError(
                "--weighting standardised needs --precondition: add --weighting velocity to "
                "--no-precondition"
            )
        check_batch(self.training.batch_size)
        self.check_observations()
        methods, played = self.sources.methods(), set[int]()
        for method in methods:
            played.update(method.allowed_nfes(self.evaluation.nfes))
            if not method.is_flow:
                try:
                    replace(self.training, times="start")
                except ValueError as error:
                    raise ValueError(
                        f"leave out {method.name}, which is no flow: {error}"
                    ) from error
            if method.pairs_in_batch and self.training.batch_size < 2:
                raise ValueError(
                    f"{method.name} pairs within a batch: --batch-size must be at least 2"
                )
        if self.training.times != "uniform" and not any(m.is_flow for m in methods):
            raise ValueError(
                f"--times has no effect on {', '.join(dict.fromkeys(m.name for m in methods))}, trained at "
                "t = 0 alone: leave it out, or add a method that is a flow"
            )
        if self.evaluation.grid != "uniform" and played == {1}:
            raise ValueError(
                "--grid has no effect at NFE 1, which is one step on every grid, and these methods are "
                "evaluated at no other: leave it out"
            )

    def check_observations(self) -> None:
        """Refuse options of images that cannot work, or are without effect.

        Raises:
            ValueError: naming the option.
            OSError: if ImageNet's weights are asked for and cannot be had.
        """
        network, size = self.network, self.data.image_size
        if self.data.obs == "state":
            usual = (DataOptions().image_size, NetworkOptions().crop_size, False)
            if (
                size,
                network.crop_size,
                network.share_encoder,
            ) != usual or network.encoder == "small":
                raise ValueError(
                    "--image-size, --crop-size, --share-encoder and --encoder belong to --obs image"
                )
            return
        if not 8 <= network.crop_size <= size:
            raise ValueError(
                f"--crop-size {network.crop_size} does not fit into --image-size {size}, or is below 8"
            )
        for method in self.sources.methods():
            check_images(method)
        if network.encoder == PRETRAINED:
            imagenet_weights()
        elif network.encoder != "small":
            require("torchvision", "vision")

    def check_single(
        self,
        *,
        problem: bool = False,
        chunk: bool = False,
        sigma: bool = False,
        nfe: bool = False,
    ) -> None:
        """Refuse several of what a study has one of.

        Keyword Args:
            problem: one task and style.
            chunk: one chunk length.
            sigma: one residual noise.
            nfe: one number of network evaluations.

        Raises:
            ValueError: naming the option.
        """
        given = {
            "task": self.data.task if problem else (),
            "data": self.data.data if problem else (),
            "chunk": self.sources.chunk if chunk else (),
            "sigma": self.sources.sigma if sigma else (),
            "nfe": self.evaluation.nfe if nfe else (),
        }
        for name, values in given.items():
            if len(values) > 1:
                raise ValueError(f"this study has one --{name}, got {' '.join(map(str, values))}")

    def conditions(self, method: Method) -> list[Condition]:
        """How policies are played, each a cell of its own.

        Args:
            method: of the policy.
        """
        return [AT_ONCE]

    def trainings(self) -> list[TrainingConfig]:
        """The recipes of behaviour cloning to compare, one per length, without seeds."""
        return [self.training]


@dataclass(frozen=True)
class MeasuredRecipe(Recipe):
    """A comparison with measures on held-out observations of one problem.

    Attributes:
        held_out: the observations.

    See Also:
        - :class:`~warmprior.experiments.HeldOutOptions`: its observations.
        - :func:`~warmprior.experiments.straightness`: measures by it.

    Examples:
        >>> from warmprior.experiments import PRESETS
        >>> recipe = MeasuredRecipe.of(PRESETS["quick"], held_out=HeldOutOptions(observations=100))
        >>> recipe.network == PRESETS["quick"].network, recipe.held_out.observations
        (True, 100)
        >>> replace(recipe, data=DataOptions(task=("lift", "can"))).check()
        Traceback (most recent call last):
            ...
        ValueError: this study has one --task, got lift can
    """

    held_out: Annotated[HeldOutOptions, Flat] = field(default_factory=HeldOutOptions)

    @classmethod
    def of(cls, preset: Recipe, **parts: Any) -> Self:
        """A preset with further parts.

        Args:
            preset: of a plain comparison.
            parts: by name.
        """
        return cls(**{f.name: getattr(preset, f.name) for f in fields(preset)}, **parts)

    def check(self) -> None:
        """Refuse what cannot work, before any work."""
        super().check()
        self.check_single(problem=True, chunk=True)
