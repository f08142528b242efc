import time

import pytest
import torch

from tests.states import same
from tests.together import together
from tests.training.cloning_parts import CONFIG
from tests.training.data_parallel_parts import CASES, CLIPPED, STEPS, cloning, dies, whole
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("together")
    for name in ("one", "two"):
        (folder / name).mkdir()
    together(whole, folder)
    return folder


def both(folder, name):
    return [torch.load(folder / f"{name} {number}.pt") for number in range(2)]


@pytest.mark.parametrize("case", CASES)
def test_each_draws_windows_of_its_own_and_all_take_one_step(folder, case):
    (loss, gradients, points), (other_loss, other_gradients, others) = (
        first[case] for first in both(folder, "first")
    )
    assert not torch.equal(loss, other_loss) and same(gradients, other_gradients)
    assert any(gradient.abs().max() > 1e-3 for gradient in gradients.values())
    assert points[0].shape == others[0].shape and len(points[0]) == CONFIG.batch_size // 2
    assert not torch.isclose(points[0], others[0]).all(-1).all(-1).any()


def test_the_mean_of_all_gradients_is_clipped(folder):
    """Means of clipped ones would be shorter, because their directions differ."""
    for first in both(folder, "first"):
        _, gradients, _ = first["clipped"]
        _, whole, _ = first["learning prior"]
        length = torch.cat([g.flatten() for g in whole.values()]).norm()
        assert length > 2 * CLIPPED
        for name, gradient in whole.items():
            torch.testing.assert_close(gradients[name], CLIPPED * gradient / length, rtol=1e-4, atol=1e-7)


def test_the_windows_of_the_others_count(folder, tmp_path):
    """The leader's are those that it would draw alone."""
    alone = cloning(tmp_path, "plain", batch_size=STEPS.batch_size // 2)
    loss = alone.step()
    its_loss, gradients, _ = both(folder, "first")[0]["plain"]
    own = {name: p.grad for name, p in alone.update.trained.named_parameters()}
    torch.testing.assert_close(loss, its_loss)
    learns = [name for name, gradient in gradients.items() if gradient.any()]
    assert learns and not any(torch.allclose(own[name], gradients[name]) for name in learns)


@pytest.mark.parametrize("case", CASES)
def test_weights_are_equal_and_the_leader_alone_writes(folder, case):
    (mine, _), (theirs, _) = both(folder, case)
    assert same(mine, theirs)
    names = sorted(path.name for path in (folder / case).iterdir())
    assert names == ["policy_000020", "state.safetensors"]
    assert load_state(folder / case / "state.safetensors")[1]["iteration"] == STEPS.iterations
    if case == "plain":
        kept = load_policy(folder / case / "policy_000020").network.state_dict()
        averaged = {n.removeprefix("ema.module.network."): v for n, v in mine.items()}
        assert all(torch.equal(value, averaged[name]) for name, value in kept.items())


def test_a_stopped_training_goes_on(folder):
    (mine, losses), (theirs, _) = both(folder / "one", "plain")
    assert same(mine, theirs)
    assert [iteration for iteration, _ in losses] == [10, 20]
    assert losses[0] == both(folder, "plain")[0][1][0]
    again, _ = both(folder / "two", "plain")[0]
    assert same(mine, again)


def test_all_learn_of_nan_in_one(folder):
    for number in range(2):
        assert "the loss" in (folder / f"diverged {number}").read_text()
    assert not (folder / "diverges" / "policy_000020").exists()


def test_a_killed_process_ends_the_others_and_the_state_stays(tmp_path):
    context = together(dies, tmp_path, join=False)
    begun = time.monotonic()
    for process in context.processes:
        process.join(60)
    assert time.monotonic() - begun < 60
    assert [process.exitcode for process in context.processes] == [1, -9]
    again = cloning(tmp_path / "plain", "plain")
    assert again.iteration == 10
    again.run(None)  # one process alone
    assert again.iteration == STEPS.iterations
