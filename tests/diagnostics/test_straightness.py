"""Curvature tables, on fields whose ratios are known."""

from __future__ import annotations

import math
import sys

import pytest
import torch

from tests.diagnostics.fields import policy
from tests.diagnostics.test_held_out import H, steps
from warmprior import GaussianPrior, PastPrior, PreviewPrior, RegressionPrior
from warmprior.diagnostics import SharedObservations, curvature_table, straightness


def turning(speed):
    """v = speed * cos(pi t / 2) on every coordinate: kappa is proportional to speed squared."""
    return lambda t, a, o: speed * torch.cos(torch.pi / 2 * t) + torch.zeros_like(a)


def shared(count=20):
    data = steps([9] * 8)
    data["action"] = data["action"] / len(data)
    return SharedObservations(data, H, count=count, generator=torch.Generator().manual_seed(0))


@pytest.mark.filterwarnings("ignore:.*has not learnt to move")
def test_a_field_worse_than_none_is_flagged():
    rows = straightness({"gaussian": [policy(turning(9.0))]}, shared(), n_steps=10)
    assert math.isnan(rows[0]["ratio"])


def small_loss(monkeypatch):
    # The fields here are no fits of the data; that check has its own tests.
    module = sys.modules["warmprior.diagnostics.curvature"]  # its function has the same name
    monkeypatch.setattr(module, "NO_MOTION", math.inf)


def test_ratios_follow_from_the_fields(monkeypatch):
    small_loss(monkeypatch)
    policies = {
        "gaussian": [policy(turning(2.0)), policy(turning(2.0))],
        "past": [policy(turning(1.0), PastPrior(H)), policy(turning(2.0), PastPrior(H))],
        "preview": [policy(turning(1.0), PreviewPrior(H))] * 2,
    }
    rows = {(r["policy"], r["seed"], r["mean"]): r for r in straightness(policies, shared())}
    assert {mean for name, _, mean in rows if name == "gaussian"} == {"training"}
    assert rows["past", 0, "training"]["ratio"] == pytest.approx(1 / 4, rel=1e-4)
    assert rows["past", 1, "deployed"]["ratio"] == pytest.approx(1.0, rel=1e-4)
    assert rows["past", None, "training"]["ratio"] == pytest.approx(5 / 8, rel=1e-4)
    # A prediction of 2H counts up to twice when it counts whole; the executed half does not.
    inside = [
        int((~shared().windows(p)["action_is_pad"]).sum())
        for p in (PreviewPrior(H), GaussianPrior(H))
    ]
    assert 1.3 < inside[0] / inside[1] < 2.0
    expected = inside[0] / inside[1] / 4
    assert rows["preview", None, "training"]["ratio"] == pytest.approx(expected, rel=1e-4)
    assert rows["preview", None, "training"]["ratio_executed"] == pytest.approx(1 / 4, rel=1e-4)
    # All paths bend alike: relative to its speed every field is as curved as the baseline.
    assert all(r["ratio_relative"] == pytest.approx(1.0, rel=1e-4) for r in rows.values())
    assert all(r["ratio_low"] <= r["ratio"] + 1e-9 <= r["ratio_high"] + 2e-9 for r in rows.values())
    assert rows["gaussian", 0, "training"]["bound"] > rows["past", 0, "training"]["bound"]

    text = curvature_table(list(rows.values()), task="square", data="mh", source="a test")
    assert "| Square-MH, executed H, training mean | 1.000 | 0.625" in text
    assert "| Square-MH, paper (official data) | 1.000 | 0.705 | 0.559 |" in text
    assert "20 observations of a test, averaged over 2 training seeds" in text
    unknown = curvature_table(list(rows.values()), task="lift", data="ph", source="a test")
    assert "paper (official data)" not in unknown


def test_one_seed_one_result(monkeypatch):
    small_loss(monkeypatch)
    policies = {"gaussian": [policy(lambda t, a, o: -a, GaussianPrior(H))]}
    assert straightness(policies, shared(), seed=3) == straightness(policies, shared(), seed=3)
    other = straightness(policies, shared(), seed=4)
    assert straightness(policies, shared(), seed=3)[0]["kappa"] != other[0]["kappa"]


def test_bad_input_is_named():
    base = policy(turning(1.0))
    with pytest.raises(ValueError, match="same number of training seeds"):
        straightness({"a": [base], "b": [base, base]}, shared())
    with pytest.raises(ValueError, match="one chunk length only"):
        straightness({"a": [policy(turning(1.0), PastPrior(H + 1))]}, shared())
    with pytest.raises(ValueError, match="no path"):
        straightness({"a": [policy(turning(1.0), RegressionPrior(H))]}, shared())
