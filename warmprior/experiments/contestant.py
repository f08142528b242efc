"""A policy of a comparison: where it lies, and what tells it from the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warmprior.experiments.condition import Condition
from warmprior.experiments.methods import Method
from warmprior.experiments.store import Store
from warmprior.modules.actor import WarmPriorActor
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
        method: what makes it differ from others.
        training: its recipe, with its seed.

    See Also:
        :class:`~warmprior.experiments.Comparison`: evaluates several of them.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import Method, NetworkOptions, navigation_problem
        >>> with TemporaryDirectory() as folder:
        ...     store = Store(navigation_problem(), NetworkOptions(), Path(folder), Path(folder) / "logs")
        ...     training = TrainingConfig(iterations=20, checkpoints=1)
        ...     contestant = Contestant(store, Method("past", 4), training)
        ...     str(contestant), contestant.path.is_dir()
        ('navigation toy, past, sigma 0.5, H 4, seed 0', False)
        >>> [str(cell) for cell in contestant.cells(nfes=[9, 1], conditions=[Condition()])]
        ['checkpoint 20, nfe 9', 'checkpoint 20, nfe 1']
    """

    store: Store
    method: Method
    training: TrainingConfig

    @property
    def folder(self) -> Path:
        """Where it lies, or will lie."""
        return self.store.folder(self.method, self.training)

    @property
    def path(self) -> Path:
        """Where its last policy of averaged weights lies, or will lie."""
        return policy_path(self.folder, self.training.iterations)

    def policy(self) -> WarmPriorActor:
        """The last policy of averaged weights, trained if it is not yet."""
        return self.store.policy(self.method, self.training)

    def __str__(self) -> str:
        problem = self.store.problem
        return (
            f"{problem.task} {problem.style}, {self.method.describe()}, seed {self.training.seed}"
        )

    def teacher(self) -> Contestant:
        """The policy that it learns from, see :attr:`Method.teacher`."""
        assert self.method.teacher is not None
        return replace(self, method=self.method.teacher)

    def facts(self) -> dict[str, Any]:
        """What rows tell of it."""
        return {
            "task": self.store.problem.task,
            "data": self.store.problem.style,
            **self.store.problem.space,
            "prior": self.method.name,
            "options": self.method.options,
            "sigma": self.method.sigma,
            "chunk": self.method.chunk_length,
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
            for nfe in self.method.allowed_nfes(nfes)
            for condition in conditions
        ]
