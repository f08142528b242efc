"""Training states, damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tests.fuzz.policies import odd_tensor
from tests.fuzz.raw import damage, odd_json
from tests.fuzz.sandbox import Outcome
from tests.training.cloning_parts import CONFIG, training
from warmprior.training.checkpoint import (
    load_state,
    module_tensors,
    named,
    save_state,
    snapshot_optimizer,
)

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
    kind, signed = rng.random(), False
    if kind < 0.5:
        how = damage(path, rng)
    else:
        tensors, facts = load_state(path)
        how = odd_tensor(tensors, rng) if kind < 0.75 else odd_json(facts, rng)
        save_state(path, tensors, facts)
        signed = True

    def load() -> Outcome:
        cloning = training(case, CONFIG)
        stored, facts = load_state(path if signed else whole)
        mine = {
            **named("trained", module_tensors(cloning.trained)),
            **named("ema", module_tensors(cloning.ema)),
            **named("optimizer", snapshot_optimizer(cloning.optimizer)),
        }
        restored = all(torch.equal(stored[name], value) for name, value in mine.items())
        finite = all(value.isfinite().all() for value in mine.values())
        told = (cloning.iteration, [list(pair) for pair in cloning.losses]) == (
            facts["iteration"],
            facts["losses"],
        )
        if not (restored and finite and told):
            return Outcome("silent", "differs")
        return Outcome("as stored" if signed else "equal")

    return how, load, str(path)
