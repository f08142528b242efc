"""Files of policies, training runs and agents, checked against their digest, and the identity of a run."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.optim import Optimizer

from warmprior.io.files import as_json, check_regular, read_tensors, save_file, write_atomic
from warmprior.modules.network import uncompiled, without_compilation


def save_state(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write tensors, and JSON-serialisable facts, as one ``.safetensors`` file."""
    stored = as_json(facts)
    cpu = {name: value.detach().to("cpu").contiguous() for name, value in tensors.items()}
    # A single entry, because the format keeps no order of several, and equal states must have equal files.
    metadata = {"facts": json.dumps(stored | {"sha256": digest_of_state(stored, cpu)})}
    write_atomic(path, lambda temporary: save_file(cpu, temporary, metadata=metadata))


def load_state(
    path: Path, what: str = "training state", advice: str = "Remove it to train again"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a file of :func:`save_state`, only once, so that the returned values are the checked ones."""
    try:
        check_regular(path)
        tensors, metadata = read_tensors(path.read_bytes())
        facts = dict(json.loads(metadata["facts"]))
        if facts.pop("sha256") != digest_of_state(facts, tensors):
            raise ValueError("its content has changed since it was written")
    except Exception as error:  # the format's own errors, those of JSON, or a failing disk
        raise ValueError(f"{path} is not a readable {what}: {error}. {advice}.") from error
    return tensors, facts


class RunState:
    """The file ``state.safetensors`` of a run, which may be written by several processes in turn."""

    def __init__(self, directory: Path, identity: Mapping[str, Any]) -> None:
        self.path, self.identity = directory / "state.safetensors", identity
        self._known: float | None = None  # when the state that this process has was written

    def save(self, tensors: Mapping[str, Tensor], **facts: Any) -> None:
        """Write the state, with the run's identity and JSON-serialisable facts."""
        save_state(self.path, tensors, {"identity": self.identity, **facts})
        self._known = self.path.stat().st_mtime

    def restore(self, load: Callable[[dict[str, Tensor], dict[str, Any]], None]) -> None:
        """Call ``load`` with tensors and facts of the state, if this process does not have it yet.

        Raises ValueError if it is damaged, or that of another run.
        """
        if not self.path.exists() or (written := self.path.stat().st_mtime) == self._known:
            return
        tensors, facts = load_state(self.path)
        check_identity(self.path, facts.get("identity"), self.identity)
        with restoring(self.path):
            load(tensors, facts)
        self._known = written


def digest_of_state(facts: Any, tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of a state's content."""
    digest = hashlib.sha256(json.dumps(facts).encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(_bytes(value))
    return digest.hexdigest()


def _bytes(value: Tensor) -> memoryview:
    """Return a tensor's values as bytes."""
    # Copied, because an expanded number counts as contiguous, but has no stride.
    flat = value.reshape(-1).cpu().clone(memory_format=torch.contiguous_format)
    return memoryview(flat.view(torch.uint8).numpy())


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Turn any error from damaged entries into a ValueError that names the state."""
    try:
        yield
    except Exception as error:
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise ValueError(
            f"{path} is damaged, or the code has changed since: {reason}. Remove the folder to train again."
        ) from error


class AnotherRunError(ValueError):
    """The error of a folder that holds another run, which other options would continue."""


def check_identity(path: Path, stored: Any, expected: Mapping[str, Any]) -> None:
    """Raise AnotherRunError, with what differs, if a state belongs to another run."""
    stored, expected = stored if isinstance(stored, dict) else {}, as_json(expected)
    if stored.get("format") != expected.get("format"):
        raise AnotherRunError(f"{path} was written by another version: remove it, or choose another folder")
    if any(stored.get(part) != value for part, value in expected.items()):
        raise AnotherRunError(
            f"{path} belongs to a run with other options ({differences(stored, expected)}): repeat its "
            "options, or choose another folder"
        )


DIGESTS = {
    "data": "the demonstrations, or what is read of them, differ",
    "policy": "the policy differs",
}
"""This says what the digests of a configuration stand for."""


def differences(before: Any, now: Any) -> str:
    """Return in words what differs between two configurations of JSON.

    Examples:
        >>> from warmprior.saving.training_state import differences
        >>> before = {"prior": {"name": "past", "sigma": 0.5}, "data": "fd6a7b7812d94c3f"}
        >>> differences(before, {"prior": {"name": "past", "sigma": 0.3}, "data": "4b6c497c00a1b2c3"})
        'sigma was 0.5 and is 0.3; the demonstrations, or what is read of them, differ'
        >>> differences(before, before | {"prior": {"name": "gaussian"}})
        'prior was past and is gaussian'
    """
    found = {path: _in_words(path, old, new) for path, old, new in _leaves((), before, now)}
    # Untrained values mostly follow from other differences.
    options = [text for path, text in found.items() if path[-1] != "buffers"]
    return "; ".join(options or found.values())


def _in_words(path: tuple[str, ...], old: Any, new: Any) -> str:
    part = " of ".join(reversed(path[:-1]))
    if not all(isinstance(value, str) and re.fullmatch("[0-9a-f]{16,}", value) for value in (old, new)):
        return f"{path[-1]} was {old} and is {new}"
    if path[-1] == "buffers":
        return f"the untrained values of {part}, such as statistics of the demonstrations, differ"
    return DIGESTS.get(path[-1], f"the {path[-1]} of {part} differs")


def _leaves(path: tuple[str, ...], before: Any, now: Any) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Yield the options that differ; objects of two classes differ by the name of their class alone."""
    are_parts = isinstance(before, dict) and isinstance(now, dict)
    if are_parts and before.get("name") == now.get("name"):
        for key in {**before, **now}:
            if before.get(key) != now.get(key):
                yield from _leaves((*path, key), before.get(key), now.get(key))
    else:
        old, new = (each.get("name", each) if isinstance(each, dict) else each for each in (before, now))
        yield path, old, new


def snapshot_optimizer(optimizer: Optimizer) -> dict[str, Tensor]:
    """Return the optimiser's per-parameter tensors, by position and name."""
    state = optimizer.state_dict()["state"]
    return {f"{i}.{name}": value for i, slots in state.items() for name, value in slots.items()}


def restore_optimizer(optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Load :func:`snapshot_optimizer`'s tensors into an optimiser with the same parameters."""
    slots = TensorDict(dict(tensors)).unflatten_keys(".").to_dict()
    state = {int(position): values for position, values in slots.items()}
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def as_key(value: Any) -> NestedKey:
    """Return a tensordict's key from JSON, which holds nested keys as lists."""
    parts = value if isinstance(value, list | tuple) else [value]
    if not parts or not all(isinstance(part, str) for part in parts):
        raise ValueError(f"{value!r} is not a key")
    return value if isinstance(value, str) else tuple(value)


def named(prefix: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Prefix every name with ``prefix/``."""
    return {f"{prefix}/{name}": value for name, value in values.items()}


def select(prefix: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Invert :func:`named`."""
    start = f"{prefix}/"
    return {name[len(start) :]: value for name, value in values.items() if name.startswith(start)}


def module_tensors(module: nn.Module) -> dict[str, Tensor]:
    """Return a detached state dict with the names of the uncompiled module."""
    return {n: value.detach() for n, value in without_compilation(module.state_dict()).items()}


def restore_module(module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Load the tensors of :func:`module_tensors`; raise RuntimeError if names or shapes differ."""
    plain = dict(zip(module_tensors(module), module.state_dict(), strict=True))
    module.load_state_dict({plain.get(name, name): value for name, value in tensors.items()})


def rng_tensors(generator: torch.Generator) -> dict[str, Tensor]:
    """Return the state of a generator and of PyTorch's global ones (which dropout uses)."""
    states = {"generator": generator.get_state(), "global": torch.get_rng_state()}
    if generator.device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(generator.device)
    return states


def restore_rng(generator: torch.Generator, states: Mapping[str, Tensor]) -> None:
    """Load the states of :func:`rng_tensors`."""
    generator.set_state(states["generator"])
    torch.set_rng_state(states["global"])
    if generator.device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], generator.device)


HASHED_AT_ONCE = 2**26
"""The bytes of data that are hashed at once."""


STATE_FORMAT = 8
"""A version in every identity; raised whenever the same options lead to other weights or another file."""


def run_identity(data: TensorDictBase | str, config: Any, **parts: Any) -> dict[str, Any]:
    """Return what identifies a training run: options, data, parts, and the version of the code.

    Args:
        data: the demonstrations, or their digest.
        config: the options.

    Keyword Args:
        parts: what is trained and with what, by name: objects, or JSON.
    """
    digest = data if isinstance(data, str) else data_digest(data)
    named_parts = {name: part_identity(part) for name, part in parts.items()}
    return {"config": config, "data": digest, **named_parts, "format": STATE_FORMAT}


def part_identity(part: Any) -> Any:
    """Return JSON as it is; else a configuration, or a function's name, with a digest of untrained values."""
    if part is None or isinstance(part, dict | str | bool):
        return part
    part = uncompiled(part)
    config = getattr(part, "config", None)
    if config is None:
        return getattr(part, "__qualname__", type(part).__qualname__)
    return {**config(), **fixed_identity(part)}


def fixed_identity(part: object) -> dict[str, str]:
    """Return a digest of a part's untrained values, such as moments, which belong to its identity."""
    if not isinstance(part, nn.Module):
        return {}
    trained = {n for n, p in part.named_parameters(remove_duplicate=False) if p.requires_grad}
    state = part.state_dict()
    fixed = {name: value.tolist() for name, value in state.items() if name not in trained}
    digest = hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:16]
    return {"buffers": digest}


def data_digest(data: TensorDictBase) -> str:
    """Return a digest of demonstrations, from the names and values of all entries."""
    digest = hashlib.sha256()
    for key, value in sorted(data.items(True, True), key=lambda item: str(item[0])):
        digest.update(str(key).encode())
        rows = max(1, HASHED_AT_ONCE // max(1, value[:1].nbytes))  # an entry may be larger than the memory
        for part in value.split(rows):
            digest.update(_bytes(part))
    return digest.hexdigest()[:16]
