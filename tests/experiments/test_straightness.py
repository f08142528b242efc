"""Straightness of flows and its table, on fields whose ratios are known."""

from __future__ import annotations

import math
import sys

import pytest
import torch

from tests.diagnostics.fields import policy
from tests.diagnostics.test_shared_observations import H, steps
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import SharedObservations

pytest.importorskip("tyro")

from warmprior.experiments import Method, Row, curvature_table
from warmprior.experiments import straightness as by_seed


def straightness(policies, *args, **options):
    """Of the policies of seeds 0, 1, ..., by the name of their method."""
    given = {Method(n, H): dict(enumerate(group)) for n, group in policies.items()}
    return by_seed(given, *args, **options)


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
    assert rows[0].measures["ratio"] is None
    text = curvature_table(rows, {"task": "lift", "style": "ph"}, source="a test")
    assert "| Lift-PH, whole prediction, training mean | no motion |" in text
    assert "20 observations of a test, one seed" in text


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
    rows = {(r["prior"], r["seed"], r["mean"]): r for r in straightness(policies, shared())}
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

    # The paper's numbers are for H = 8 and relative to the Gaussian source.
    own = curvature_table(list(rows.values()), {"task": "square", "style": "mh"}, source="a test")
    assert "paper (official data)" not in own
    eight = [Row({**row.facts, "chunk": 8}, row.measures) for row in rows.values()]
    warm = [row for row in eight if row["prior"] != "gaussian"]
    assert "paper (official" not in curvature_table(
        warm, {"task": "square", "style": "mh"}, source=""
    )
    text = curvature_table(eight, {"task": "square", "style": "mh"}, source="a test")
    assert "| Square-MH, executed H, training mean | 1.000 | 0.625" in text
    assert "| Square-MH, paper (official data) | 1.000 | 0.705 | 0.559 |" in text
    assert "20 observations of a test, averaged over 2 training seeds" in text
    images = {"task": "square", "style": "mh", "obs": "image"}
    text = curvature_table(eight, images, source="a test")
    assert "| Square-MH, image observations, executed H" in text and "paper (off" not in text
    unknown = curvature_table(list(rows.values()), {"task": "lift", "style": "ph"}, source="a test")
    assert "paper (official data)" not in unknown


def test_rows_tell_the_training_seeds(monkeypatch):
    small_loss(monkeypatch)
    policies = {Method("gaussian", H): {4: policy(turning(2.0)), 3: policy(turning(1.0))}}
    rows = {row["seed"]: row["kappa"] for row in by_seed(policies, shared(), n_steps=10)}
    assert set(rows) == {3, 4, None}
    assert rows[4] == pytest.approx(4 * rows[3], rel=1e-4)  # each that of its own policy


def test_an_average_over_seeds_leaves_none_out(monkeypatch):
    small_loss(monkeypatch)
    policies = {
        "gaussian": [policy(turning(2.0)), policy(turning(2.0))],
        "past": [policy(turning(0.0), PastPrior(H)), policy(turning(1.0), PastPrior(H))],
    }
    with pytest.warns(UserWarning, match="do not move"):
        rows = {(r["prior"], r["seed"], r["mean"]): r for r in straightness(policies, shared())}
    assert rows["past", 1, "training"]["ratio_executed"] == pytest.approx(1 / 4, rel=1e-4)
    for seed in (0, None):
        row = rows["past", seed, "training"]
        # Nor is an exact Euler step from nowhere to nowhere a merit.
        assert row.measures["ratio_executed"] is None and row.measures["ratio_one_step"] is None
    with pytest.warns(UserWarning, match="do not move"):  # the baseline, now
        rows = straightness(dict(reversed(policies.items())), shared())
    base = [row for row in rows if (row["prior"], row["seed"]) == ("gaussian", 0)]
    assert len(base) == 1 and base[0].measures["ratio_one_step"] is None


def test_the_noise_of_the_earlier_prediction_is_not_that_of_the_path(monkeypatch):
    """A field of 0 predicts mean + noise; from the mean it makes, the next source starts."""
    small_loss(monkeypatch)
    starts = []

    def field(t, a, o):
        if bool((t == 0).all()):
            starts.append(a.clone())
        return torch.ones_like(a)

    observations = shared(count=None)
    demonstrated = PastPrior(H).distribution(observations.windows(PastPrior(H))["history"]).loc
    straightness({"past": [policy(field, PastPrior(H, sigma=1.0))]}, observations, n_steps=2)
    # At time 0: the earlier prediction, then path and one step at either mean.
    earlier, at_training, at_deployed = starts[0], starts[1], starts[3]
    noise = at_training - demonstrated
    assert torch.equal(starts[1], starts[2]) and torch.equal(starts[3], starts[4])
    mean = earlier + 1.0  # what the field makes of it
    torch.testing.assert_close(at_deployed - mean, noise, atol=1e-5, rtol=0)
    before = observations.windows(PastPrior(H), offset=H)["history"]
    previous = earlier - PastPrior(H).distribution(before).loc
    both = torch.stack([noise.flatten(), previous.flatten()])
    assert abs(float(torch.corrcoef(both)[0, 1])) < 0.25


def test_the_bound_is_that_of_the_mean_it_stands_beside(monkeypatch):
    small_loss(monkeypatch)
    far = {"past": [policy(lambda t, a, o: torch.full_like(a, 100.0), PastPrior(H))]}
    bounds = {row["mean"]: row["bound"] for row in straightness(far, shared(), n_steps=4)}
    assert bounds["deployed"] > 1_000 > bounds["training"]


def test_a_path_that_diverges_names_its_policy():
    policies = {"past": [policy(lambda t, a, o: a * math.inf, PastPrior(H))]}
    with pytest.raises(FloatingPointError, match=r"past, sigma 0\.5, H 3, training mean: 20 of 20"):
        straightness(policies, shared(), n_steps=4)


def test_one_seed_one_result(monkeypatch):
    small_loss(monkeypatch)
    policies = {"gaussian": [policy(lambda t, a, o: -a, GaussianPrior(H))]}
    assert straightness(policies, shared(), seed=3) == straightness(policies, shared(), seed=3)
    other = straightness(policies, shared(), seed=4)
    assert straightness(policies, shared(), seed=3)[0]["kappa"] != other[0]["kappa"]


def test_bad_input_is_named():
    base = policy(turning(1.0))
    with pytest.raises(ValueError, match="same training seeds"):
        straightness({"gaussian": [base], "past": [base, base]}, shared())
    with pytest.raises(ValueError, match="one chunk length only"):
        straightness({"past": [policy(turning(1.0), PastPrior(H + 1))]}, shared())
    with pytest.raises(ValueError, match="none of these policies has a flow"):
        straightness({"regression": [policy(turning(1.0))]}, shared())


def test_policies_without_a_flow_are_left_out(monkeypatch):
    small_loss(monkeypatch)
    policies = {
        "regression": [policy(turning(5.0))],
        "gaussian": [policy(turning(2.0))],
        "past": [policy(turning(1.0), PastPrior(H))],
    }
    rows = straightness(policies, shared())
    # The baseline is the first of those with a flow.
    found = {(row["prior"], row["mean"]): row["ratio"] for row in rows}
    assert found["gaussian", "training"] == 1.0
    assert found["past", "training"] == pytest.approx(1 / 4, rel=1e-4)
    assert {name for name, _ in found} == {"gaussian", "past"}


def test_the_ratio_of_linear_fields_has_the_closed_form(monkeypatch):
    """v = -rate * a: v_k = -rate * (1 - rate/N)^k a0 at step k, from the same sources a0."""
    small_loss(monkeypatch)
    fields = {"gaussian": [policy(lambda t, a, o: -a)], "history": [policy(lambda t, a, o: -2 * a)]}
    rows = {row["prior"]: row for row in straightness(fields, shared(), draws=2)}
    steps = torch.arange(100, dtype=torch.float64)
    kappas = [(rate * (1 - rate / 100) ** steps).var(correction=0) for rate in (1.0, 2.0)]
    assert rows["gaussian"]["ratio"] == 1.0
    assert rows["history"]["ratio"] == pytest.approx(float(kappas[1] / kappas[0]), rel=1e-3)
