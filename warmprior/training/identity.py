"""What a training is: a state is continued by the same network, prior, coupling and data alone."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from warmprior.modules.network import uncompiled

__all__ = ["data_digest", "fixed_identity", "part_identity"]

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
