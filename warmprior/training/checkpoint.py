"""Training state on disk: one safetensors file, replaced atomically, never a pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from warmprior._files import save_file, write_atomic

__all__ = ["load_state", "restore_optimizer", "save_state", "snapshot_optimizer"]


def save_state(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write tensors and JSON-serialisable facts as one file.

    Args:
        path: the ``.safetensors`` file.
        tensors: named tensors.
        facts: anything else, stored as JSON in the file's header.
    """
    metadata = {"facts": json.dumps(facts)}
    cpu = {name: value.detach().to("cpu").contiguous() for name, value in tensors.items()}
    write_atomic(path, lambda temporary: save_file(cpu, temporary, metadata=metadata))


def load_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_state` wrote.

    Raises:
        ValueError: if the file is damaged or was written by something else.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})["facts"])
            return {name: file.get_tensor(name) for name in file.keys()}, facts  # noqa: SIM118
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not a readable training state: {error}") from error


def check_identity(path: Path, theirs: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Whether a stored state belongs to the training that wants to continue it.

    Raises:
        ValueError: naming the first part that differs.
    """
    for part, value in mine.items():
        if theirs.get(part) != value:
            raise ValueError(
                f"{path} belongs to another {part}: it has {theirs.get(part)}, this run has {value}. Use "
                "the same options, another output folder, or do not resume."
            )


def snapshot_optimizer(optimizer: Optimizer) -> dict[str, Tensor]:
    """The optimiser's per-parameter tensors, by position and name."""
    state = optimizer.state_dict()["state"]
    return {f"{i}.{name}": value for i, slots in state.items() for name, value in slots.items()}


def restore_optimizer(optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Load :func:`snapshot_optimizer`'s tensors into an optimiser of the same parameters."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def named(prefix: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Prefix every name with ``prefix/``."""
    return {f"{prefix}/{name}": value for name, value in values.items()}


def select(prefix: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse of :func:`named`."""
    start = f"{prefix}/"
    return {name[len(start) :]: value for name, value in values.items() if name.startswith(start)}


def module_tensors(module: nn.Module) -> dict[str, Tensor]:
    """A module's state dict without aliases of the live parameters' autograd history."""
    return {name: value.detach() for name, value in module.state_dict().items()}


def rng_tensors(generator: torch.Generator) -> dict[str, Tensor]:
    """State of a generator and of PyTorch's global ones (dropout draws from them)."""
    states = {"generator": generator.get_state(), "global": torch.get_rng_state()}
    if generator.device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(generator.device)
    return states


def restore_rng(generator: torch.Generator, states: Mapping[str, Tensor]) -> None:
    """Load what :func:`rng_tensors` gave."""
    generator.set_state(states["generator"])
    torch.set_rng_state(states["global"])
    if generator.device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], generator.device)
