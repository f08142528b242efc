"""Data beside the network or behind it, and batches that are gathered ahead without losing a draw."""

from __future__ import annotations

import threading

import pytest
import torch

from tests.training.cloning_parts import CONFIG, actor_for, dataset, same, training, weights
from warmprior.training import placement
from warmprior.training.checkpoint import load_state
from warmprior.training.placement import Prefetch, placed


def numbers(seed=0):
    """A source of batches and its generator."""
    generator = torch.Generator().manual_seed(seed)
    return (lambda: torch.rand(3, generator=generator)), generator


def test_batches_are_those_of_the_source():
    sample, _ = numbers()
    expected = [sample() for _ in range(5)]
    batches = Prefetch(*numbers())
    assert all(torch.equal(batches(), value) for value in expected)


def test_the_next_batch_is_drawn_by_another_thread_meanwhile():
    drawn, threads = threading.Event(), []
    sample, generator = numbers()

    def telling():
        threads.append(threading.current_thread())
        if len(threads) == 2:
            drawn.set()
        return sample()

    batches = Prefetch(telling, generator)
    batches()
    assert drawn.wait(10)  # though it was not asked for
    assert threading.main_thread() not in threads
    batches.close()
    assert not any(thread.is_alive() for thread in threads)


@pytest.mark.parametrize("stop", [0, 1, 4])
def test_no_draw_is_lost_or_doubled(stop):
    sample, _ = numbers()
    expected = [sample() for _ in range(8)]
    first = Prefetch(*numbers())
    for _ in range(stop):
        first()
    state = first.state()
    second = Prefetch(*numbers(seed=5))
    second()
    second.restore(state)
    assert all(torch.equal(second(), value) for value in expected[stop:])
    first.close()  # and goes on itself
    assert all(torch.equal(first(), value) for value in expected[stop:])


def test_an_error_of_the_thread_is_told_where_the_batch_is_asked_for():
    def failing():
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone"):
        Prefetch(failing, torch.Generator())()


@pytest.mark.parametrize("stop", [8, 23])
def test_stopping_changes_nothing(tmp_path, stop):
    whole = training(tmp_path / "whole", prefetch=True)
    whole.run(None)
    part = training(tmp_path / "part", prefetch=True)
    take = part.step

    def step():
        if part.iteration == stop:
            raise KeyboardInterrupt
        return take()

    part.step = step
    with pytest.raises(KeyboardInterrupt):
        part.run(None)
    again = training(tmp_path / "part", prefetch=True)
    assert again.iteration == stop // 7 * 7
    again.run(None)
    assert same(weights(again), weights(whole)) and again.losses == whole.losses
    one, two = (load_state(tmp_path / n / "state.safetensors")[0] for n in ("whole", "part"))
    assert same(one, two) and "rng/windows" in one
    assert not [t for t in threading.enumerate() if t.name.startswith("prefetch")]


def test_data_that_moved_to_the_device_go_on(tmp_path):
    """And back: with other draws, but from the same weights."""
    part = training(tmp_path, prefetch=True)
    for _ in range(7):
        part.step()
    part._save()
    plain = training(tmp_path)
    assert plain.iteration == 7
    plain.run(None)
    assert "rng/windows" not in load_state(tmp_path / "state.safetensors")[0]
    assert training(tmp_path, prefetch=True).iteration == CONFIG.iterations


@pytest.mark.parametrize(("free", "fits"), [(4.1, True), (1.9, False)])
def test_data_go_to_the_gpu_where_they_fit(monkeypatch, free, fits):
    """Half of what is free is left to the network."""
    data = dataset()
    moved = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(free * data.bytes()), 10**12))
    monkeypatch.setattr(type(data), "to", lambda self, device: moved.append(device) or "moved")
    assert placement.DEVICE_SHARE == 0.5
    assert placed(data, "cuda") == "moved" if fits else placed(data, "cuda") is data
    assert moved == ([torch.device("cuda")] if fits else [])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_data_behind_a_network_on_the_gpu(tmp_path):
    cloning = training(tmp_path, actor=actor_for().to("cuda"))
    cloning.run(None)
    assert "rng/windows" in load_state(tmp_path / "state.safetensors")[0]
    assert all(torch.isfinite(value).all() for value in weights(cloning).values())
