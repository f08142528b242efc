"""The recipe of reinforcement learning in source space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.checks import check_finite_numbers, check_positive, check_whole_numbers
from warmprior.rl.anchor import has_anchor
from warmprior.rl.residual import ResidualDistribution

__all__ = ["PriorSpaceConfig"]


@dataclass(frozen=True)
class PriorSpaceConfig:
    """The recipe; the defaults are DSRL's for Lift, Can and Square, around a WarmPrior mean.

    Attributes:
        algorithm: ``"dsrl-na"`` or ``"dsrl-sac"``.
        environment_steps: control steps to collect, those of the warm-up included.
        warmup_steps: control steps with residuals drawn from the prior and clipped to the box, before the
            first update.
        delta: half the side of the agent's box; ``None`` for 0.5 around a mean and 1.5 around zero.
        nfe: network evaluations per decoded chunk.
        updates: updates per vector step (one decision of every parallel environment).
        noise_critic_steps: distillation updates per vector step, DSRL-NA only.
        distillation: where the noise critic learns, see ResidualSampler, DSRL-NA only; by default in the
            clipped source around a mean, and in the whole source around zero.
        batch_size: transitions per update.
        learning_rate: of actor, critics and temperature.
        tau: of the target critics' averaging.
        gamma: discount per decision.
        hidden_dim: width of actor and critics.
        num_layers: their number of hidden layers.
        backup_entropy: whether the targets of DSRL-NA's critic include the entropy; those of TorchRL's SAC
            always do.
        alpha_init: initial temperature, DSRL's 1. If success ends the episode, take less than ``reward_offset
            * H / (P * d_a * log 2)``: otherwise the entropy of further decisions is worth more than success
            until the temperature has fallen.
        target_entropy: in units of the box.
        reward_offset: subtracted from every control step's reward; DSRL turns 0/1 into -1/0.
        evaluate_every: control steps between evaluations (and saves).
        evaluation_episodes: episodes per evaluation, greedy and stochastic each.
        seed: of everything random.

    Raises:
        ValueError: for a number out of its range, naming it.

    Examples:
        >>> from warmprior.rl import PriorSpaceConfig
        >>> config = PriorSpaceConfig(algorithm="dsrl-sac", delta=1.5, hidden_dim=128)
        >>> config.environment_steps, config.gamma
        (1000000, 0.99)
    """

    algorithm: Literal["dsrl-na", "dsrl-sac"] = "dsrl-na"
    environment_steps: int = 1_000_000
    warmup_steps: int = 24_000
    delta: float | None = None
    nfe: int = 1
    updates: int = 20
    noise_critic_steps: int = 10
    distillation: ResidualDistribution | None = None
    batch_size: int = 256
    learning_rate: float = 3e-4
    tau: float = 0.005
    gamma: float = 0.99
    hidden_dim: int = 2048
    num_layers: int = 3
    backup_entropy: bool = True
    alpha_init: float = 1.0
    target_entropy: float = 0.0
    reward_offset: float = 1.0
    evaluate_every: int = 20_000
    evaluation_episodes: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        if self.algorithm not in ("dsrl-na", "dsrl-sac"):
            raise ValueError(f"algorithm must be dsrl-na or dsrl-sac, got {self.algorithm!r}")
        if self.algorithm == "dsrl-sac" and not self.backup_entropy:
            raise ValueError("dsrl-sac has backup_entropy=True; leave it out")
        if self.algorithm == "dsrl-sac" and self.distillation is not None:
            raise ValueError("dsrl-sac has no noise critic: leave distillation out")
        check_finite_numbers(target_entropy=self.target_entropy, reward_offset=self.reward_offset)
        check_positive(learning_rate=self.learning_rate, alpha_init=self.alpha_init)
        if self.delta is not None:
            check_positive(delta=self.delta)
        for name in ("gamma", "tau"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in (0, 1], got {getattr(self, name)}")
        counts = ("environment_steps", "warmup_steps", "nfe", "updates", "batch_size")
        sizes = ("noise_critic_steps", "hidden_dim", "num_layers")
        names = (*counts, *sizes, "evaluate_every", "evaluation_episodes")
        check_whole_numbers(**{name: getattr(self, name) for name in names})
        if self.warmup_steps > self.environment_steps:
            raise ValueError(
                f"warmup_steps ({self.warmup_steps}) exceed environment_steps ({self.environment_steps})"
            )

    def box(self, actor: WarmPriorActor) -> float:
        """``delta``, or its default for a policy: the paper's 0.5 around a mean, 1.5 around zero."""
        if self.delta is not None:
            return self.delta
        return 0.5 if has_anchor(actor) else 1.5
