"""Training states, damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tests.fuzz.raw import damage
from tests.fuzz.sandbox import Outcome
from tests.training.cloning_parts import CONFIG, training
from warmprior.training.checkpoint import load_state, module_tensors, named, snapshot_optimizer

NAME = "training states"


def make(folder: Path) -> None:
    """Train a little."""
    training(folder / "whole", CONFIG).run(None)


def mutate(folder: Path, rng: np.random.Generator) -> tuple[str, Callable[[], Outcome], str]:
    """Damage a state; returns how, the load to attempt, and what its error has to name."""
    whole, case = folder / "whole" / "state.safetensors", folder / "case"
    case.mkdir(exist_ok=True)
    path = case / "state.safetensors"
    path.write_bytes(whole.read_bytes())
    how = damage(path, rng)

    def load() -> Outcome:
        cloning = training(case, CONFIG)
        stored, facts = load_state(whole)
        mine = {
            **named("trained", module_tensors(cloning.trained)),
            **named("ema", module_tensors(cloning.ema)),
            **named("optimizer", snapshot_optimizer(cloning.optimizer)),
        }
        restored = all(torch.equal(stored[name], value) for name, value in mine.items())
        same = (cloning.iteration, [list(pair) for pair in cloning.losses]) == (
            facts["iteration"],
            facts["losses"],
        )
        return Outcome("equal") if restored and same else Outcome("silent", "differs")

    return how, load, str(path)
