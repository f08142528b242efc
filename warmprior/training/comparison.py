"""Compares sources on one set of demonstrations: train, evaluate, write down."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from warmprior._files import check_writable
from warmprior.data.tasks import EVALUATION_SEED
from warmprior.diagnostics.results import Results, Row
from warmprior.diagnostics.smoothness import smoothness
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode, evaluate, parallel_env
from warmprior.training.policies import Policies

__all__ = ["Comparison"]


@dataclass
class Comparison:
    """Evaluates the policies of several sources alike.

    Attributes:
        policies: what is compared, or will be once it is trained.
        priors: the sources to compare, the baseline first.
        nfes: network evaluations per chunk to evaluate at.
        directory: output folder.
        seeds: training seeds.
        resume: keep the evaluations that the output folder holds.
        options: recorded in ``results.json``.

    Raises:
        ValueError: if a prior allows none of the ``nfes``, or the folder's results belong to other
            options.
        OSError: if the folder cannot be written to.
    """

    policies: Policies
    priors: Sequence[Prior]
    nfes: Sequence[int]
    directory: Path
    seeds: Sequence[int]
    resume: bool = False
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for prior in self.priors:
            if prior.max_nfe is not None and prior.max_nfe < min(self.nfes):
                raise ValueError(
                    f"{prior.name} is evaluated with at most {prior.max_nfe} network evaluation(s): add "
                    f"--nfe {prior.max_nfe}, or leave it out"
                )
        check_writable(self.directory)
        self._started = time.monotonic()
        self.results = Results(
            self.directory / "results.json",
            self._meta(),
            resume=self.resume,
            identity=("data", "training", "network", "priors", "evaluation"),
        )
        self._earlier = self.results.meta.get("wall_time_s", 0.0)

    @property
    def num_envs(self) -> int:
        """Parallel environments: the preset's, or one per core that this process may use."""
        preset = self.policies.preset
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        return min(preset.envs or cores or 1, preset.episodes)

    @property
    def losses(self) -> dict[str, list[list[tuple[int, float]]]]:
        """Training curves, by prior name one ``[(iteration, loss), ...]`` per policy."""
        curves: dict[str, list[list[tuple[int, float]]]] = {}
        for prior in self.priors:
            for seed in self.seeds:
                curves.setdefault(prior.name, []).append(self.policies.train(prior, seed))
        return curves

    def _meta(self) -> dict[str, Any]:
        policies = self.policies
        preset = policies.preset
        packages = ("warmprior", "torch", "torchrl", "tensordict", "robosuite", "mujoco", "numpy")
        cuda = "cuda" in policies.device
        return {
            "versions": {name: version(name) for name in packages}
            | {"python": platform.python_version()},
            "hardware": {
                "machine": platform.machine(),
                "cores": os.cpu_count(),
                "torch_threads": torch.get_num_threads(),
                "device": torch.cuda.get_device_name() if cuda else "cpu",
            },
            **policies.facts(),
            "options": self.options,
            "training": asdict(preset.training),
            "network": {"name": preset.network, **preset.network_options},
            "priors": [prior.config() for prior in self.priors],
            "policies": [
                {"prior": p.config(), "seed": s, "folder": policies.folder(p, s).name}
                for p in self.priors
                for s in self.seeds
            ],
            # The number of environments is part of it: it decides which noise an episode meets.
            "evaluation": {
                "episodes": preset.episodes,
                "envs": self.num_envs,
                "nfes": list(self.nfes),
                "seeds": list(self.seeds),
                "device": policies.device,
            },
        }

    def run(self) -> Results:
        """Train what is missing, evaluate what is missing.

        Returns:
            The results, also in ``results.json``.
        """
        self._save_time()
        for prior in self.priors:
            for seed in self.seeds:
                self.policies.train(prior, seed)
                self._save_time()
        for prior in self.priors:
            self.evaluate(prior)
        return self.results

    def evaluate(self, prior: Prior) -> None:
        """Play the evaluation episodes of every checkpoint, seed and NFE of one prior.

        NFEs above the prior's maximum are left out.
        """
        policies, preset = self.policies, self.policies.preset
        nfes = [nfe for nfe in self.nfes if prior.max_nfe is None or nfe <= prior.max_nfe]
        todo = [
            (seed, checkpoint, nfe)
            for seed in self.seeds
            for checkpoint in preset.training.checkpoint_iterations
            for nfe in nfes
            if self.results.find(self._row(prior, seed, checkpoint, nfe).cell) is None
        ]
        if not todo:
            return
        env = parallel_env(policies.make_env, policies.transforms(prior), self.num_envs)
        try:
            for seed, checkpoint, nfe in todo:
                episodes = evaluate(
                    policies.policy(prior, seed, checkpoint),
                    env,
                    episodes=preset.episodes,
                    first_seed=EVALUATION_SEED,
                    nfe=nfe,
                    policy_seed=seed,
                    description=f"evaluate {prior.describe()}, NFE {nfe}, seed {seed}, "
                    f"iteration {checkpoint}",
                )
                row = self._row(prior, seed, checkpoint, nfe)
                self.results.add(replace(row, **_outcome(episodes)))
                self._save_time()
        finally:
            if not env.is_closed:
                env.close()

    def _row(self, prior: Prior, seed: int, checkpoint: int, nfe: int) -> Row:
        return Row(
            task=self.policies.task,
            data=self.policies.demonstrations.style,
            prior=prior.name,
            sigma=prior.sigma,
            chunk=prior.chunk_length,
            nfe=nfe,
            seed=seed,
            checkpoint=checkpoint,
            episodes=self.policies.preset.episodes,
            successes=0,
            mean_steps=0.0,
        )

    def _save_time(self) -> None:
        self.results.meta["wall_time_s"] = self._earlier + time.monotonic() - self._started
        self.results.save()


def _outcome(episodes: Sequence[Episode]) -> dict[str, Any]:
    outcome: dict[str, Any] = {
        "successes": sum(episode.success for episode in episodes),
        "mean_steps": sum(episode.steps for episode in episodes) / len(episodes),
    }
    rollout = torch.cat([episode.decisions for episode in episodes])
    # Episodes of a single decision have no boundary between chunks.
    if any(len(episode.decisions) > 1 for episode in episodes):
        smooth = smoothness(rollout)
        outcome["boundary_jump"] = smooth.boundary_jump
        outcome["inner_jump"] = None if math.isnan(smooth.inner_jump) else smooth.inner_jump
    return outcome
