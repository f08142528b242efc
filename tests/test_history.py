"""Histories against lists of executed actions, and the paper's equations 2 and 4 of them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.errors import raises, refuses
from tests.toy_env import random_history
from warmprior import GaussianPrior, PastPrior, PreviewPrior, Prior
from warmprior.history import ENTRIES, advance, check_history, cold_history, window_history, without

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]


class Robot:
    """One row's executed actions and last chunk, as Python's own lists."""

    def __init__(self):
        self.executed, self.left = [], []

    def decide(self, chunk, k):
        self.executed += list(chunk[:k])
        self.left = list(chunk[k:])

    def history(self, remembered, length):
        zero = torch.zeros(2)
        real = self.executed[-remembered:]
        forecast = self.left + [zero] * (length - len(self.left))
        return {
            "actions": torch.stack([zero] * (remembered - len(real)) + real),
            "steps": torch.tensor([len(real)]),
            "forecast": torch.stack(forecast),
            "forecast_steps": torch.tensor([len(self.left)]),
        }


def assert_equal(history, expected):
    assert set(history.keys()) == set(ENTRIES) == set(expected.keys())
    for name, value in expected.items():
        assert history[name].dtype == value.dtype, name
        assert torch.equal(history[name], value), name


@given(
    remembered=st.integers(1, 6),
    length=st.integers(1, 8),
    executed=st.lists(st.lists(st.integers(0, 8), min_size=3, max_size=3), min_size=1, max_size=6),
    resets=st.sets(st.tuples(st.integers(0, 5), st.integers(0, 2))),
    seed=st.integers(0, 10**6),
)
def test_any_number_of_executed_actions_and_rows_that_begin_anew(remembered, length, executed, resets, seed):
    """History longer and shorter than predictions; each row executes its own number, none included."""
    g = torch.Generator().manual_seed(seed)
    history, robots = cold_history([3], remembered, length, 2), [Robot() for _ in range(3)]
    for t, numbers in enumerate(executed):
        again = torch.tensor([(t, row) in resets for row in range(3)])
        history = without(history, again)
        robots = [Robot() if new else robot for robot, new in zip(robots, again, strict=True)]
        chunk = torch.randn(3, length, 2, generator=g)
        k = [min(n, remembered, length) for n in numbers]
        before = history.clone(), chunk.clone()
        after = advance(history, chunk, torch.tensor(k)[:, None])
        assert (history == before[0]).all() and torch.equal(chunk, before[1])  # not written into
        history = after
        for row, robot in enumerate(robots):
            robot.decide(chunk[row], k[row])
            assert_equal(history[row], robot.history(remembered, length))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("given_dtype", [torch.float64, torch.float32])
def test_precisions_stay_those_of_the_history(dtype, given_dtype):
    history = cold_history([2], 2, 4, 1, dtype=dtype)
    chunk = torch.rand(2, 4, 1, dtype=given_dtype)
    after = advance(history, chunk, torch.tensor([[1], [2]]))
    for found in (after, without(after, torch.tensor([True, False]))):
        types = {name: value.dtype for name, value in found.items()}
        assert types == {name: value.dtype for name, value in history.items()}
    assert torch.equal(after["forecast"][0, :3], chunk[0, 1:].to(dtype))


def test_withheld_rows_are_those_of_robots_that_did_nothing():
    history = random_history(PreviewPrior(3), 2, 4, cold=0.0)
    rows = torch.rand(2, 4) < 0.5
    found, cold = without(history, rows), cold_history([2, 4], 3, 6, 2)
    assert_equal(found[rows], dict(cold[rows].items()))
    assert_equal(found[~rows], dict(history[~rows].items()))
    history["actions"][0, 0] = float("nan")
    assert not without(history, torch.ones(2, 4, dtype=torch.bool))["actions"].any()


def equation(prior, robot, decided):
    """The mean per position, or None where it is cold."""
    horizon, length = prior.chunk_length, prior.prediction_length
    if isinstance(prior, PastPrior):  # Eq. 2
        return robot.executed[-horizon:] if len(robot.executed) >= horizon else [None] * length
    if isinstance(prior, PreviewPrior) and decided:  # Eq. 4
        return robot.left[:horizon] + [None] * (length - horizon)
    return [None] * length


def assert_mean(source, prior, expected):
    warm = torch.tensor([[mean is not None] for mean in expected])
    assert torch.equal(source.warm, warm) and len(warm) == prior.prediction_length
    loc = torch.stack([torch.zeros(2) if mean is None else mean for mean in expected])
    scale = torch.where(warm, prior.sigma, 1.0).expand_as(loc)
    assert torch.equal(source.loc, loc) and torch.equal(source.scale.expand_as(loc), scale)


@given(
    horizon=st.integers(1, 5),
    executed=st.lists(st.lists(st.integers(0, 5), min_size=3, max_size=3), min_size=1, max_size=8),
    prior_class=st.sampled_from(PRIORS),
    seed=st.integers(0, 10**6),
)
def test_means_at_decisions_are_equations_2_and_4(horizon, executed, prior_class, seed):
    g, prior = torch.Generator().manual_seed(seed), prior_class(horizon)
    length = prior.prediction_length
    history, robots = cold_history([3], horizon, length, 2), [Robot() for _ in range(3)]
    for decided, numbers in enumerate(executed):
        for row, robot in enumerate(robots):
            expected = equation(prior, robot, decided)
            assert_mean(prior.distribution(history[row]), prior, expected)
        chunk, k = torch.randn(3, length, 2, generator=g), [min(n, horizon) for n in numbers]
        history = advance(history, chunk, torch.tensor(k)[:, None])
        for row, robot in enumerate(robots):
            robot.decide(chunk[row], k[row])


def test_histories_that_cannot_be():
    history = cold_history([2], 2, 4, 1)
    for executed in (3, -1):
        with raises(ValueError, executed, 0, 2):
            advance(history, torch.zeros(2, 4, 1), torch.tensor([[0], [executed]]))
    for shape in ((2, 3, 1), (2, 5, 1), (2, 4, 2), (3, 4, 1)):
        with raises(ValueError, "chunk", f"({shape[0]}", "(2, 4, 1)"):
            advance(history, torch.zeros(shape), torch.tensor([[1]]))
    for missing in ENTRIES:
        with raises(KeyError, "GaussianPrior", f"['{missing}']", "ActionHistory", "ActionWindow"):
            GaussianPrior(2).distribution(cold_history([1], 2, 2, 1).exclude(missing))
    for prior, lengths in ((PastPrior(3), (4, 3)), (PastPrior(3), (3, 6)), (PreviewPrior(3), (3, 3))):
        with raises(ValueError, type(prior).__name__, prior.prediction_length, *lengths):
            prior.distribution(cold_history([2], *lengths, 2))
    refuses(lambda: check_history(None, 2, 2, "a robot"), KeyError, "ActionWindow")


def test_a_mean_of_another_shape_or_type():
    class Wrong(PastPrior):
        name = "wrong-for-this-test"

        def mean(self, history):
            return self.change(*super().mean(history))

    try:
        for change, *facts in (
            (lambda loc, warm: (loc[..., :-1, :], warm), "loc", "[4, 2, 2]", "[4, 3, 2]"),
            (lambda loc, warm: (loc[0], warm), "loc", "[3, 2]", "[4, 3, 2]"),
            (lambda loc, warm: (loc, warm[..., :1, :]), "warm", "[4, 1, 1]", "[4, 3, 1]"),
            (lambda loc, warm: (loc, warm.expand_as(loc)), "warm", "[4, 3, 2]", "[4, 3, 1]"),
            *((lambda loc, warm: (loc, warm.float()), "bool"), (lambda loc, warm: loc, "Tensor")),
        ):
            wrong = Wrong(3)
            wrong.change = change
            with raises(ValueError, "Wrong.mean", *facts):
                wrong.distribution(random_history(PastPrior(3), 4))
    finally:
        del Prior.classes["wrong-for-this-test"]


def test_the_parts_of_a_window_that_do_not_fit_are_refused():
    before, steps, target = torch.zeros(3, 2, 1), torch.zeros(3, 1, dtype=torch.int64), torch.zeros(3, 4, 1)
    for wrong in ((before[1:], steps, target), (before, steps[:, 0], target), (before, steps, target[:2])):
        with raises(ValueError, *(str(tuple(value.shape)) for value in wrong)):
            window_history(*wrong, chunk_length=2)
