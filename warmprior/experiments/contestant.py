"""A policy of a comparison: where it lies, and what tells it from the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warmprior.experiments.condition import Condition
from warmprior.experiments.store import Store
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.training_config import TrainingConfig

__all__ = ["Cell", "Contestant"]


@dataclass(frozen=True)
class Cell:
    """Episodes that make one row.

    Attributes:
        checkpoint: of the policy's training, an iteration.
        nfe: network evaluations per chunk.
        condition: how else they are played.
    """

    checkpoint: int
    nfe: int
    condition: Condition

    def facts(self) -> dict[str, Any]:
        """What rows tell of it."""
        return {"checkpoint": self.checkpoint, "nfe": self.nfe, **self.condition.facts()}

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self.facts().items())


@dataclass(frozen=True, eq=False)
class Contestant:
    """A policy of a comparison, trained or not.

    Attributes:
        store: where it lies, with its problem.
        prior: its source distribution.
        training: its recipe, with its seed.

    See Also:
        :class:`~warmprior.experiments.Comparison`: evaluates several of them.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior
        >>> from warmprior.experiments import NetworkOptions, navigation_problem
        >>> with TemporaryDirectory() as folder:
        ...     store = Store(navigation_problem(), NetworkOptions(), Path(folder), Path(folder) / "logs")
        ...     contestant = Contestant(store, PastPrior(4), TrainingConfig(iterations=20, checkpoints=1))
        ...     str(contestant), contestant.path.is_dir()
        ('navigation toy, past, sigma 0.5, H 4, seed 0', False)
        >>> [str(cell) for cell in contestant.cells(nfes=[9, 1], conditions=[Condition()])]
        ['checkpoint 20, nfe 9', 'checkpoint 20, nfe 1']
    """

    store: Store
    prior: Prior
    training: TrainingConfig

    @property
    def folder(self) -> Path:
        """Where it lies, or will lie."""
        return self.store.folder(self.prior, self.training)

    @property
    def path(self) -> Path:
        """Where its last policy of averaged weights lies, or will lie."""
        return policy_path(self.folder, self.training.iterations)

    def policy(self) -> WarmPriorActor:
        """The last policy of averaged weights, trained if it is not yet."""
        return self.store.policy(self.prior, self.training)

    def __str__(self) -> str:
        problem = self.store.problem
        return f"{problem.task} {problem.style}, {self.prior.describe()}, seed {self.training.seed}"

    def teacher(self) -> Contestant:
        """The policy that it learns from, see :attr:`Prior.teacher`."""
        return replace(self, prior=self.store.teacher(self.prior))

    def facts(self) -> dict[str, Any]:
        """What rows tell of it."""
        return {
            "task": self.store.problem.task,
            "data": self.store.problem.style,
            **self.store.problem.space,
            "prior": self.prior.name,
            "options": self.prior.options,
            "sigma": float(self.prior.sigma),
            "chunk": self.prior.chunk_length,
            "seed": self.training.seed,
            "iterations": self.training.iterations,
        }

    def cells(self, nfes: Sequence[int], conditions: Sequence[Condition]) -> list[Cell]:
        """How it is played: a row per checkpoint, NFE and condition.

        Args:
            nfes: numbers of network evaluations to play it with, where its field allows them.
            conditions: how else.
        """
        return [
            Cell(checkpoint, nfe, condition)
            for checkpoint in self.training.checkpoint_iterations
            for nfe in self.prior.allowed_nfes(nfes)
            for condition in conditions
        ]
