"""Several processes train what one would: the same gradients, weights, files, and errors for all."""

from __future__ import annotations

import time

import pytest
import torch

from tests.together import together
from tests.training.cloning_parts import weights
from tests.training.data_parallel_parts import (
    CASES,
    STEPS,
    cloning,
    dies,
    gradients,
    stopped_at,
    trained,
    whole,
)
from warmprior.training.checkpoint import load_state


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What two processes left."""
    folder = tmp_path_factory.mktemp("together")
    for name in ("one then two", "two then one"):
        (folder / name).mkdir()
    stopped_at(folder / "one then two", 12)
    together(whole, folder)
    return folder


@pytest.fixture(scope="module")
def firsts(folder):
    return [torch.load(folder / f"first {number}.pt") for number in range(2)]


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_one_process(firsts, tmp_path, case):
    loss, expected, _ = gradients(tmp_path, case)
    tolerance = {"rtol": 0, "atol": 1e-6}
    if (
        case == "bf16"
    ):  # products are rounded to eight bits, alike in a batch of another size or not
        tolerance = {"rtol": 0, "atol": 2e-2 * max(g.abs().max() for g in expected.values())}
    for first in firsts:
        theirs, found, _ = first[case]
        assert found.keys() == expected.keys()
        torch.testing.assert_close(theirs, loss, rtol=0, atol=tolerance["atol"])
        for name, gradient in expected.items():
            torch.testing.assert_close(found[name], gradient, **tolerance, msg=name)
    assert any(gradient.abs().max() > 1e-3 for gradient in expected.values())
    if case == "learning prior":
        assert expected["prior.trust"].abs().max() > 1e-3
    assert all(torch.equal(firsts[0][case][1][n], firsts[1][case][1][n]) for n in expected)


def test_a_mean_of_the_processes_own_means_would_be_another(tmp_path):
    """The halves of the batch are padded unequally: the test above would notice."""
    part = cloning(tmp_path, "plain")
    counts = [int((~part.replay_buffer.sample()["action_is_pad"])[r::2].sum()) for r in range(2)]
    assert counts[0] != counts[1]


@pytest.mark.parametrize("case", CASES)
def test_windows_are_shared_out(firsts, tmp_path, case):
    """Each window of the batch is evaluated by one process, and so is each that is distilled."""
    _, _, points = gradients(tmp_path, case)
    for call, whole_batch in enumerate(points):
        for number in range(2):
            torch.testing.assert_close(firsts[number][case][2][call], whole_batch[number::2])
    assert len(points) == len(firsts[0][case][2]) == (2 if "distilled" in case else 1)
    assert not torch.equal(points[0][::2][:7], points[0][1::2])


@pytest.mark.parametrize("case", [case for case in CASES if case != "bf16"])
def test_weights_are_those_of_one_process(folder, tmp_path, case):
    trained(tmp_path, case)
    (mine, losses), (theirs, their_losses) = (
        torch.load(f / f"{case}.pt") for f in (tmp_path, folder)
    )
    assert mine.keys() == theirs.keys()
    for name, value in mine.items():
        torch.testing.assert_close(theirs[name], value, rtol=0, atol=1e-5, msg=name)
    torch.testing.assert_close(their_losses, losses, rtol=1e-5, atol=0)
    names = sorted(path.name for path in (folder / case).iterdir())
    assert names == ["policy_000020", "state.safetensors"]


def test_another_number_of_processes_goes_on(folder, tmp_path):
    (undisturbed, losses) = torch.load(folder / "plain.pt")
    assert load_state(folder / "two then one" / "plain" / "state.safetensors")[1]["iteration"] == 10
    trained(folder / "two then one", "plain")
    for name in ("two then one", "one then two"):
        found, their_losses = torch.load(folder / name / "plain.pt")
        for key, value in undisturbed.items():
            torch.testing.assert_close(found[key], value, rtol=0, atol=1e-5, msg=key)
        torch.testing.assert_close(their_losses, losses, rtol=1e-5, atol=0)


def test_all_learn_of_nan_in_one(folder):
    for number in range(2):
        assert "the loss became nan" in (folder / f"diverged {number}").read_text()
    assert not (folder / "diverges" / "policy_000020").exists()


def test_what_several_processes_cannot_train(folder):
    for number in range(2):
        small, idle = (folder / f"refused {number}").read_text().splitlines()
        assert "--batch-size 1 has fewer windows than there are processes, 2" in small
        assert "network.idle has no part in the loss" in idle and "freeze it" in idle


def test_a_killed_process_ends_the_others_and_the_state_stays(tmp_path):
    context = together(dies, tmp_path, join=False)
    begun = time.monotonic()
    for process in context.processes:
        process.join(60)
    assert time.monotonic() - begun < 60
    assert [process.exitcode for process in context.processes] == [0, -9]
    assert "has ended, or does not answer" in (tmp_path / "told").read_text()
    again = cloning(tmp_path / "plain", "plain")
    assert again.iteration == 10
    again.run(None)
    whole_run = cloning(tmp_path / "whole", "plain")
    whole_run.run(None)
    assert again.iteration == STEPS.iterations
    for name, value in weights(whole_run).items():
        torch.testing.assert_close(weights(again)[name], value, rtol=0, atol=1e-5)
