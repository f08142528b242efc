"""Trains and judges policies on the one-dimensional navigation toy (the paper's Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from warmprior import keys
from warmprior.diagnostics.branching import branching_bound
from warmprior.diagnostics.curvature import compare_curvature
from warmprior.diagnostics.held_out import SharedObservations
from warmprior.diagnostics.history_shift import HistoryShift
from warmprior.diagnostics.smoothness import executed_actions, smoothness
from warmprior.envs.navigation1d import (
    NavigationEnv,
    navigation_demonstrations,
    navigation_metrics,
)
from warmprior.modules import (
    Prior,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.training.behaviour_cloning import BehaviourCloning, precondition
from warmprior.training.training_config import TrainingConfig
from warmprior.transforms import MeanObservation, policy_transforms

__all__ = ["NAVIGATION_PRESETS", "NavigationPreset", "NavigationStudy", "navigation_priors"]

SHIFT = 0.15
"""Standard deviation of the history shift, a third of the gap between the sides at its narrowest."""


@dataclass(frozen=True)
class NavigationPreset:
    """One budget.

    Attributes:
        summary: one line for ``--help``.
        training: the recipe.
        hidden_dim: width of the network, a preconditioned :class:`~warmprior.VelocityMLP` of four hidden
            layers.
    """

    summary: str
    training: TrainingConfig
    hidden_dim: int


NAVIGATION_PRESETS: dict[str, NavigationPreset] = {
    "quick": NavigationPreset(
        summary="128-d network, 3,000 iterations: all policies in a few minutes on two cores",
        training=TrainingConfig(
            iterations=3_000,
            batch_size=256,
            learning_rate=2e-3,
            warmup_ratio=0.0,
            checkpoints=1,
            save_every=3_000,
        ),
        hidden_dim=128,
    ),
    "wide": NavigationPreset(
        summary="the paper's 1024-d network and 50,000 iterations: hours on a CPU",
        training=TrainingConfig(iterations=50_000, batch_size=256, checkpoints=1),
        hidden_dim=1024,
    ),
}


NAVIGATION_PRIORS = ("gaussian", "regression", "history", "past", "preview")
"""What the study compares by default, the baseline first."""


def navigation_priors(
    chunk_length: int,
    cold_probability: float = 0.1,
    *,
    names: Sequence[str] = NAVIGATION_PRIORS,
    sigmas: Sequence[float] = (0.1, 0.5),
) -> dict[str, Prior]:
    """The policies of the comparison, by name and, where it has an effect, ``sigma``.

    Args:
        chunk_length: ``H``.
        cold_probability: share of the training samples of the warm rows whose mean is withheld. The
            paper's Algorithm 1 withholds none; see :class:`~warmprior.PreviewPrior` for why small
            ``sigma`` needs it.

    Keyword Args:
        names: see :meth:`Prior.find`; the baseline first.
        sigmas: of the warm priors, one policy each.

    Examples:
        >>> list(navigation_priors(4))[:4]
        ['gaussian', 'regression', 'history', 'past 0.1']
    """
    priors = {}
    for name in names:
        for sigma in sigmas if Prior.find(name).takes("sigma") else (None,):
            prior = Prior.make(name, chunk_length, sigma=sigma, cold_probability=cold_probability)
            priors[prior.name if sigma is None else f"{prior.name} {sigma:g}"] = prior
    return priors


@dataclass
class NavigationStudy:
    """Policies that differ in their source alone, on the toy.

    Attributes:
        preset: the budget.
        priors: by policy name, the baseline first.
        directory: where the trained policies go.
        nfe: network evaluations per chunk; fewer where a prior allows only fewer.
        rollouts: how many to play per policy.

    Raises:
        ValueError: if ``nfe`` or ``rollouts`` is below 1, or the priors differ in chunk length.

    Examples:
        >>> from dataclasses import replace
        >>> from tempfile import TemporaryDirectory
        >>> quick = NAVIGATION_PRESETS["quick"]
        >>> short = replace(quick, training=replace(quick.training, iterations=2))
        >>> with TemporaryDirectory() as folder:
        ...     study = NavigationStudy(short, navigation_priors(16), Path(folder), rollouts=8)
        ...     row = study.judge(study.train("past 0.1", seed=0), seed=0)
        >>> 0.0 <= row["collision_rate"] <= 1.0
        True
    """

    preset: NavigationPreset
    priors: Mapping[str, Prior]
    directory: Path
    nfe: int = 9
    rollouts: int = 256

    def __post_init__(self) -> None:
        for name in ("nfe", "rollouts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        lengths = {name: prior.chunk_length for name, prior in self.priors.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"policies compare at one chunk length only, got {lengths}")
        self.data = navigation_demonstrations()
        chunk_length = next(iter(lengths.values()))
        #: All demonstrated steps from ``H`` on.
        self.observations = SharedObservations(self.data, chunk_length)

    def train(self, name: str, seed: int) -> WarmPriorActor:
        """Train one policy, or load it if the folder holds it with the same recipe.

        Args:
            name: of the policy.
            seed: of initial weights, sampling, source and times.

        Returns:
            The policy of averaged weights, in evaluation mode.
        """
        prior = self.priors[name]
        torch.manual_seed(seed)
        width = self.data[keys.OBSERVATION].shape[-1] + MeanObservation.width(prior, 1)
        network = precondition(
            VelocityMLP(1, width, prior.prediction_length, 1, hidden_dim=self.preset.hidden_dim),
            self.data,
            prior,
            observation_steps=1,
        )
        nfe = self.nfe if prior.is_flow else 1
        training = BehaviourCloning(
            WarmPriorActor(network, prior, nfe=nfe),
            self.data,
            replace(self.preset.training, seed=seed),
            self.directory / f"{name.replace(' ', '-')}-h{prior.chunk_length}-seed{seed}",
            observation_steps=1,
        )
        training.run(f"train {name}, seed {seed}")
        final = self.preset.training.iterations
        return WarmPriorActor.from_pretrained(training.policy_path(final), prior=prior)

    def play(
        self, actor: WarmPriorActor, seed: int, *, shift: float = 0.0, nfe: int | None = None
    ) -> TensorDictBase:
        """Roll a policy out.

        Args:
            actor: the policy.
            seed: of the source samples and the history shift.

        Keyword Args:
            shift: standard deviation of the noise on the remembered mean.
            nfe: network evaluations per chunk; the actor's own by default.

        Returns:
            The rollout, ``[rollouts, decisions]``.
        """
        generator = torch.Generator().manual_seed(seed)
        transforms = policy_transforms(actor.prior, observation_steps=1)
        env = TransformedEnv(NavigationEnv(batch_size=[self.rollouts]), transforms)
        player = actor.replace(nfe=nfe or actor.ode.nfe, generator=generator)
        policy = HistoryShift(player, shift, generator=generator) if shift else player
        with torch.no_grad():
            return env.rollout(1_000, policy)

    def judge(self, actor: WarmPriorActor, seed: int) -> dict[str, Any]:
        """Play a policy and measure what it did.

        Args:
            actor: the policy.
            seed: see :meth:`play`.

        Returns:
            Metrics of the rollouts (:class:`~warmprior.envs.NavigationMetrics`), ``jump_ratio`` and
            ``jerk`` (:class:`~warmprior.diagnostics.Smoothness`), some metrics under history shift
            (``"shifted_..."``) and at one network evaluation (``"one_step_..."``).
        """
        chunk_length = actor.prior.chunk_length
        rollout = self.play(actor, seed)
        heights = executed_actions(rollout)[0].squeeze(-1)
        smooth = smoothness(rollout)
        row: dict[str, Any] = asdict(navigation_metrics(heights, chunk_length))
        row |= {"jump_ratio": smooth.jump_ratio, "jerk": smooth.jerk}
        for prefix, options in (("shifted", {"shift": SHIFT}), ("one_step", {"nfe": 1})):
            played = self.play(actor, seed, **options)  # type: ignore[arg-type]
            if _diverged(played):
                other = dict.fromkeys(row, float("nan")) | {"collision_rate": 1.0}
            else:
                heights = executed_actions(played)[0].squeeze(-1)
                other = asdict(navigation_metrics(heights, chunk_length))
            for name in ("switch_rate", "collision_rate", "distance"):
                row[f"{prefix}_{name}"] = other[name]
        return row

    def straightness(
        self, actors: Mapping[str, WarmPriorActor], seed: int, n_steps: int = 100
    ) -> dict[str, dict[str, float]]:
        """Curvatures of the policies that are flows, on the demonstrated steps.

        Args:
            actors: by name, the baseline first; policies without a flow are left out.
            seed: of the source samples.
            n_steps: Euler steps.

        Returns:
            By name the entries of :func:`~warmprior.diagnostics.compare_curvature`;
            ``"kappa_forecast"``, the executed curvature at the mean that deployment meets; and
            ``"bound"``, the mean of :func:`~warmprior.diagnostics.branching_bound` where it applies.
        """
        flows = {name: a for name, a in actors.items() if a.prior.is_flow}
        windows = {name: self.observations.windows(a.prior) for name, a in flows.items()}

        def options() -> dict[str, Any]:
            return {"draws": 4, "generator": torch.Generator().manual_seed(seed)}

        results = compare_curvature(flows, windows, n_steps, **options())
        for name, actor in flows.items():
            prior = actor.prior
            # At deployment the noise of the earlier prediction and that of the next are independent.
            earlier = torch.Generator().manual_seed(seed + 1)
            met = self.observations.deployed(actor, generator=earlier)
            forecast = compare_curvature({name: actor}, {name: met}, n_steps, **options())[name]
            results[name]["kappa_forecast"] = forecast["kappa_executed"]
            if prior.is_gaussian:
                results[name]["bound"] = float(
                    branching_bound(windows[name], prior)["total"].mean()
                )
        return results


def _diverged(rollout: TensorDictBase) -> bool:
    """Whether an executed action is NaN or infinite."""
    chunk = rollout[keys.CHUNK]
    executed = torch.arange(chunk.shape[-2]) < rollout["next", keys.EXECUTED]
    return not bool(torch.isfinite(chunk[executed]).all())
