"""The toy shows what the paper says it shows (Sec. 4.2, Fig. 5)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from warmprior import PastPrior, VelocityMLP, WarmPriorActor
from warmprior.diagnostics import SharedObservations, executed_actions
from warmprior.envs import navigation_metrics

pytest.importorskip("tyro")

from warmprior.experiments import (
    NAVIGATION_PRESETS,
    Method,
    Store,
    judge_navigation,
    navigation_problem,
    play_navigation,
    straightness,
)

METHODS = NAVIGATION_PRESETS["quick"].sources.methods()


def store_in(directory):
    recipe = NAVIGATION_PRESETS["quick"]
    run = replace(recipe.run, logger="none")
    return Store(navigation_problem(), recipe.network, directory, directory / "logs", run)


def train(store, name, sigma=None, *, iterations, seed=0):
    (method,) = (p for p in METHODS if p.name == name and sigma in (None, p.sigma))
    training = NAVIGATION_PRESETS["quick"].training
    recipe = replace(training, iterations=iterations, save_every=iterations, seed=seed)
    return store.policy(method, recipe)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Policies of five iterations."""
    store = store_in(tmp_path_factory.mktemp("tiny"))
    return lambda name, sigma=None: train(store, name, sigma, iterations=5, seed=1)


def test_methods_differ_in_the_source_alone():
    told = [(p.name, p.sigma if Method.takes(p.name, "sigma") else None) for p in METHODS]
    assert told == [
        ("gaussian", None),
        ("regression", None),
        ("history", None),
        ("past", 0.1),
        ("past", 0.5),
        ("preview", 0.1),
        ("preview", 0.5),
    ]
    assert {p.chunk_length for p in METHODS} == {4}
    assert all(p.training.cold_probability == 0.1 for p in NAVIGATION_PRESETS.values())


def test_windows_are_the_demonstrated_steps_with_a_full_history():
    data = navigation_problem().data
    observations = SharedObservations(data, 4)
    for prior in (method.prior() for method in METHODS):
        now, before = observations.windows(prior), observations.windows(prior, offset=4)
        assert len(now) == 6 * 60
        assert (now["history", "steps"] >= 4).all()
        chunk, earlier = now["vla_action", "chunk"], before["vla_action", "chunk"]
        assert torch.equal(chunk[0, 0], earlier[4, 0])
        assert torch.equal(earlier[:, :4].flatten(0, 1)[:4], data["action"][:4])


@pytest.mark.parametrize("name", ["gaussian", "regression", "history", "preview"])
def test_policies_are_reproducible_and_reused(tiny, name):
    sigma = 0.1 if name == "preview" else None
    actor = tiny(name, sigma)
    nfe = 1 if name == "regression" else 9
    row = judge_navigation(actor, 1, nfe=nfe, rollouts=8)
    again = judge_navigation(tiny(name, sigma), 1, nfe=nfe, rollouts=8)
    assert row == pytest.approx(again, nan_ok=True)
    assert {"switch_rate", "shifted_collision_rate", "distance", "jump_ratio"} <= set(row)


def test_a_shift_touches_only_policies_with_a_memory(tiny):
    def heights(name, shift):
        actor = tiny(name)
        played = play_navigation(actor, 3, nfe=1, rollouts=8, shift=shift)
        assert actor.sampler.generator is None  # playing leaves the policy as it was
        heights = executed_actions(played)[0]
        assert heights.shape == (8, 64, 1)
        return heights

    # Regression is deterministic and remembers nothing.
    assert torch.equal(heights("regression", 0.0), heights("regression", 5.0))
    assert torch.equal(heights("history", 0.0), heights("history", 0.0))
    assert not torch.isclose(heights("history", 0.0), heights("history", 5.0)).all()


class Explodes(torch.nn.Module):
    """A field that leaves the numbers only from a history that is shifted."""

    def __init__(self, where):
        super().__init__()
        self.where, self.unused = where, torch.nn.Parameter(torch.zeros(()))

    def forward(self, t, a, observation):
        return torch.where(a.abs() > self.where, torch.inf, torch.zeros_like(a))


def test_a_policy_that_diverges_collides_and_has_no_other_metrics():
    prior = PastPrior(4, sigma=0.0)
    still = judge_navigation(WarmPriorActor(Explodes(3.0), prior), 0, nfe=1, rollouts=8)
    gone = judge_navigation(WarmPriorActor(Explodes(-1.0), prior), 0, nfe=1, rollouts=8)
    assert gone["collision_rate"] == 1.0 and math.isnan(gone["distance"])
    assert gone["shifted_collision_rate"] == 1.0 and math.isnan(gone["shifted_distance"])
    assert math.isfinite(still["distance"])

    class Broken(VelocityMLP):
        def forward(self, t, a, observation):
            raise ValueError("something else")

    broken = WarmPriorActor(Broken(1, 1, 4, 1, hidden_dim=8), prior)
    with pytest.raises(Exception, match="something else"):  # which is not taken for divergence
        judge_navigation(broken, 0, nfe=1, rollouts=8)


def test_warm_sources_stop_mode_switching(tmp_path):
    """A third of the benchmark's budget, one seed: the contrast is far larger than what that costs."""
    store = store_in(tmp_path)
    base = train(store, "gaussian", iterations=1_000)
    past = train(store, "past", 0.1, iterations=1_000)
    of_base, of_past = (judge_navigation(actor, 0, nfe=9) for actor in (base, past))
    assert of_base["switch_rate"] > 0.4 and of_base["collision_rate"] > 0.8
    assert of_past["switch_rate"] < 0.05 and of_past["collision_rate"] < 0.3
    observations = SharedObservations(store.problem.data, 4)
    rows = straightness(
        {Method("gaussian", 4): {0: base}, Method("past", 4, {"sigma": 0.1}): {0: past}},
        observations,
        draws=4,
    )
    assert next(row for row in rows if row["prior"] == "past")["ratio"] < 0.3
    bounds = {row["prior"]: row["bound"] for row in rows}
    assert bounds["past"] < bounds["gaussian"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_figure_at_the_benchmarks_budget(tmp_path, seed):
    store = store_in(tmp_path)
    chosen = {
        (name, sigma): train(store, name, sigma, iterations=3_000, seed=seed)
        for name, sigma in (
            ("gaussian", None),
            ("regression", None),
            ("history", None),
            ("past", 0.1),
            ("past", 0.5),
        )
    }
    rows = {
        key: judge_navigation(actor, seed, nfe=1 if key[0] == "regression" else 9)
        for key, actor in chosen.items()
    }
    base, regression, history = (rows[n, None] for n in ("gaussian", "regression", "history"))
    sharp, wide = rows["past", 0.1], rows["past", 0.5]
    assert base["switch_rate"] > 0.4 and base["collision_rate"] > 0.8
    assert sharp["switch_rate"] < 0.03 and sharp["collision_rate"] < 0.15
    assert wide["route_entropy"] > 1.6 and wide["collision_rate"] < 0.15
    assert regression["collision_rate"] == 1.0 and math.isnan(regression["switch_rate"])
    # Conditioning commits as well, but on a history that is slightly wrong it leaves the data.
    assert history["switch_rate"] < 0.03
    assert history["shifted_distance"] > 2 * sharp["shifted_distance"]
    observations = SharedObservations(store.problem.data, 4)
    policies = {
        Method.parse(name, 4, sigma=sigma): {seed: actor} for (name, sigma), actor in chosen.items()
    }
    ratios = {
        (row["prior"], row["sigma"]): row["ratio"]
        for row in straightness(policies, observations, draws=4, seed=seed)
        if row["mean"] == "training"
    }
    assert ratios["past", 0.1] < ratios["past", 0.5] < 0.3
    played = play_navigation(chosen["gaussian", None], seed, nfe=9)
    # Each decision of the base alone is right: it stays near the data, on either side.
    assert navigation_metrics(executed_actions(played)[0].squeeze(-1), 4).distance < 0.1
