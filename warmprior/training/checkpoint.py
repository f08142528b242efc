"""Trainings and agents on disk, and what they are: one safetensors file each, never a pickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from warmprior.io.files import as_json, check_regular, read_tensors, save_file, write_atomic
from warmprior.modules.network import uncompiled, without_compilation


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
    """SHA-256 of what a state holds."""
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
        found = theirs.get(part)
        if found != value:
            if isinstance(found, dict) and isinstance(value, dict):  # what differs alone
                keys = [key for key in {**found, **value} if found.get(key) != value.get(key)]
                found, value = ({key: each.get(key) for key in keys} for each in (found, value))
            raise ValueError(
                f"{path} belongs to another {part}: it has {found}, this run has {value}. Use the same "
                "options, or another output folder."
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
    """A detached state dict under plain names: what was trained compiled goes on uncompiled."""
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


HASHED_AT_ONCE = 2**26
"""Bytes of the data."""


def part_identity(part: Any) -> Any:
    """A part's configuration, or a function's name, with a digest of what is not trained in it."""
    if part is None:
        return None
    part = uncompiled(part)
    config = getattr(part, "config", None)
    if config is None:
        return getattr(part, "__qualname__", type(part).__qualname__)
    return {**config(), **fixed_identity(part)}


def fixed_identity(part: object) -> dict[str, str]:
    """Digest of what is not trained, such as moments: it is part of what a network, or a prior, is."""
    if not isinstance(part, nn.Module):
        return {}
    trained = {n for n, p in part.named_parameters(remove_duplicate=False) if p.requires_grad}
    state = part.state_dict()
    fixed = {name: value.tolist() for name, value in state.items() if name not in trained}
    digest = hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]
    return {"buffers": digest}


def data_digest(data: TensorDictBase) -> str:
    """Digest of demonstrations: of the names and values of all entries."""
    digest = hashlib.sha256()
    for key, value in sorted(data.items(True, True), key=lambda item: str(item[0])):
        digest.update(str(key).encode())
        rows = max(1, HASHED_AT_ONCE // max(1, value[:1].nbytes))  # it may be larger than the memory
        for part in value.split(rows):
            digest.update(part.cpu().contiguous().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]
