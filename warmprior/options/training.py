"""Options of a training run: the network and the recipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from warmprior.checks import (
    check_between,
    check_choice,
    check_not_negative,
    check_positive,
    check_share,
    check_whole_numbers,
    given,
)

Encoder = Literal["resnet18-imagenet", "resnet18", "small"]

PRETRAINED = "resnet18-imagenet"

OF_IMAGES = ("encoder", "crop_size", "share_encoder")
"""The options that have no effect without images."""


@dataclass(frozen=True)
class NetworkOptions:
    """The options of the velocity network.

    Attributes:
        network: mlp is small; chi_transformer is the paper's, and plain_mlp that of its toy
            task; adaln_transformer is a faster transformer (adaptive layer norm); or package.module:Class of
            your own. Options of the class follow, as in mlp,hidden_dim=256.
        precondition: use the second moments of source and data, see PreconditionedNetwork.
        observation_steps: To, observations per decision.
        encoder: image encoder, one network per camera: ResNet-18 with ImageNet's weights, which torchvision
            downloads once, ResNet-18 with random weights, or a small network.
        crop_size: side of the crop of an image in pixels, random in training, central otherwise; by default
            76 of 84, in proportion.
        share_encoder: use one encoder for all cameras.

    Examples:
        >>> from warmprior.training import NetworkOptions
        >>> NetworkOptions("chi_transformer,hidden_dim=48").observation_steps
        2
    """

    network: str = "mlp"
    precondition: bool = True
    observation_steps: int = 2
    encoder: Encoder = "resnet18-imagenet"
    crop_size: int | None = None
    share_encoder: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.network, str):
            raise TypeError(f"network must be a name such as 'mlp,hidden_dim=256', got {self.network!r}")
        check_whole_numbers(observation_steps=self.observation_steps, **given(crop_size=self.crop_size))
        check_choice("encoder", self.encoder, get_args(Encoder))


TimesName = Literal["uniform", "u-shaped", "start"]

Objective = Literal["velocity", "l1"]

Weighting = Literal["velocity", "standardised"]

Precision = Literal["float32", "bf16"]

CHOICES: dict[str, tuple[str, ...]] = {
    "times": get_args(TimesName),
    "objective": get_args(Objective),
    "weighting": get_args(Weighting),
    "precision": get_args(Precision),
}


@dataclass(frozen=True)
class TrainingConfig:
    """A training recipe; by default that of most result tables, for a small network on a CPU.

    The defaults were chosen by success rate at several iteration counts.

    Attributes:
        iterations: gradient steps.
        batch_size: windows per step, over all processes together.
        learning_rate: peak of the schedule.
        weight_decay: AdamW's decay of matrix weights.
        warmup_ratio: share of the iterations over which the learning rate rises.
        max_grad_norm: norm above which the gradient of all weights is clipped; no limit by default.
        ema_rate: decay of the averaged weights that are evaluated.
        checkpoints: largest number of policies to keep, evenly spaced, the last at the end.
        save_every: iterations between saves of the training state; by default ten saves per checkpoint.
        log_every: iterations per logged mean loss.
        seed: seed of initial weights, sampling, source, times and dropout.
        times: distribution of the times of the loss.
        objective: the loss: squared error of velocities, or L1 error of predicted samples (L1 Flow).
        weighting: weighting of the loss: errors unchanged (velocity), or divided by the standard deviation
            that preconditioning leaves, so that all times have equal weight (standardised). The latter is the
            default for a preconditioned network.
        count_padding: let actions past an episode's end, where its last one is repeated, count in the loss.
        precision: precision of the network's matrix products in training; weights, averages and optimiser are
            float32.
        cold_probability: share of the windows whose history is withheld; Algorithm 1 withholds none.

    Raises:
        ValueError: if a number is out of range, or a choice is unknown.

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
    max_grad_norm: float | None = None
    ema_rate: float = 0.995
    checkpoints: int = 1
    save_every: int | None = None
    log_every: int = 100
    seed: int = 0
    times: TimesName = "uniform"
    objective: Objective = "velocity"
    weighting: Weighting | None = None
    count_padding: bool = False
    precision: Precision = "float32"
    cold_probability: float = 0.0

    def __post_init__(self) -> None:
        counts = ("iterations", "batch_size", "checkpoints", "log_every")
        check_whole_numbers(**{name: getattr(self, name) for name in counts})
        check_whole_numbers(**given(save_every=self.save_every))
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**62:  # other seeds are offsets from it
            raise ValueError(f"seed must be a whole number from 0 to 2**62 - 1, got {self.seed!r}")
        check_positive(learning_rate=self.learning_rate, **given(max_grad_norm=self.max_grad_norm))
        check_not_negative(weight_decay=self.weight_decay)
        check_share(warmup_ratio=self.warmup_ratio, ema_rate=self.ema_rate)
        check_between(0, 1, cold_probability=self.cold_probability)
        for name, choices in CHOICES.items():
            if getattr(self, name) is not None:
                check_choice(name, getattr(self, name), choices)

    @property
    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations after which a policy is kept."""
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
