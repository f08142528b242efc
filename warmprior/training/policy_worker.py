"""What a worker process does with policies: it trains them, and plays their episodes."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode, play_episode
from warmprior.training.policies import Policies

__all__ = ["PolicyWorker"]


class PolicyWorker:
    """The state of a :class:`~warmprior.training.workers.WorkerPool` that trains and plays policies.

    A worker keeps its simulator, and the policy that it played last: an episode after one of the same
    policy needs no preparation.

    Args:
        policies: what is trained and played.
        trainings: how many trainings there will be.

    Attributes:
        iterations: of each training so far, shared by all workers and the process that started them.
    """

    def __init__(self, policies: Policies, trainings: int) -> None:
        self.policies = policies
        # Without a lock, which a killed worker might hold for ever: each entry has a single writer.
        self.iterations = multiprocessing.RawArray("q", trainings)
        self._simulator: EnvBase | None = None
        self._path: Path | None = None

    def train(self, prior: Prior, seed: int, number: int) -> list[tuple[int, float]]:
        """Train a policy, see :meth:`Policies.train`.

        Args:
            prior: its source distribution.
            seed: its training seed.
            number: of the training, from 0; its iterations are reported in that entry.
        """

        def report(iteration: int) -> None:
            self.iterations[number] = iteration

        losses = self.policies.train(prior, seed, report)
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()  # for the next training, which may be another worker's
        return losses

    def play(
        self, prior: Prior, seed: int, checkpoint: int, nfe: int, episode_seed: int
    ) -> Episode:
        """Play an episode on the CPU, see :func:`~warmprior.training.play_episode`.

        Args:
            prior: the source distribution of a trained policy.
            seed: its training seed, and that of its noise.
            checkpoint: its iteration.
            nfe: network evaluations per chunk.
            episode_seed: of the simulator.
        """
        path = self.policies.path(prior, seed, checkpoint)
        if path != self._path:
            self._actor, self._env = self._prepare(prior, seed, checkpoint)
            self._path = path
        return play_episode(self._actor, self._env, episode_seed, nfe=nfe, policy_seed=seed)

    def _prepare(self, prior: Prior, seed: int, checkpoint: int) -> tuple[WarmPriorActor, EnvBase]:
        if self._simulator is None:
            self._simulator = self.policies.make_env()
        transforms = self.policies.transforms(prior)()
        return (
            self.policies.load(prior, seed, checkpoint),
            TransformedEnv(self._simulator, transforms),
        )
