"""What a worker process does with policies: it trains and measures them, and plays their episodes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from pathlib import Path

import torch
from torchrl.envs import EnvBase, TransformedEnv

from warmprior.diagnostics.held_out import SharedObservations
from warmprior.diagnostics.source_leak import SourceLeak, source_leak
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.evaluation import Episode, play_episode
from warmprior.training.policies import Policies

__all__ = ["PolicyWorker"]

LEAK_WINDOWS = 512
"""Observations on which the source leak of every policy is measured."""


class PolicyWorker:
    """The state of a :class:`~warmprior.training.workers.WorkerPool` that works on policies.

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

    def leak(
        self, prior: Prior, seed: int, checkpoint: int, nfes: Sequence[int]
    ) -> dict[int, SourceLeak]:
        """Measure how much of the source's noise a policy lets through, on its training data.

        Args:
            prior: the source distribution of a trained policy.
            seed: its training seed.
            checkpoint: its iteration.
            nfes: network evaluations per chunk to measure at.

        Returns:
            By NFE, see :func:`~warmprior.diagnostics.source_leak`; nothing where the data have no two
            episodes with steps to compare.
        """
        policies = self.policies
        shared = SharedObservations(
            policies.data.to("cpu"),
            prior.chunk_length,
            observation_steps=policies.preset.observation_steps,
        )
        chosen = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        shared = shared.subset(chosen[:LEAK_WINDOWS].sort()[0])
        if len(shared.episodes.unique()) < 2:
            return {}
        policy = policies.load(prior, seed, checkpoint)
        return source_leak(policy, shared.windows(prior), nfes=nfes, episodes=shared.episodes)

    def _prepare(self, prior: Prior, seed: int, checkpoint: int) -> tuple[WarmPriorActor, EnvBase]:
        if self._simulator is None:
            self._simulator = self.policies.make_env()
        policy = self.policies.load(prior, seed, checkpoint)
        # The policy's own prior, which may have learnt.
        transforms = self.policies.transforms(policy.prior)()
        return policy, TransformedEnv(self._simulator, transforms)
