"""The recipe of behaviour cloning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from warmprior.modules.checks import check_finite_numbers, check_whole_numbers
from warmprior.objectives.flow_matching import Objective, TimesName, Weighting, check_objective

__all__ = ["PAPER", "Precision", "TrainingConfig"]

Precision = Literal["float32", "bf16"]


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe; the defaults are those of every table here: a small preconditioned network on a CPU.

    They were chosen from success against iterations. :data:`PAPER` is the paper's recipe.

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

    Raises:
        ValueError: for a number out of its range, naming it.

    See Also:
        - :class:`~warmprior.training.BehaviourCloning`: trains by it.
        - :class:`~warmprior.rl.PriorSpaceConfig`: the recipe of agents.

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
