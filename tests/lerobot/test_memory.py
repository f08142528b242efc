import pytest
import torch

from tests.errors import refuses
from warmprior import PreviewPrior
from warmprior.history import ENTRIES
from warmprior.lerobot.memory import ActionMemory


def chunk(first, length, size=2):
    """Actions that tell their step, from ``first`` on."""
    steps = torch.arange(float(first), first + length)
    return (steps + 100.0 * torch.arange(size)[:, None])[..., None]


def row(history, i=0):
    return [history[name][i].flatten().tolist() for name in ENTRIES]


def executing(prior, count, first=1):
    memory = ActionMemory(prior, 1)
    memory.decide(2)
    memory.record(chunk(first, prior.prediction_length))
    for _ in range(count):
        memory.step()
    return memory


def test_a_history_moves_by_what_was_executed():
    memory = executing(PreviewPrior(3), 2)
    expected = [[0, 1, 2], [2], [3, 4, 5, 6, 0, 0], [4]]
    assert row(memory.decide(2)) == expected
    assert row(memory.decide(2)) == expected  # a decision without a chunk does not count
    memory.record(chunk(11, 6))
    memory.executed(torch.tensor([3, 0]))
    history = memory.decide(2)
    assert row(history) == [[11, 12, 13], [3], [14, 15, 16, 0, 0, 0], [3]]
    assert row(history, 1) == [[0, 101, 102], [2], [111, 112, 113, 114, 115, 116], [6]]


def test_an_episode_that_begins_inside_a_chunk():
    """It executes the rest of the chunk, and has no plan of the old episode."""
    memory = executing(PreviewPrior(4), 1)
    memory.forget(torch.tensor([True, False]))
    assert row(memory._history) == [[0] * 4, [0], [0] * 8, [0]]
    memory.step()
    memory.correct(torch.tensor([[-5.0], [-6.0]]))  # of the rest
    memory.step()
    history = memory.decide(2)
    assert row(history) == [[0, 0, -5, 3], [2], [0] * 8, [0]]
    assert row(history, 1) == [[0, 101, -6, 103], [3], [104, 105, 106, 107, 108, 0, 0, 0], [5]]
    warm = PreviewPrior(4).distribution(history).warm
    assert warm[:, :4].all(1).flatten().tolist() == [False, True]
    # From its own first chunk on it has a plan as others have.
    memory.record(chunk(21, 8))
    memory.step()
    assert row(memory.decide(2)) == [[0, -5, 3, 21], [3], [22, 23, 24, 25, 26, 27, 28, 0], [7]]


@pytest.mark.parametrize("steps", [1.5, torch.tensor([1.0, 2.5]), torch.tensor([1, 1, 1])])
def test_counts_and_corrections_that_cannot_be(steps):
    memory = executing(PreviewPrior(3), 1)
    refuses(lambda: memory.executed(steps), ValueError, "executed_steps")
    refuses(lambda: memory.correct(torch.zeros(2, 2)), ValueError, "the executed action")


def test_actions_are_expressed_at_the_present_state_and_nothing_becomes_one():
    memory = executing(PreviewPrior(3), 2)
    history = memory.decide(2, move=lambda actions: actions.double() - 0.5)
    assert row(history) == [[0, 0.5, 1.5], [2], [2.5, 3.5, 4.5, 5.5, 0, 0], [4]]
    assert history["actions"].dtype == history["forecast"].dtype == torch.float32
    # What was moved once is moved on from there.
    memory.record(chunk(11, 6))
    memory.step()
    assert row(memory.decide(2, move=lambda actions: actions - 1.0))[0] == [-0.5, 0.5, 10]
    memory.forget(torch.tensor([True, True]))
    history = memory.decide(2, move=lambda actions: actions - 1.0)
    assert not any(history[name].any() for name in ENTRIES)
