"""Trained policies on disk, found again by everything that determines them."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.record.loggers import get_logger

from warmprior.data import RobomimicExperienceReplay
from warmprior.envs import RobosuiteEnv
from warmprior.envs.description import environment_description
from warmprior.io.files import check_writable
from warmprior.modules import Normalizer
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.behaviour_cloning import (
    STATE_FORMAT,
    BehaviourCloning,
    policy_path,
    precondition,
)
from warmprior.training.demonstrations import Demonstrations
from warmprior.training.presets import Preset
from warmprior.training.threads import torch_threads
from warmprior.transforms import MeanObservation, policy_transforms

__all__ = ["Policies"]


@dataclass
class Policies:
    """Policies that differ in their source alone, trained alike on one set of demonstrations.

    Each lies in a folder named by a digest of everything that determines it (data, recipe, prior,
    network): whoever asks for the same options shares it, and an interrupted training continues from
    its last state.

    Attributes:
        demonstrations: the data.
        preset: the budget.
        directory: where the policies lie.
        logs: folder of the training logs.
        device: to train on.
        compile: compile the velocity network in training.
        logger: TorchRL logger: ``"csv"``, ``"tensorboard"``, ``"wandb"`` or ``"none"``.

    Raises:
        OSError: if ``directory`` cannot be written to.
        DatasetError: if the demonstrations cannot be read.
    """

    demonstrations: Demonstrations
    preset: Preset
    directory: Path
    logs: Path
    device: str = "cpu"
    compile: bool = False
    logger: str = "csv"
    _losses: dict[Path, list[tuple[int, float]]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        check_writable(self.directory)
        dataset = RobomimicExperienceReplay(self.demonstrations.path)
        self.task = task_of(dataset)
        self.num_episodes, self.num_steps = dataset.num_episodes, len(dataset.data)
        self.normalizer = Normalizer.fit(dataset.data)
        self.data = self.normalizer.normalize(dataset.data.exclude("next"))
        self.make_env = partial(
            RobosuiteEnv, env_args=dataset.env_args, style=self.demonstrations.style
        )
        self._environment = environment_description(
            dataset.env_args, self.demonstrations.style, self.preset.observation_steps
        )

    def facts(self) -> dict[str, Any]:
        """What ``results.json`` tells about the demonstrations."""
        demonstrations = self.demonstrations
        return {
            "task": self.task,
            "style": demonstrations.style,
            "data_source": demonstrations.source,
            "data": {
                "file": demonstrations.path.name,
                "sha256": demonstrations.sha256,
                "demonstrations": self.num_episodes,
                "steps": self.num_steps,
            },
        }

    def new_actor(self, prior: Prior, seed: int) -> WarmPriorActor:
        """An untrained policy; its initial weights depend on the seed alone."""
        torch.manual_seed(seed)
        if isinstance(prior, nn.Module):  # it learns: every policy has its own
            prior = Prior.from_config(prior.config())
        action_dim = self.data["action"].shape[-1]
        network = self.preset.make_network(
            action_dim,
            self.data["observation"].shape[-1] + MeanObservation.width(prior, action_dim),
            prior.prediction_length,
        )
        if self.preset.precondition:
            steps = self.preset.observation_steps
            network = precondition(network, self.data, prior, observation_steps=steps)
        # A copy: the policy moves to the device, the environments' normaliser stays on the CPU.
        normalizer = copy.deepcopy(self.normalizer)
        # The normalised demonstrations span [-1, 1]: what leaves it is executed, and remembered, at
        # the bound.
        actor = WarmPriorActor(
            network, prior, normalizer=normalizer, clip=1.0, environment=self._environment
        )
        return actor.to(self.device)

    def folder(self, prior: Prior, seed: int) -> Path:
        """Where a policy lies, or will lie."""
        identity = json.dumps(
            [
                self.demonstrations.sha256,
                asdict(replace(self.preset.training, seed=seed)),
                prior.config(),
                self.preset.network,
                self.preset.network_options,
                self.preset.precondition,
                self.preset.observation_steps,
                self.device,
                self.compile,
                version("torch"),
                version("warmprior"),
                STATE_FORMAT,
            ]
        )
        digest = hashlib.sha256(identity.encode()).hexdigest()[:10]
        name = f"{self.task}-{self.demonstrations.style}-{prior.name}-seed{seed}-{digest}"
        return self.directory / name

    def train(
        self, prior: Prior, seed: int, progress: Callable[[int], object] | None = None
    ) -> list[tuple[int, float]]:
        """Train a policy; continue or reuse the stored one of the same options.

        On a CPU it is trained by one thread, wherever: another number would give other weights.

        Args:
            prior: its source distribution.
            seed: its training seed.
            progress: called with the number of iterations after each; a bar if ``None``.

        Returns:
            The training curve, ``[(iteration, loss), ...]``.

        Raises:
            FloatingPointError: if the loss becomes NaN or infinite.
        """
        folder = self.folder(prior, seed)
        if folder not in self._losses:
            logger = self._logger(folder.name)
            with (
                torch_threads(1 if torch.device(self.device).type == "cpu" else None),
                # A worker process ends without the exit handlers that some loggers write in.
                nullcontext() if logger is None else closing(logger),
            ):
                training = BehaviourCloning(
                    self.new_actor(prior, seed),
                    self.data.to(self.device),
                    replace(self.preset.training, seed=seed),
                    folder,
                    observation_steps=self.preset.observation_steps,
                    logger=logger,
                    compile=self.compile,
                )
                name = f"train {prior.describe()}, seed {seed}" if progress is None else None
                training.run(name, progress)
            self.note_trained(prior, seed, training.losses)
        return self._losses[folder]

    def note_trained(self, prior: Prior, seed: int, losses: list[tuple[int, float]]) -> None:
        """Take note of a policy that another process trained.

        Args:
            prior: its source distribution.
            seed: its training seed.
            losses: what :meth:`train` returned there.
        """
        self._losses[self.folder(prior, seed)] = losses

    def policy(self, prior: Prior, seed: int, checkpoint: int | None = None) -> WarmPriorActor:
        """A policy of averaged weights, trained if it is not yet.

        Args:
            prior: its source distribution.
            seed: its training seed.
            checkpoint: iteration; the last by default.
        """
        self.train(prior, seed)
        return self.load(prior, seed, checkpoint).to(self.device)

    def load(self, prior: Prior, seed: int, checkpoint: int | None = None) -> WarmPriorActor:
        """A trained policy of averaged weights, from disk, on the CPU.

        Args:
            prior: its source distribution.
            seed: its training seed.
            checkpoint: iteration; the last by default.

        Raises:
            FileNotFoundError: if it is not trained that far.
        """
        return WarmPriorActor.from_pretrained(self.path(prior, seed, checkpoint), prior=prior)

    def path(self, prior: Prior, seed: int, checkpoint: int | None = None) -> Path:
        """Where a policy of averaged weights lies, or will lie.

        Args:
            prior: its source distribution.
            seed: its training seed.
            checkpoint: iteration; the last by default.
        """
        checkpoint = self.preset.training.iterations if checkpoint is None else checkpoint
        return policy_path(self.folder(prior, seed), checkpoint)

    def transforms(self, prior: Prior) -> partial[Any]:
        """Builder of the environment transforms that these policies need."""
        return partial(
            policy_transforms,
            prior,
            normalizer=self.normalizer,
            observation_steps=self.preset.observation_steps,
        )

    def _logger(self, name: str) -> Any:
        if self.logger == "none":
            return None
        return get_logger(self.logger, logger_name=str(self.logs), experiment_name=name)


def task_of(dataset: RobomimicExperienceReplay) -> str:
    """Short name of a dataset's task, or the environment's where it is none of ours."""
    task = dataset.task
    return str(dataset.env_args["env_name"]).lower() if task is None else task.name
