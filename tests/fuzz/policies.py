"""Saved policies, damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from tests.fuzz.raw import damage
from tests.fuzz.sandbox import Outcome
from warmprior import (
    ChiTransformer,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.training.saved import load_policy, policy_config, save_policy

NAME = "saved policies"


def make(folder: Path) -> None:
    """Save two policies."""
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(50, 5), "action": torch.randn(50, 2)}, [50])
    networks = {
        "mlp": PreconditionedNetwork(VelocityMLP(2, 5, 3, 2, hidden_dim=16)),
        "chi": ChiTransformer(2, 5, 3, embedding_dim=8, num_layers=1, num_heads=2),
    }
    for name, network in networks.items():
        actor = WarmPriorActor(network, PastPrior(3), nfe=2, clip=1.0, normalizer=Normalizer.fit(data))
        save_policy(actor, folder / name)


def mutate(folder: Path, rng: np.random.Generator) -> tuple[str, Callable[[], Outcome], str]:
    """Damage a policy; returns how, the load to attempt, and what its error has to name."""
    whole, case = folder / str(rng.choice(["mlp", "chi"])), folder / "case"
    case.mkdir(exist_ok=True)
    path = case / "model.safetensors"
    path.write_bytes((whole / path.name).read_bytes())
    how = damage(path, rng)

    def load() -> Outcome:
        actor, expected = load_policy(case), load_policy(whole)
        state, theirs = actor.state_dict(), expected.state_dict()
        same = state.keys() == theirs.keys() and all(torch.equal(state[n], theirs[n]) for n in state)
        if same and policy_config(actor) == policy_config(expected):
            return Outcome("equal")
        return Outcome("silent", "differs")

    return how, load, str(case)
