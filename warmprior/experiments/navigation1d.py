"""Judges policies on the one-dimensional navigation toy (the paper's Fig. 5)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from warmprior import keys
from warmprior.diagnostics.flow import sees_history
from warmprior.diagnostics.history_shift import HistoryShift
from warmprior.diagnostics.smoothness import executed_actions, smoothness
from warmprior.envs.navigation1d import NavigationEnv, navigation_metrics, navigation_positions
from warmprior.experiments.recipe import EvaluationOptions, NetworkOptions, Recipe, SourceOptions
from warmprior.experiments.record import refuse_ignored
from warmprior.modules import WarmPriorActor
from warmprior.training.training_config import TrainingConfig
from warmprior.transforms import policy_transforms

__all__ = ["NAVIGATION_PRESETS", "NavigationRecipe", "judge_navigation", "play_navigation"]

SHIFT = 0.15
"""Standard deviation of the history shift, a third of the gap between the sides at its narrowest."""


@dataclass(frozen=True)
class NavigationRecipe(Recipe):
    """A comparison of sources on the toy; its episodes are rollouts.

    See Also:
        - :func:`~warmprior.experiments.judge_navigation`: plays one of its policies.
        - :data:`~warmprior.experiments.NAVIGATION_PRESETS`: budgets.

    Examples:
        >>> from dataclasses import replace
        >>> recipe = NAVIGATION_PRESETS["quick"]
        >>> recipe.name, len(recipe.sources.methods())
        ('h4', 7)
        >>> replace(recipe, sources=SourceOptions(chunk=(40,))).check()
        Traceback (most recent call last):
            ...
        ValueError: --chunk must be between 1 and 32, got 40
    """

    @property
    def name(self) -> str:
        """Of the output folder."""
        return f"h{'-'.join(map(str, self.sources.chunk))}"

    def check(self) -> None:
        """Refuse what cannot work, or has no effect, before any work."""
        super().check()
        self.check_single(chunk=True)
        told = "the toy has demonstrations and an end of its own"
        refuse_ignored(self, NavigationRecipe(), ["data"], told)
        if self.evaluation.play_on:
            raise ValueError(f"{told}: leave out --play-on")
        steps = len(navigation_positions()) // 2
        if not 1 <= self.sources.chunk[0] <= steps:
            raise ValueError(f"--chunk must be between 1 and {steps}, got {self.sources.chunk[0]}")


WITHHELD = 0.1
"""The paper's Algorithm 1 withholds no history; see PreviewPrior for why small sigma needs it."""

_SOURCES = SourceOptions(
    prior=("gaussian", "regression", "history", "past", "preview"),
    chunk=(4,),
    sigma=(0.1, 0.5),
)
_EVALUATION = EvaluationOptions(episodes=256, nfe=(9, 1))

NAVIGATION_PRESETS: dict[str, NavigationRecipe] = {
    # All policies in a few minutes on two cores.
    "quick": NavigationRecipe(
        network=NetworkOptions(hidden_dim=128, observation_steps=1),
        training=TrainingConfig(
            iterations=3_000,
            batch_size=256,
            learning_rate=2e-3,
            warmup_ratio=0.0,
            checkpoints=1,
            save_every=3_000,
            cold_probability=WITHHELD,
        ),
        sources=_SOURCES,
        evaluation=_EVALUATION,
    ),
    # The paper's network and iterations: hours on a CPU.
    "wide": NavigationRecipe(
        network=NetworkOptions(hidden_dim=1024, observation_steps=1),
        training=TrainingConfig(
            iterations=50_000, batch_size=256, checkpoints=1, cold_probability=WITHHELD
        ),
        sources=_SOURCES,
        evaluation=_EVALUATION,
    ),
}
"""Budgets of the navigation toy."""


def play_navigation(
    actor: WarmPriorActor, seed: int, *, nfe: int, rollouts: int = 256, shift: float = 0.0
) -> TensorDictBase:
    """Roll a policy out on the toy.

    Args:
        actor: the policy.
        seed: of the source samples and the history shift.

    Keyword Args:
        nfe: network evaluations per chunk.
        rollouts: how many.
        shift: standard deviation of the noise on the remembered mean.

    Returns:
        The rollout, ``[rollouts, decisions]``.

    See Also:
        - :func:`~warmprior.experiments.judge_navigation`: measures what it did.
        - :func:`~warmprior.experiments.plot_navigation`: draws it.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> network = VelocityMLP(1, 9, prediction_length=4, observation_steps=1, hidden_dim=8)
        >>> rollout = play_navigation(WarmPriorActor(network, PastPrior(4)), seed=0, nfe=1, rollouts=2)
        >>> rollout.shape  # 64 steps, four per decision
        torch.Size([2, 16])
    """
    generator = torch.Generator().manual_seed(seed)
    transforms = policy_transforms(
        actor.prior, observation_steps=1, see_history=sees_history(actor)
    )
    env = TransformedEnv(NavigationEnv(batch_size=[rollouts]), transforms)
    player = actor.replace(nfe=nfe, generator=generator)
    policy = HistoryShift(player, shift, generator=generator) if shift else player
    with torch.no_grad():
        return env.rollout(1_000, policy)


def judge_navigation(
    actor: WarmPriorActor, seed: int, *, nfe: int, rollouts: int = 256
) -> dict[str, Any]:
    """Play a policy on the toy and measure what it did.

    Args:
        actor: the policy.
        seed: see :func:`play_navigation`.

    Keyword Args:
        nfe: network evaluations per chunk.
        rollouts: how many.

    Returns:
        Metrics of the rollouts (:class:`~warmprior.envs.NavigationMetrics`), ``jump_ratio`` and ``jerk``
        (:class:`~warmprior.diagnostics.Smoothness`), and some metrics under history shift
        (``"shifted_..."``). A policy whose actions become NaN or infinite collides, and has no other
        metrics.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 16, 1, hidden_dim=8), PastPrior(16))
        >>> 0.0 <= judge_navigation(actor, 0, nfe=1, rollouts=8)["collision_rate"] <= 1.0
        True
    """
    row: dict[str, Any] = {}
    for prefix, shift in (("", 0.0), ("shifted_", SHIFT)):
        played = play_navigation(actor, seed, nfe=nfe, rollouts=rollouts, shift=shift)
        if _diverged(played):
            row[f"{prefix}collision_rate"] = 1.0
            continue
        heights = executed_actions(played)[0].squeeze(-1)
        metrics = asdict(navigation_metrics(heights, actor.prior.chunk_length))
        if shift:
            kept = ("switch_rate", "collision_rate", "distance")
            row |= {prefix + name: metrics[name] for name in kept}
        else:
            smooth = smoothness(played)
            row |= metrics | {"jump_ratio": smooth.jump_ratio, "jerk": smooth.jerk}
    names = ("switch_rate", "distance", "shifted_switch_rate", "shifted_distance", "jump_ratio")
    return {name: math.nan for name in names} | row


def _diverged(rollout: TensorDictBase) -> bool:
    """Whether an executed action is NaN or infinite."""
    chunk = rollout[keys.CHUNK]
    executed = torch.arange(chunk.shape[-2]) < rollout["next", keys.EXECUTED]
    return not bool(torch.isfinite(chunk[executed]).all())
