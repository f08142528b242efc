"""Training state on disk: round trip, damage, and a disk that fails."""

from __future__ import annotations

import errno
import os

import pytest
import torch

from warmprior.training.checkpoint import load_state, save_state

TENSORS = {
    "a/weight": torch.randn(3, 4),
    "b": torch.arange(5),
    "empty": torch.empty(0),
    "scalar": torch.tensor(3.5, dtype=torch.float64),
}
FACTS = {"iteration": 7, "losses": [[1, 0.5]], "text": "grün"}


def test_round_trip(tmp_path):
    path = tmp_path / "deep" / "state.safetensors"
    save_state(path, TENSORS, FACTS)
    tensors, facts = load_state(path)
    assert facts == FACTS and tensors.keys() == TENSORS.keys()
    for name, value in TENSORS.items():
        assert torch.equal(tensors[name], value) and tensors[name].dtype == value.dtype
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no temporary file left


@pytest.mark.parametrize("keep", [0, 5, 40, -1])
def test_damaged_file(tmp_path, keep):
    path = tmp_path / "state.safetensors"
    save_state(path, TENSORS, FACTS)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"state.safetensors is not a readable training state"):
        load_state(path)


def full(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("where", ["replace", "save", "fsync"])
def test_a_full_disk_keeps_the_old_state(tmp_path, monkeypatch, where):
    path = tmp_path / "state.safetensors"
    save_state(path, TENSORS, FACTS)
    if where == "save":
        monkeypatch.setattr("warmprior.training.checkpoint.save_file", full)
    else:
        monkeypatch.setattr(os, where, full)
    with pytest.raises(OSError, match=r"cannot write .*state.safetensors: .*No space left"):
        save_state(path, {"new": torch.zeros(1)}, {})
    monkeypatch.undo()
    assert load_state(path)[1] == FACTS
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
