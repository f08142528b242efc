"""A replay buffer on disk that survives the process: transitions are appended and never rewritten."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from warmprior.io.files import read_tensors, save_file, write_atomic

__all__ = ["ReplaySegments"]


class ReplaySegments:
    """A folder of safetensors files, one per save, with the transitions since the one before.

    A segment is valid once :attr:`committed` counts it. If a process dies between writing a segment and its
    training state, the next one replaces that segment. Of a folder that exists ``segments`` are kept.
    """

    def __init__(self, directory: Path, segments: int = 0) -> None:
        self.directory = directory
        self.committed = segments
        self._pending: list[TensorDictBase] = []

    def _path(self, index: int) -> Path:
        return self.directory / f"{index:06d}.safetensors"

    def append(self, transitions: TensorDictBase) -> None:
        """Remember transitions ``[n]`` for the next :meth:`write`."""
        self._pending.append(transitions.cpu())

    def write(self) -> None:
        """Write what was appended as one new segment, if anything was."""
        if not self._pending:
            return
        data: Any = torch.cat(self._pending)  # type: ignore[arg-type]
        tensors = {
            json.dumps(key): value.contiguous()  # names may hold any separator
            for key, value in data.items(True, True)
        }
        write_atomic(self._path(self.committed), lambda path: save_file(tensors, path))
        self.committed += 1
        self._pending.clear()

    def load(self) -> TensorDict | None:
        """All committed transitions ``[N]`` or ``None``; a ``ValueError`` names a damaged segment."""
        parts = []
        for index in range(self.committed):
            path = self._path(index)
            try:
                tensors, _ = read_tensors(path.read_bytes())
            except Exception as error:
                raise ValueError(
                    f"{path}, a part of the replay buffer, is missing or damaged ({error}): restore it, "
                    "or choose another output folder"
                ) from error
            size = len(next(iter(tensors.values())))
            part = TensorDict({}, batch_size=[size])
            for name, value in tensors.items():
                key = json.loads(name)
                part.set(tuple(key) if isinstance(key, list) else key, value)
            parts.append(part)
        return torch.cat(parts) if parts else None
