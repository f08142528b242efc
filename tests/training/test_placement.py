import pytest
import torch

from tests.errors import refuses
from warmprior.training.placement import Prefetch


def numbers(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (lambda: torch.rand(3, generator=generator)), generator


@pytest.mark.parametrize("stop", [0, 4])
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

    refuses(lambda: Prefetch(failing, torch.Generator())(), OSError, "the disk is gone")
