"""What numbers and tensors have to be, and which of them is named."""

from __future__ import annotations

import pytest
import torch

from warmprior.rl.checks import check_counts, check_finite, check_positive


def test_the_first_bad_number_is_named():
    check_counts(updates=1, steps=2)
    check_positive(delta=0.5)
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        check_counts(updates=1, steps=0, rows=0)
    for value in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=f"tau must be a finite number > 0, got {value}"):
            check_positive(delta=0.5, tau=value)


def test_tensors_that_are_not_finite_are_named_but_not_hundreds_of_them():
    fine = {"whole": torch.tensor(3), "flag": torch.tensor([True]), "none": torch.zeros(0)}
    check_finite(fine)
    wrong = {k: torch.tensor([0.0, torch.inf]) for k in "abcd"}
    with pytest.raises(FloatingPointError, match=r"^NaN or infinity in a, b, c, d: the training"):
        check_finite(fine | wrong)
    more = wrong | {("next", "reward"): torch.tensor(torch.nan), "f": torch.tensor(torch.nan)}
    with pytest.raises(FloatingPointError, match=r"in a, b, c, d and 2 more: the environment$"):
        check_finite(more, "the environment")
