"""Trains and evaluates one policy per prior and seed under equal conditions."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import get_logger

from warmprior._files import check_writable
from warmprior.data import RobomimicExperienceReplay
from warmprior.data.tasks import EVALUATION_SEED
from warmprior.diagnostics.results import Results, Row
from warmprior.envs import RobosuiteEnv
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.behaviour_cloning import STATE_FORMAT, BehaviourCloning
from warmprior.training.evaluation import evaluate, parallel_env
from warmprior.training.presets import Preset
from warmprior.transforms import Normalizer, policy_transforms

__all__ = ["Comparison", "Demonstrations"]


@dataclass(frozen=True)
class Demonstrations:
    """Where the data come from.

    Attributes:
        path: a robomimic HDF5 file.
        source: ``"scripted"``, ``"official"`` or ``"file"``.
        style: ``"ph"`` or ``"mh"``; decides the time limit.
    """

    path: Path
    source: str
    style: str

    @cached_property
    def sha256(self) -> str:
        """Digest of the file: the identity of the data in everything that is cached."""
        with open(self.path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass
class Comparison:
    """Policies that differ in their source alone, trained and evaluated alike.

    Trained policies lie beside the output folder under ``policies/``, named by a digest of everything
    that determines them (data, recipe, prior, network): runs with the same options share them, and an
    interrupted training continues from its last state.

    Attributes:
        demonstrations: the data.
        preset: the budget.
        priors: the sources to compare, the baseline first.
        nfes: network evaluations per chunk to evaluate at.
        directory: output folder.
        seeds: training seeds.
        device: of networks and data.
        compile: compile the velocity network in training.
        logger: TorchRL logger: ``"csv"``, ``"tensorboard"``, ``"wandb"`` or ``"none"``.
        resume: keep the evaluations that the output folder holds.
        options: recorded in ``results.json``.
    """

    demonstrations: Demonstrations
    preset: Preset
    priors: Sequence[Prior]
    nfes: Sequence[int]
    directory: Path
    seeds: Sequence[int]
    device: str = "cpu"
    compile: bool = False
    logger: str = "csv"
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
        check_writable(self.policies)
        dataset = RobomimicExperienceReplay(self.demonstrations.path)
        task = dataset.task
        self.task = dataset.env_args["env_name"].lower() if task is None else task.name
        self.normalizer = Normalizer.fit(dataset.data)
        self.data = self.normalizer.normalize(dataset.data.exclude("next")).to(self.device)
        self.make_env = partial(
            RobosuiteEnv, env_args=dataset.env_args, style=self.demonstrations.style
        )
        self.losses: dict[str, list[list[tuple[int, float]]]] = {}
        self._started = time.monotonic()
        self.results = Results(
            self.directory / "results.json",
            self._meta(dataset),
            resume=self.resume,
            identity=("data", "training", "network", "priors", "evaluation"),
        )
        self._earlier = self.results.meta.get("wall_time_s", 0.0)

    @property
    def policies(self) -> Path:
        """Folder of the trained policies, beside the output folder."""
        return self.directory.parent / "policies"

    @property
    def num_envs(self) -> int:
        """Parallel environments: the preset's, or one per core that this process may use."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        return min(self.preset.envs or cores or 1, self.preset.episodes)

    def _meta(self, dataset: RobomimicExperienceReplay) -> dict[str, Any]:
        packages = ("warmprior", "torch", "torchrl", "tensordict", "robosuite", "mujoco", "numpy")
        return {
            "versions": {name: version(name) for name in packages}
            | {"python": platform.python_version()},
            "hardware": {
                "machine": platform.machine(),
                "cores": os.cpu_count(),
                "torch_threads": torch.get_num_threads(),
                "device": torch.cuda.get_device_name() if "cuda" in self.device else "cpu",
            },
            "data_source": self.demonstrations.source,
            "data": {
                "file": self.demonstrations.path.name,
                "sha256": self.demonstrations.sha256,
                "demonstrations": dataset.num_episodes,
                "steps": len(dataset.data),
            },
            "options": self.options,
            "training": asdict(self.preset.training),
            "network": {"name": self.preset.network, **self.preset.network_options},
            "priors": [prior.config() for prior in self.priors],
            # The number of environments is part of it: it decides which noise an episode meets.
            "evaluation": {
                "episodes": self.preset.episodes,
                "envs": self.num_envs,
                "nfes": list(self.nfes),
                "seeds": list(self.seeds),
                "device": self.device,
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
                self.train(prior, seed)
        for prior in self.priors:
            self.evaluate(prior)
        return self.results

    def new_actor(self, prior: Prior, seed: int) -> WarmPriorActor:
        """An untrained policy; its initial weights depend on the seed alone."""
        torch.manual_seed(seed)
        action_dim = self.data["action"].shape[-1]
        network = self.preset.make_network(
            action_dim,
            self.data["observation"].shape[-1] + prior.context_dim(action_dim),
            prior.prediction_length,
        )
        # A copy: the policy moves to the device, the environments' normaliser stays on the CPU.
        normalizer = copy.deepcopy(self.normalizer)
        # The normalised demonstrations span [-1, 1]: what leaves it is executed, and remembered, at
        # the bound.
        return WarmPriorActor(network, prior, normalizer=normalizer, clip=1.0).to(self.device)

    def train(self, prior: Prior, seed: int) -> BehaviourCloning:
        """Train one policy, or continue or reuse the stored one of the same options."""
        actor = self.new_actor(prior, seed)
        config = replace(self.preset.training, seed=seed)
        identity = json.dumps(
            [
                self.demonstrations.sha256,
                asdict(config),
                prior.config(),
                self.preset.network,
                self.preset.network_options,
                self.preset.observation_steps,
                self.device,
                self.compile,
                torch.get_num_threads(),
                version("torch"),
                version("warmprior"),
                STATE_FORMAT,
            ]
        )
        digest = hashlib.sha256(identity.encode()).hexdigest()[:10]
        name = f"{self.task}-{self.demonstrations.style}-{prior.name}-seed{seed}-{digest}"
        training = BehaviourCloning(
            actor,
            self.data,
            config,
            self.policies / name,
            observation_steps=self.preset.observation_steps,
            logger=self._logger(f"{prior.name}-seed{seed}"),
            compile=self.compile,
        )
        training.run(f"train {prior.name}, seed {seed}")
        self.losses.setdefault(prior.name, []).append(training.losses)
        self._policies[prior.name, seed] = training
        self._save_time()
        return training

    @cached_property
    def _policies(self) -> dict[tuple[str, int], BehaviourCloning]:
        return {}

    def transforms(self, prior: Prior) -> partial[Any]:
        """Builder of the environment transforms of this comparison's policies."""
        return partial(
            policy_transforms,
            prior,
            normalizer=self.normalizer,
            observation_steps=self.preset.observation_steps,
        )

    def policy(self, prior: Prior, seed: int, checkpoint: int) -> WarmPriorActor:
        """The averaged policy of one checkpoint, from disk."""
        directory = self._policies[prior.name, seed].policy_path(checkpoint)
        return WarmPriorActor.from_pretrained(directory, prior=prior, device=self.device)

    def evaluate(self, prior: Prior) -> None:
        """Play the evaluation episodes of every checkpoint, seed and NFE of one prior.

        NFEs above the prior's maximum are left out.
        """
        preset = self.preset
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
        env = parallel_env(self.make_env, self.transforms(prior), self.num_envs)
        try:
            for seed, checkpoint, nfe in todo:
                episodes = evaluate(
                    self.policy(prior, seed, checkpoint),
                    env,
                    episodes=preset.episodes,
                    first_seed=EVALUATION_SEED,
                    nfe=nfe,
                    policy_seed=seed,
                    description=f"evaluate {prior.name}, NFE {nfe}, seed {seed}, iteration {checkpoint}",
                )
                row = replace(
                    self._row(prior, seed, checkpoint, nfe),
                    successes=sum(episode.success for episode in episodes),
                    mean_steps=sum(episode.steps for episode in episodes) / len(episodes),
                )
                self.results.add(row)
                self._save_time()
        finally:
            if not env.is_closed:
                env.close()

    def _row(self, prior: Prior, seed: int, checkpoint: int, nfe: int) -> Row:
        return Row(
            task=self.task,
            data=self.demonstrations.style,
            prior=prior.name,
            sigma=prior.sigma,
            chunk=prior.chunk_length,
            nfe=nfe,
            seed=seed,
            checkpoint=checkpoint,
            episodes=self.preset.episodes,
            successes=0,
            mean_steps=0.0,
        )

    def _logger(self, name: str) -> Any:
        if self.logger == "none":
            return None
        return get_logger(
            self.logger, logger_name=str(self.directory / "logs"), experiment_name=name
        )

    def _save_time(self) -> None:
        self.results.meta["wall_time_s"] = self._earlier + time.monotonic() - self._started
        self.results.save()
