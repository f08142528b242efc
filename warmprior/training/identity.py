"""What a training is: a state is continued by the same network, prior, coupling and data alone."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from warmprior.modules.compiled import uncompiled
from warmprior.objectives.couplings import Coupling

__all__ = ["coupling_identity", "data_digest", "fixed_identity", "network_identity"]

HASHED_AT_ONCE = 2**26
"""Bytes of the data."""


def network_identity(network: nn.Module) -> Any:
    """Configuration of a network, with a digest of what is not trained in it."""
    network = uncompiled(network)
    config: Any = network.config
    return {**config(), **fixed_identity(network)}


def coupling_identity(coupling: Coupling | None) -> Any:
    """Configuration of a coupling, or the name of a function."""
    if coupling is None:
        return None
    config = getattr(coupling, "config", None)
    return config() if config else getattr(coupling, "__qualname__", type(coupling).__qualname__)


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
