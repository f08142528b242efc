from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lab.statistics import bootstrap_ratio, top_k_mean

rates = st.lists(st.floats(0, 1), min_size=1, max_size=8)


@given(rates, st.integers(1, 10))
def test_top_k_mean_is_the_largest_mean_of_any_k(values, k):
    from itertools import combinations

    k_used = min(k, len(values))
    brute = max(sum(c) / k_used for c in combinations(values, k_used))
    assert top_k_mean(values, k) == pytest.approx(brute)


def test_bootstrap_agrees_with_the_delta_method():
    """Independent groups of one: the interval is the ratio plus and minus 1.96 standard errors."""
    generator = torch.Generator().manual_seed(0)
    x = 2.0 + 0.3 * torch.randn(4_000, generator=generator).double()
    y = 3.0 + 0.5 * torch.randn(4_000, generator=generator).double() + 0.2 * x
    ratio, low, high = bootstrap_ratio(x, y, torch.arange(4_000), generator=generator)
    expected = float(x.mean() / y.mean())
    error = float((x - expected * y).std() / y.mean()) / math.sqrt(4_000)
    assert ratio == pytest.approx(expected)
    assert high - low == pytest.approx(2 * 1.96 * error, rel=0.1)
    assert (high + low) / 2 == pytest.approx(expected, abs=0.3 * error)


def test_bootstrap_draws_whole_groups():
    """Repeating every observation inside its group tells nothing new; fresh groups would."""
    generator = torch.Generator().manual_seed(1)
    x, y = torch.rand(2, 30, generator=generator).double() + 0.5
    groups = torch.arange(30)

    def width(*args):
        _, low, high = bootstrap_ratio(*args, generator=torch.Generator().manual_seed(2))
        return high - low

    once = width(x, y, groups)
    repeated = width(x.repeat(9), y.repeat(9), groups.repeat(9))
    assert repeated == pytest.approx(once)
    assert width(x.repeat(9), y.repeat(9), torch.arange(270)) < 0.5 * once
