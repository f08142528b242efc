"""Peers: their sizes, their losses on the same windows, and what happens where one is missing."""

from __future__ import annotations

import json

import peers
import pytest
import torch
from tensordict import TensorDict

from warmprior import GaussianPrior, window_replay_buffer

SIZE = 1.5e6


@pytest.fixture(scope="module")
def batch():
    data = peers.steps(4, 50)
    return window_replay_buffer(data, GaussianPrior(peers.H), batch_size=8).sample()


@pytest.mark.parametrize("name", peers.PEERS)
def test_all_learn_from_the_same_windows(name, batch):
    for package in peers.PEERS[name][1]:
        pytest.importorskip(package)
    torch.manual_seed(0)
    peer = peers.PEERS[name][0](SIZE, "cpu")
    assert 0.6 * SIZE < peer.parameters < 1.6 * SIZE
    before = [p.detach().clone() for p in peer.module.parameters() if p.requires_grad]
    step = peers.training_step(peer, lambda: batch, "cpu")
    step()
    after = [p for p in peer.module.parameters() if p.requires_grad]
    moved = [not torch.equal(a, b) for a, b in zip(after, before, strict=True)]
    assert sum(moved) > 0.8 * len(moved)
    # Every evaluation passes through each layer of the network once.
    kinds = torch.nn.Conv1d if "diffusion" in name else torch.nn.Linear
    layers = [m for n, m in peer.module.named_modules() if isinstance(m, kinds) and "text" not in n]
    peer.module.eval()
    with torch.no_grad():
        for nfe in (1, 3):
            calls: list[None] = []
            hook = layers[-1].register_forward_hook(lambda *_, calls=calls: calls.append(None))
            peer.decide(nfe)
            hook.remove()
            assert len(calls) == nfe


def test_operations_are_counted():
    layer = torch.nn.Linear(5, 7, bias=False)
    peer = peers.Peer("", layer, lambda batch: layer(batch["x"]), int, 1)
    data = TensorDict({"x": torch.randn(3, 5)}, [3])
    # Forward, and the gradient of the weights; that of the input is not asked for.
    assert peers.flop_of(peer, data) == 2 * (2 * 3 * 5 * 7)


def test_the_script(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(peers, "find_spec", lambda name: None if name == "diffusers" else name)
    argv = ["--parameters", "3e4", "--batch-size", "4", "--repeats", "1", "--out", str(tmp_path)]
    assert peers.main(argv) == 0
    said = capsys.readouterr().out
    assert "lerobot_diffusion: skipped, needs diffusers" in said
    rows = json.loads((tmp_path / "peers.json").read_text())["rows"]
    assert [row["policy"].split(":")[0] for row in rows] == ["warmprior", "warmprior", "torchrl"]
    assert all(row["samples_per_second"] > 0 for row in rows)
    assert (tmp_path / "peers.png").stat().st_size > 10_000
