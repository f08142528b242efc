"""What a training is asked for: data, network and recipe, as a command line has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from warmprior.data.opening import check_place
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.rendering import require_rendering
from warmprior.envs.tasks import get_task
from warmprior.io.extras import require
from warmprior.modules import (
    AdaLNTransformer,
    ChiTransformer,
    ImageEncoder,
    PlainMLP,
    VelocityMLP,
    VelocityNetwork,
    VisionNetwork,
)
from warmprior.modules.checks import check_finite_numbers, check_whole_numbers
from warmprior.modules.encoder import imagenet_weights, load_imagenet
from warmprior.objectives.flow_matching import Objective, TimesName, Weighting, check_objective

GENERATED = 150
"""Scripted demonstrations, where no other number is asked for."""

PRETRAINED = "resnet18-imagenet"

_NETWORKS: dict[str, tuple[type[VelocityNetwork], str]] = {
    "mlp": (VelocityMLP, "hidden_dim"),
    "plain_mlp": (PlainMLP, "hidden_dim"),
    "chi_transformer": (ChiTransformer, "embedding_dim"),
    "adaln_transformer": (AdaLNTransformer, "embedding_dim"),
}


def is_simulated(task: str) -> bool:
    """Whether a task is one of robosuite: not the toy, and not one of a user's own."""
    return task != "navigation" and ":" not in task


def check_counts(options: Any, *names: str) -> None:
    """Refuse options of a dataclass that are no whole numbers of at least 1; ``None`` is fine."""
    for name in names:
        value = getattr(options, name)
        for count in value if isinstance(value, tuple) else (value,):
            if count is not None:
                check_whole_numbers(**{f"--{name.replace('_', '-')}": count})


@dataclass(frozen=True)
class DataOptions:
    """What policies are trained on.

    Attributes:
        task: manipulation tasks (default: square, or the dataset's); or one of your own, as
            package.module:function, which is given these options and returns a Task.
        data: ph (one operator) or mh (six operators); of MimicGen's files source (human) or core (made of
            the source).
        dataset: a robomimic HDF5 file, or a LeRobotDataset: lerobot:FOLDER, or lerobot:USER/NAME of the hub.
            Instead of generated data.
        download: fetch the official files from the hub instead.
        force_download: fetch them again, in place of a broken local copy.
        mask: name of a mask in the file, such as train; only its demonstrations are used.
        demonstrations: how many to generate, or to take of a file from its first on (default: all of it); two
            numbers for ph and mh.
        actions: what policies predict: pose deltas as recorded, or the absolute poses that they ask for.
        obs: what policies see: the state of robot and objects, or that of the robot and images.
        cameras: of the images; by default the task's two, or four with two arms.
        image_size: side of the images in pixels.
        fast_rendering: render without reflections, shadows and smooth edges, three to five times faster.

    Examples:
        >>> from warmprior.training import DataOptions
        >>> options = DataOptions(data=("ph", "mh"), demonstrations=(20, 60))
        >>> options.count("ph"), options.count("mh"), options.generated
        (20, 60, True)
    """

    task: tuple[str, ...] = ()
    data: tuple[Literal["ph", "mh", "source", "core"], ...] = ("ph",)
    dataset: Path | None = None
    download: bool = False
    force_download: bool = False
    mask: str | None = None
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
                f"--demonstrations takes one number, or one for ph and one for mh, got {self.demonstrations}"
            )

    def check(self) -> None:
        """Refuse options that cannot work, naming them, before anything is generated or downloaded.

        Raises:
            ValueError: for options that contradict each other.
            FileNotFoundError: if the file does not exist.
            ImportError: if MimicGen's data are to be fetched without its package, which plays its tasks.
        """
        if self.force_download and not self.download:
            raise ValueError("--force-download belongs to --download")
        if self.mask is not None and self.generated:
            raise ValueError("--mask is that of a file: add --download, or --dataset FILE")
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
        if self.dataset is not None:
            if self.download:
                raise ValueError("--dataset reads a file: leave out --download")
            if len(self.task) > 1 or len(self.data) > 1:
                raise ValueError("--dataset is of one task and style: name at most one --task and --data")
            if len(self.demonstrations) > 1:
                raise ValueError(
                    f"--demonstrations takes one number with --dataset, got {self.demonstrations}"
                )
            check_place(self.dataset, "--dataset")
        for task in filter(is_simulated, self.task):
            if self.generated and not get_task(task).scripted:
                raise ValueError(
                    f"there is no scripted expert for {task}: add --download for the official data, or "
                    "--dataset FILE"
                )
            if self.download and is_mimicgen(get_task(task).env_name):
                find_mimicgen()
        for style in self.data if self.generated else ():
            if style not in ("ph", "mh"):
                raise ValueError(
                    f"--data {style} is that of MimicGen's files: add --download, or --dataset FILE"
                )

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


@dataclass(frozen=True)
class NetworkOptions:
    """The velocity network.

    Attributes:
        network: mlp is small, and the default; chi_transformer is the paper's, and plain_mlp that of its toy;
            adaln_transformer is a faster transformer (adaptive layer norm).
        hidden_dim: its width; the class's own by default.
        precondition: by the second moments of source and data, see PreconditionedNetwork.
        observation_steps: To, observations per decision.
        encoder: of images, a network per camera: ResNet-18 from ImageNet's weights, which torchvision
            downloads once, from random ones, or a small network.
        crop_size: side of the random window of an image that is seen in training, the central one else.
        share_encoder: one encoder for all cameras.

    Examples:
        >>> import torch
        >>> from warmprior.training import NetworkOptions
        >>> options = NetworkOptions(network="chi_transformer", hidden_dim=48)
        >>> network = options.make(action_dim=7, observation_dim=23, prediction_length=8)
        >>> network(torch.zeros(1), torch.zeros(1, 8, 7), torch.zeros(1, options.observation_steps, 23)).shape
        torch.Size([1, 8, 7])
    """

    network: Literal["mlp", "plain_mlp", "chi_transformer", "adaln_transformer"] = "mlp"
    hidden_dim: int | None = None
    precondition: bool = True
    observation_steps: int = 2
    encoder: Literal["resnet18-imagenet", "resnet18", "small"] = "resnet18-imagenet"
    crop_size: int = 76
    share_encoder: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "hidden_dim", "observation_steps", "crop_size")
        if self.network not in _NETWORKS:
            raise ValueError(f"--network must be one of {', '.join(_NETWORKS)}, got {self.network!r}")

    def check(self, data: DataOptions) -> None:
        """Refuse options of images that cannot work, or have no effect, and weights that cannot be had."""
        if data.obs == "state":
            usual = self.without_images() == self or self.encoder == "resnet18"
            if not usual or data.image_size != DataOptions().image_size:
                raise ValueError(
                    "--image-size, --crop-size, --share-encoder and --encoder belong to --obs image"
                )
            return
        if not 8 <= self.crop_size <= data.image_size:
            raise ValueError(
                f"--crop-size {self.crop_size} must be at least 8 and at most --image-size {data.image_size}"
            )
        if self.encoder == PRETRAINED:
            imagenet_weights()
        elif self.encoder != "small":
            require("torchvision", "vision")

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
        """A network with fresh weights, for widths ``d_a`` and ``d_o`` and images of these sides in pixels.

        Beside images ``d_o`` is the width of the vector.
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
        network = kind(action_dim, observation_dim, prediction_length, self.observation_steps, **options)
        return network if encoder is None else VisionNetwork(encoder, network)


Precision = Literal["float32", "bf16"]


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe; the defaults are those of the robot tasks' tables: a small preconditioned network on a CPU.

    They were chosen from success against iterations. PAPER is the paper's recipe. A ValueError
    names a number that is out of its range.

    Attributes:
        iterations: gradient steps.
        batch_size: windows per step, of all processes together.
        learning_rate: peak of the schedule.
        weight_decay: AdamW's decay of matrix weights.
        warmup_ratio: share of the iterations over which the learning rate rises.
        ema_rate: decay of the averaged weights that are evaluated.
        checkpoints: how many policies to keep at most, evenly spaced, the last at the end.
        save_every: iterations between saves of the training state, ten per checkpoint by default.
        log_every: iterations per logged mean loss.
        seed: of initial weights, sampling, source, times and dropout.
        times: how the times of the loss are distributed.
        objective: the loss: squared error of velocities, or L1 error of predicted samples (L1 Flow).
        weighting: of the loss: errors as they are (velocity), or in units of what preconditioning leaves, so
            that every time counts alike (standardised). By default the latter where the network is
            preconditioned.
        self_distillation: weight of learning in one step where the flow of averaged weights ends.
        precision: of the network's matrix products in training; weights, averages and optimiser are float32.
        cold_probability: share of the windows whose history is withheld; the paper's Algorithm 1 has none.

    Examples:
        >>> from warmprior.training import TrainingConfig
        >>> config = TrainingConfig(iterations=1_000, batch_size=256, checkpoints=4)
        >>> config.checkpoint_iterations
        [250, 500, 750, 1000]
    """

    iterations: int = 10_000
    batch_size: int = 128
    learning_rate: float = 1e-3
    weight_decay: float = 1e-5
    warmup_ratio: float = 0.1
    ema_rate: float = 0.995
    checkpoints: int = 1
    save_every: int | None = None
    log_every: int = 100
    seed: int = 0
    times: TimesName = "uniform"
    objective: Objective = "velocity"
    weighting: Weighting | None = None
    self_distillation: float = 0.0
    precision: Precision = "float32"
    cold_probability: float = 0.0

    def __post_init__(self) -> None:
        counts = ("iterations", "batch_size", "checkpoints", "log_every")
        check_whole_numbers(**{name: getattr(self, name) for name in counts})
        if self.save_every is not None:
            check_whole_numbers(save_every=self.save_every)
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**62:  # others are counted from it
            raise ValueError(f"seed must be a whole number from 0 to 2**62 - 1, got {self.seed!r}")
        for name, words, fits in (
            ("learning_rate", "be > 0", lambda value: value > 0),
            ("weight_decay", "be >= 0", lambda value: value >= 0),
            ("warmup_ratio", "lie in [0, 1)", lambda value: 0 <= value < 1),
            ("ema_rate", "lie in [0, 1)", lambda value: 0 <= value < 1),
            ("cold_probability", "lie in [0, 1]", lambda value: 0 <= value <= 1),
        ):
            value = getattr(self, name)
            check_finite_numbers(**{name: value})
            if not fits(value):
                raise ValueError(f"{name} must {words}, got {value}")
        if self.precision not in get_args(Precision):
            known = ", ".join(get_args(Precision))
            raise ValueError(f"precision must be one of {known}, got {self.precision!r}")
        check_objective(
            times=self.times,
            objective=self.objective,
            weighting=self.weighting,
            self_distillation=self.self_distillation,
        )

    @property
    def checkpoint_iterations(self) -> list[int]:
        """After which iterations a policy is kept."""
        n = min(self.checkpoints, self.iterations)
        return [round(self.iterations * (i + 1) / n) for i in range(n)]


PAPER = TrainingConfig(
    iterations=200_000,
    batch_size=1024,
    learning_rate=1e-4,
    warmup_ratio=0.2,
    checkpoints=10,
    weighting="velocity",
)
"""The paper's recipe (Table 3: Robomimic, state observations)."""
