"""Saved policies, damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from tests.fuzz.raw import damage, odd_json
from tests.fuzz.sandbox import Outcome
from tests.training.test_saved import resign
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
        actor = WarmPriorActor(
            network, PastPrior(3), nfe=2, clip=1.0, normalizer=Normalizer.fit(data)
        )
        save_policy(actor, folder / name)


def odd_tensor(tensors: dict[str, torch.Tensor], rng: np.random.Generator) -> str:
    """Change one tensor, or which there are, in place; returns how."""
    name = str(rng.choice(sorted(tensors)))
    how = str(rng.choice(["type", "nan", "inf", "shape", "missing", "extra", "zero", "negative"]))
    value = tensors[name]
    if how == "type":
        types = [torch.int8, torch.float64, torch.float16, torch.bfloat16, torch.bool]
        tensors[name] = value.to(types[int(rng.integers(len(types)))])
    elif how in ("nan", "inf") and value.is_floating_point():
        tensors[name] = torch.full_like(value, float(how))
    elif how == "shape":
        tensors[name] = torch.cat([value.reshape(-1)] * 2)
    elif how == "missing":
        del tensors[name]
    elif how == "extra":
        tensors["extra." + name] = value.clone()
    else:
        tensors[name] = torch.zeros_like(value) if how == "zero" else -value
    return f"{how} {name}"


def mutate(folder: Path, rng: np.random.Generator) -> tuple[str, Callable[[], Outcome], str]:
    """Damage a policy; returns how, the load to attempt, and what its error has to name."""
    whole = folder / str(rng.choice(["mlp", "chi"]))
    other = folder / ("chi" if whole.name == "mlp" else "mlp")
    case = folder / "case"
    case.mkdir(exist_ok=True)
    files = ("config.json", "model.safetensors")
    for name in files:
        (case / name).write_bytes((whole / name).read_bytes())
    name = str(rng.choice(files))
    signed, kind = False, rng.random()
    if kind < 0.5:
        how = f"{damage(case / name, rng)} {name}"
    elif kind < 0.55:
        how = f"swapped {name}"
        (case / name).write_bytes((other / name).read_bytes())
    elif kind < 0.6:
        how = f"deleted {name}"
        (case / name).unlink()
    else:
        signed = bool(rng.random() < 0.7)
        if kind < 0.8:
            config = json.loads((case / "config.json").read_text())
            how = odd_json(config, rng)
            (case / "config.json").write_text(json.dumps(config))
        else:
            tensors = load_file(case / "model.safetensors")
            how = odd_tensor(tensors, rng)
            save_file(tensors, case / "model.safetensors")
        if signed:
            resign(case)
            how += ", signed"

    def load() -> Outcome:
        actor = load_policy(case)
        expected = load_policy(whole)
        state, theirs = actor.state_dict(), expected.state_dict()
        same = state.keys() == theirs.keys() and all(
            torch.equal(state[n], theirs[n]) for n in state
        )
        if same and policy_config(actor) == policy_config(expected):
            return Outcome("equal")
        if not signed:
            return Outcome("silent", "differs")
        stored = load_file(case / "model.safetensors")
        written = json.loads((case / "config.json").read_text())
        mine = policy_config(actor)
        parts = ("network", "prior", "actor", "normalizer")
        faithful = state.keys() == stored.keys() and all(
            torch.equal(state[n], stored[n]) and state[n].isfinite().all() for n in state
        )
        told = all(_told(written[part], mine[part]) for part in parts)
        return (
            Outcome("as stored")
            if faithful and told
            else Outcome("silent", "differs from the file")
        )

    return how, load, str(case)


def _told(written: object, mine: object) -> bool:
    """Whether everything that is written is what was built; an option left out has its default."""
    if isinstance(written, dict) and isinstance(mine, dict):
        return all(key in mine and _told(value, mine[key]) for key, value in written.items())
    return written == mine
