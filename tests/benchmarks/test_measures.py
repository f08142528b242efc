"""What is measured of policies: straightness on fields whose ratios are known, and memory."""

import math
import sys
from types import SimpleNamespace

import pytest
import torch

from lab.measures import straightness as measures
from lab.methods.methods import Method
from lab.running.measuring import measure
from tests.benchmarks.drift import ACTION_DIM, OBSERVATION_DIM, task
from tests.diagnostics.fields import Field, policy
from tests.diagnostics.test_shared_observations import H, steps
from warmprior import GaussianPrior, PastPrior, PreviewPrior, WarmPriorActor, keys
from warmprior.diagnostics import SharedObservations
from warmprior.training import NetworkOptions


def straightness(policies, *args, **options):
    """Rows of the policies of seeds 0, 1, ..., by prior, seed and mean."""
    given = {Method(n, H): dict(enumerate(group)) for n, group in policies.items()}
    rows = measures.straightness(given, *args, **options)
    return {(row["prior"], row["seed"], row["mean"]): row for row in rows}


def turning(speed):
    """v = speed * cos(pi t / 2) on every coordinate: kappa is proportional to speed squared."""
    return lambda t, a, o: speed * torch.cos(torch.pi / 2 * t) + torch.zeros_like(a)


def shared(count=20):
    data = steps([9] * 8)
    data["action"] = data["action"] / len(data)
    whole = SharedObservations(data, H)
    return whole.subset(
        torch.randperm(len(whole), generator=torch.Generator().manual_seed(0))[:count].sort()[0]
    )


@pytest.fixture
def small_loss(monkeypatch):
    # The fields here are no fits of the data; that check has its own tests.
    module = sys.modules["warmprior.diagnostics.curvature"]  # its function has the same name
    monkeypatch.setattr(module, "NO_MOTION", math.inf)


def test_ratios_follow_from_the_fields(small_loss):
    policies = {
        "regression": [policy(turning(5.0))] * 2,  # no flow: the next one is the baseline
        "gaussian": [policy(turning(2.0)), policy(turning(2.0))],
        "past": [policy(turning(1.0), PastPrior(H)), policy(turning(2.0), PastPrior(H))],
        "preview": [policy(turning(1.0), PreviewPrior(H))] * 2,
    }
    rows = straightness(policies, shared())
    assert {name for name, *_ in rows} == {"gaussian", "past", "preview"}
    assert {mean for name, _, mean in rows if name == "gaussian"} == {"training"}
    assert rows["gaussian", 0, "training"]["ratio"] == 1.0
    assert rows["past", 0, "training"]["ratio"] == pytest.approx(1 / 4, rel=1e-4)
    assert rows["past", 1, "deployed"]["ratio"] == pytest.approx(1.0, rel=1e-4)
    assert rows["past", None, "training"]["ratio"] == pytest.approx(5 / 8, rel=1e-4)
    # A prediction of 2H counts up to twice when it counts whole; the executed half does not.
    inside = [int((~shared().windows(p)["action_is_pad"]).sum()) for p in (PreviewPrior(H), GaussianPrior(H))]
    assert 1.3 < inside[0] / inside[1] < 2.0
    both = rows["preview", None, "training"]
    assert both["ratio"] == pytest.approx(inside[0] / inside[1] / 4, rel=1e-4)
    assert both["ratio_executed"] == pytest.approx(1 / 4, rel=1e-4)
    # All paths bend alike: relative to its speed every field is as curved as the baseline.
    assert all(r["ratio_relative"] == pytest.approx(1.0, rel=1e-4) for r in rows.values())
    assert all(r["ratio_low"] <= r["ratio"] + 1e-9 <= r["ratio_high"] + 2e-9 for r in rows.values())
    assert rows["gaussian", 0, "training"]["bound"] > rows["past", 0, "training"]["bound"]


def test_the_ratio_of_linear_fields_has_the_closed_form(small_loss):
    """v = -rate * a: v_k = -rate * (1 - rate/N)^k a0 at step k, from the same sources a0."""
    fields = {"gaussian": [policy(lambda t, a, o: -a)], "history": [policy(lambda t, a, o: -2 * a)]}
    rows = straightness(fields, shared(), draws=2, seed=3)
    ks = torch.arange(100, dtype=torch.float64)
    kappas = [(rate * (1 - rate / 100) ** ks).var(correction=0) for rate in (1.0, 2.0)]
    expected = pytest.approx(float(kappas[1] / kappas[0]), rel=1e-3)
    assert rows["history", 0, "training"]["ratio"] == expected
    assert straightness(fields, shared(), draws=2, seed=3) == rows  # one seed, one result


def test_the_noise_of_the_earlier_prediction_is_not_that_of_the_path(small_loss):
    """A field of 0 predicts mean + noise; from the mean it makes, the next source starts."""
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


def test_the_bound_is_that_of_the_mean_it_stands_beside(small_loss):
    far = {"past": [policy(lambda t, a, o: torch.full_like(a, 100.0), PastPrior(H))]}
    rows = straightness(far, shared(), n_steps=4)
    assert rows["past", 0, "deployed"]["bound"] > 1_000 > rows["past", 0, "training"]["bound"]
    # It is no bound of pairs that a coupling has made.
    rows = straightness({"ot": [policy(turning(1.0))]}, shared(), n_steps=4)
    assert math.isnan(rows["ot", 0, "training"]["bound"])


def test_the_memory_gain_of_a_network_that_sees_the_history_is_that_of_what_it_sees():
    length = 4
    seen = slice(OBSERVATION_DIM, OBSERVATION_DIM + length * ACTION_DIM)
    follows = Field(lambda t, a, o: 0.4 * o[:, -1, seen].unflatten(-1, (length, ACTION_DIM)) - a)
    actor = WarmPriorActor(follows, GaussianPrior(length), observation_key=keys.CONDITIONED)
    method, network = Method("history", length), NetworkOptions()
    trained = SimpleNamespace(load=lambda: actor, task=task, method=method, network=network)
    found = measure(trained, (1,))
    assert found[1]["memory_gain"] == pytest.approx(0.4, rel=1e-4)


def test_measures_are_those_at_the_temperature_of_the_row():
    stays = WarmPriorActor(Field(lambda t, a, o: torch.zeros_like(a)), GaussianPrior(H))  # actions are noise
    method, network = Method("gaussian", H), NetworkOptions()
    trained = SimpleNamespace(load=lambda: stays, task=task, method=method, network=network)
    leak = {t: measure(trained, (1,), t)[1]["source_leak"] for t in (1.0, 0.5, 0.0)}
    assert leak[1.0] > 0
    assert leak == pytest.approx({t: t * leak[1.0] for t in leak}, rel=1e-4)
