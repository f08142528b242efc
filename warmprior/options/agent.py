"""The recipe of an agent in source space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from warmprior.checks import (
    check_between,
    check_choice,
    check_finite_numbers,
    check_positive,
    check_whole_numbers,
    given,
)

Algorithm = Literal["dsrl-na", "dsrl-sac"]

WARM_DELTA, ZERO_DELTA = 0.5, 1.5
"""Half the side of an agent's box around the mean of a warm source, and around zero (the paper's)."""

NUM_ENVS = 4
"""The number of simulators that an agent learns from at once."""


@dataclass(frozen=True)
class PriorSpaceConfig:
    """The recipe of prior-space reinforcement learning.

    The defaults are DSRL's for Lift, Can and Square, around a WarmPrior mean; ``python -m warmprior improve``
    has :data:`IMPROVE`.

    Attributes:
        algorithm: ``"dsrl-na"`` or ``"dsrl-sac"``.
        environment_steps: control steps to collect, including the warm-up.
        warmup_steps: control steps before any update, with residuals drawn from the prior and clipped to the
            box.
        delta: half the side of the agent's box; ``None`` for 0.5 around a mean and 1.5 around zero.
        residual_length: the number ``R`` of residuals per chunk, each held for ``P / R`` actions; by default
            one per action.
        nfe: network evaluations per decoded chunk.
        updates: updates per vector step (one decision of every parallel environment).
        noise_critic_steps: distillation updates per vector step, DSRL-NA only.
        batch_size: transitions per update.
        learning_rate: learning rate of actor, critics and temperature.
        tau: rate of the target critics' averaging.
        gamma: discount per decision.
        hidden_dim: width of actor and critics.
        num_layers: number of hidden layers of actor and critics.
        backup_entropy: include the entropy in the targets of DSRL-NA's critic; those of SAC always do.
        alpha_init: initial temperature, 1 in DSRL. If success ends the episode, choose less than
            ``reward_offset * H / (R * d_a * log 2)``: otherwise the entropy of further decisions is worth
            more than success until the temperature has fallen.
        target_entropy: target of the entropy, in units of the box.
        reward_offset: number subtracted from every control step's reward; DSRL turns 0/1 into -1/0. If
            failure ends episodes, take 0: an early failure would cost less than a late success.
        evaluate_every: control steps between evaluations (and saves).
        evaluation_episodes: episodes per evaluation of the greedy agent.
        seed: seed of all random draws.

    Raises:
        ValueError: if an option is unknown or out of range.

    Examples:
        >>> from warmprior.rl import PriorSpaceConfig
        >>> config = PriorSpaceConfig(algorithm="dsrl-sac", delta=1.5, hidden_dim=128)
        >>> config.environment_steps, config.gamma
        (1000000, 0.99)
    """

    algorithm: Algorithm = "dsrl-na"
    environment_steps: int = 1_000_000
    warmup_steps: int = 24_000
    delta: float | None = None
    residual_length: int | None = None
    nfe: int = 1
    updates: int = 20
    noise_critic_steps: int = 10
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
        check_choice("algorithm", self.algorithm, get_args(Algorithm))
        if self.algorithm == "dsrl-sac" and not self.backup_entropy:
            raise ValueError("dsrl-sac has backup_entropy=True; leave it out")
        check_finite_numbers(target_entropy=self.target_entropy, reward_offset=self.reward_offset)
        check_positive(learning_rate=self.learning_rate, alpha_init=self.alpha_init)
        check_positive(gamma=self.gamma, tau=self.tau, **given(delta=self.delta))
        check_between(0, 1, gamma=self.gamma, tau=self.tau)
        names = ["environment_steps", "warmup_steps", "nfe", "updates", "noise_critic_steps", "batch_size"]
        names += ["hidden_dim", "num_layers", "evaluate_every", "evaluation_episodes"]
        lengths = given(residual_length=self.residual_length)
        check_whole_numbers(**{name: getattr(self, name) for name in names}, **lengths)
        if self.warmup_steps > self.environment_steps:
            raise ValueError(
                f"warmup_steps ({self.warmup_steps}) exceed environment_steps ({self.environment_steps})"
            )


IMPROVE = PriorSpaceConfig(
    environment_steps=100_000,
    warmup_steps=4_000,
    updates=4,
    noise_critic_steps=2,
    hidden_dim=256,
    gamma=0.98,
    # At 1, the entropy of a chunk would be worth more than a success until the temperature has fallen.
    alpha_init=0.05,
    evaluate_every=10_000,
    evaluation_episodes=50,
)
"""The recipe of ``python -m warmprior improve``: for two cores, and episodes of some fifty decisions."""
