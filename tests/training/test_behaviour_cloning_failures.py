import dataclasses
import errno
import os
import tempfile

import pytest
import torch

from tests.errors import raises, refuses
from tests.states import same
from tests.training.cloning_parts import CONFIG, actor_for, dataset, finished, mlp, training, weights
from warmprior import PastPrior, PreviewPrior
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state


def test_a_state_of_another_run(tmp_path):
    finished(tmp_path)
    before = (tmp_path / "state.safetensors").read_bytes()
    for difference, change in (
        ("learning_rate was", {"config": dataclasses.replace(CONFIG, learning_rate=2e-2)}),
        ("seed was 0 and is 1", {"config": dataclasses.replace(CONFIG, seed=1)}),
        ("sigma was 0.5 and is 0.1", {"actor": actor_for(PastPrior(4, sigma=0.1))}),
        ("prior was past and is preview", {"actor": actor_for(PreviewPrior(4))}),
        ("network was", {"actor": actor_for(network=mlp())}),
        ("demonstrations", {"data": dataset().set("action", torch.zeros(120, 2))}),
    ):
        with raises(ValueError, difference):
            training(tmp_path, **change)
        assert (tmp_path / "state.safetensors").read_bytes() == before


def test_a_full_disk(tmp_path, monkeypatch):
    cloning = training(tmp_path)
    replace, calls = os.replace, []

    def failing(*args):
        calls.append(args)
        if len(calls) >= 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(*args)

    monkeypatch.setattr(os, "replace", failing)
    refuses(lambda: cloning.run(), OSError, tmp_path)
    monkeypatch.undo()
    whole = finished(tmp_path / "whole")
    again = training(tmp_path)  # what was there before can be read, and training goes on
    assert again.iteration <= 35
    again.run()
    assert same(weights(again), weights(whole))


def test_a_folder_that_cannot_be_written_is_told_before_the_first_step(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file" / "run", tmp_path / "read-only"):
        cloning = training(folder)
        with raises(OSError, folder, "choose another folder"):
            cloning.run(None)
        assert cloning.iteration == 0
        monkeypatch.setattr(tempfile, "TemporaryFile", read_only)  # root may write anywhere


def read_only(dir):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(dir))


@pytest.mark.parametrize("bad", [8, 15])
def test_nan_stops_and_keeps_the_last_good_state(tmp_path, bad):
    """Wherever it appears between two logs or two saves, no NaN reaches the disk."""
    cloning = training(tmp_path)
    forward, calls = cloning.update.loss_module.forward, []

    def broken(data):
        calls.append(data)
        out = forward(data)
        if len(calls) >= bad:
            out["loss_flow_matching"] = out["loss_flow_matching"] * float("nan")
        return out

    cloning.update.loss_module.forward = broken
    refuses(lambda: cloning.run(), FloatingPointError, "the loss", "NaN", "state.safetensors")
    tensors, facts = load_state(tmp_path / "state.safetensors")
    assert facts["iteration"] < bad
    assert all(torch.isfinite(v).all() for v in tensors.values() if v.is_floating_point())
    for folder in tmp_path.glob("policy_*"):
        network = load_policy(folder).network
        assert all(torch.isfinite(p).all() for p in network.parameters())
    assert same(weights(finished(tmp_path)), weights(finished(tmp_path / "whole")))


def test_nan_before_the_first_save_names_no_state(tmp_path):
    cloning = training(tmp_path)
    with torch.no_grad():
        next(cloning.actor.network.parameters()).fill_(torch.nan)
    with raises(FloatingPointError, "iteration 7") as stopped:
        cloning.run(None)
    assert str(tmp_path) not in str(stopped.value)
