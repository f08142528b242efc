"""Policies, trainings and agents on disk: one safetensors file each, replaced atomically, never a pickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from warmprior.io.files import as_json, check_regular, read_tensors, save_file, write_atomic
from warmprior.modules.network import without_compilation

__all__ = ["load_state", "restore_optimizer", "save_state", "snapshot_optimizer"]


def save_state(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write tensors, and JSON-serialisable facts, as one ``.safetensors`` file."""
    stored = as_json(facts)
    cpu = {name: value.detach().to("cpu").contiguous() for name, value in tensors.items()}
    # One entry: the format keeps no order of several, and equal states have equal files.
    metadata = {"facts": json.dumps(stored | {"sha256": digest_of_state(stored, cpu)})}
    write_atomic(path, lambda temporary: save_file(cpu, temporary, metadata=metadata))


def load_state(
    path: Path, what: str = "training state", advice: str = "Remove it to train again"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_state` wrote, once: what is checked is what is given back."""
    check_regular(path)
    try:
        tensors, metadata = read_tensors(path.read_bytes())
        facts = dict(json.loads(metadata["facts"]))
        if facts.pop("sha256") != digest_of_state(facts, tensors):
            raise ValueError("its content has changed since it was written")
    except Exception as error:  # the format's own errors, those of JSON, or a failing disk
        raise ValueError(f"{path} is not a readable {what}: {error}. {advice}.") from error
    return tensors, facts


def digest_of_state(facts: Any, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(json.dumps(facts).encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Name the state in a ``ValueError`` for whatever entries that are not as they were saved lead to."""
    try:
        yield
    except Exception as error:
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise ValueError(
            f"{path} is damaged, or the code has changed since: {reason}. Remove the folder to train again."
        ) from error


def check_identity(path: Path, theirs: Any, mine: Mapping[str, Any]) -> None:
    """Refuse a state that belongs to another training, naming the first part that differs."""
    theirs = theirs if isinstance(theirs, dict) else {}
    for part, value in as_json(mine).items():
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
    """A module's state dict without aliases of the live parameters' autograd history.

    Under the plain names, so that what was trained compiled goes on uncompiled and the reverse.
    """
    return {n: value.detach() for n, value in without_compilation(module.state_dict()).items()}


def restore_module(module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Load what :func:`module_tensors` gave; a ``RuntimeError`` if names or shapes differ."""
    plain = dict(zip(module_tensors(module), module.state_dict(), strict=True))
    module.load_state_dict({plain.get(name, name): value for name, value in tensors.items()})


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
