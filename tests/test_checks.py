import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from warmprior.checks import check_between, check_keys, check_shape, check_share


@pytest.mark.parametrize("value", [True, "0.5", None, np.array([0.5, 0.5]), float("nan")])
def test_shares_are_numbers(value):
    refuses(lambda: check_share(ema_rate=value), ValueError, "ema_rate")
    refuses(lambda: check_between(0, 1, ema_rate=value), ValueError, "ema_rate")


@pytest.mark.parametrize("shape", [(), (3, 3), (2, 3, 4)])
def test_named_dimensions_have_any_size_but_are_there(shape):
    check_shape("turns", torch.zeros(5, 3, 3), ("arms", 3, 3))
    with raises(ValueError, "turns", str(list(shape)), "[arms, 3, 3]"):
        check_shape("turns", torch.zeros(shape), ("arms", 3, 3))


def test_a_nested_key_under_a_tensor_is_missing():
    place = TensorDict({"history": torch.zeros(2), "a": {"b": torch.zeros(2)}}, [2])
    check_keys(place, iter([("a", "b"), "history"]), "It")
    with raises(KeyError, "It", "('history', 'forecast')", "append"):
        check_keys(place, iter([("a", "b"), ("history", "forecast")]), "It", ": append it")
