"""The toy shows what the paper says it shows (Sec. 4.2, Fig. 5)."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from warmprior.diagnostics import SharedObservations, compare_curvature, executed_actions
from warmprior.envs import navigation_metrics
from warmprior.training import (
    NAVIGATION_PRESETS,
    NavigationStudy,
    navigation_priors,
)

pytest.importorskip("tqdm")


def study_in(directory, iterations=3_000, rollouts=256, **options):
    preset = NAVIGATION_PRESETS["quick"]
    training = replace(preset.training, iterations=iterations, save_every=iterations)
    priors = navigation_priors(4)
    return NavigationStudy(
        replace(preset, training=training), priors, directory, rollouts=rollouts, **options
    )


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return study_in(tmp_path_factory.mktemp("tiny"), iterations=5, rollouts=8)


def test_priors_differ_in_the_source_alone():
    priors = navigation_priors(3, cold_probability=0.2)
    assert [p.chunk_length for p in priors.values()] == [3] * 7
    assert {name: p.sigma for name, p in priors.items() if "0." in name} == {
        "past 0.1": 0.1,
        "past 0.5": 0.5,
        "preview 0.1": 0.1,
        "preview 0.5": 0.5,
    }
    assert [p.cold_probability for p in priors.values()] == [0, 0] + [0.2] * 5


def test_windows_are_the_demonstrated_steps_with_a_full_history(tiny):
    for prior in tiny.priors.values():
        now, before = tiny.observations.windows(prior), tiny.observations.windows(prior, offset=4)
        assert len(now) == 6 * 60
        assert now["prior", "warm"].any(1).all() == (prior.name not in ("gaussian", "regression"))
        chunk, earlier = now["vla_action", "chunk"], before["vla_action", "chunk"]
        assert torch.equal(chunk[0, 0], earlier[4, 0])
        assert torch.equal(earlier[:, :4].flatten(0, 1)[:4], tiny.data["action"][:4])


@pytest.mark.parametrize("name", ["gaussian", "regression", "history", "preview 0.1"])
def test_policies_are_reproducible_and_reused(tiny, name):
    actor = tiny.train(name, seed=1)
    assert actor.ode.nfe == (1 if name == "regression" else 9)
    row = tiny.judge(actor, seed=1)
    again = tiny.judge(tiny.train(name, seed=1), seed=1)
    assert row == pytest.approx(again, nan_ok=True)
    assert {"switch_rate", "shifted_collision_rate", "one_step_distance", "jump_ratio"} <= set(row)
    assert actor.ode.nfe == (1 if name == "regression" else 9)  # judging left it alone


def test_a_shift_touches_only_policies_with_a_memory(tiny):
    def heights(name, shift):
        actor = tiny.train(name, seed=1)
        played = executed_actions(tiny.play(actor, 3, shift=shift))[0]
        assert played.shape == (8, 64, 1)
        assert actor.sampler.generator is None  # playing leaves the policy as it was
        return played

    # Regression is deterministic and remembers nothing.
    assert torch.equal(heights("regression", 0.0), heights("regression", 5.0))
    assert torch.equal(heights("history", 0.0), heights("history", 0.0))
    assert not torch.isclose(heights("history", 0.0), heights("history", 5.0)).all()


@pytest.mark.filterwarnings("ignore:.*curvature is NaN")
def test_straightness_covers_the_flows(tiny):
    actors = {name: tiny.train(name, seed=1) for name in tiny.priors}
    result = tiny.straightness(actors, seed=0, n_steps=5)
    assert set(result) == set(actors) - {"regression"}
    assert result["gaussian"]["ratio"] == 1.0 or math.isnan(result["gaussian"]["ratio"])
    # Windows inside the data: WP-Past's bound is that of a slowly varying height.
    assert result["past 0.1"]["bound"] < result["past 0.5"]["bound"] < result["gaussian"]["bound"]
    assert "bound" not in result["history"]


def test_only_divergence_is_taken_for_divergence(tiny, monkeypatch):
    actor = tiny.train("past 0.1", seed=1)
    play = NavigationStudy.play

    def spoiled(study, actor, seed, *, shift=0.0, nfe=None):
        rollout = play(study, actor, seed, shift=shift, nfe=nfe)
        if nfe == 1:
            rollout["vla_action", "chunk"][0, -1, 0] = torch.inf
        return rollout

    fine = tiny.judge(actor, seed=1)
    monkeypatch.setattr(NavigationStudy, "play", spoiled)
    row = tiny.judge(actor, seed=1)
    assert row["one_step_collision_rate"] == 1.0 and math.isnan(row["one_step_distance"])
    assert {k: v for k, v in row.items() if "one_step" not in k} == pytest.approx(
        {k: v for k, v in fine.items() if "one_step" not in k}, nan_ok=True
    )

    def broken(study, actor, seed, **options):
        if "nfe" in options:
            raise ValueError("something else")
        return play(study, actor, seed, **options)

    monkeypatch.setattr(NavigationStudy, "play", broken)
    with pytest.raises(ValueError, match="something else"):
        tiny.judge(actor, seed=1)


def test_the_earlier_prediction_has_noise_of_its_own(tiny, monkeypatch):
    """Otherwise both predictions of a deployed curvature would start from the same draw."""
    drawn = {"curvature": [], "earlier": []}

    def spy(name, function):
        def wrapper(*args, generator):
            copy = torch.Generator()
            copy.set_state(generator.get_state())
            drawn[name].append(torch.randn(5, generator=copy))
            return function(*args, generator=generator)

        return wrapper

    measure = partial(compare_curvature, draws=4)
    fixed = spy("curvature", measure)
    monkeypatch.setattr(
        "warmprior.training.navigation1d.compare_curvature",
        lambda *args, draws, generator: fixed(*args, generator=generator),
    )
    monkeypatch.setattr(SharedObservations, "deployed", spy("earlier", SharedObservations.deployed))
    tiny.straightness({"past 0.1": tiny.train("past 0.1", seed=1)}, seed=0, n_steps=5)
    # The same noise at the training's and at the deployed mean, which was made from another.
    at_training, at_deployed = drawn["curvature"]
    assert torch.equal(at_training, at_deployed)
    assert not torch.isclose(drawn["earlier"][0], at_training).any()


def test_a_study_is_fair_or_refused(tmp_path):
    mixed = {
        "gaussian": navigation_priors(4)["gaussian"],
        "past 0.1": navigation_priors(8)["past 0.1"],
    }
    with pytest.raises(ValueError, match="one chunk length"):
        NavigationStudy(NAVIGATION_PRESETS["quick"], mixed, tmp_path)
    with pytest.raises(ValueError, match="rollouts"):
        study_in(tmp_path, rollouts=0)


def test_warm_sources_stop_mode_switching(tmp_path):
    """A third of the benchmark's budget, one seed: the contrast is far larger than what that costs."""
    study = study_in(tmp_path, iterations=1_000)
    actors = {name: study.train(name, 0) for name in ("gaussian", "past 0.1")}
    base, past = (study.judge(actor, 0) for actor in actors.values())
    assert base["switch_rate"] > 0.4 and base["collision_rate"] > 0.8
    assert past["switch_rate"] < 0.05 and past["collision_rate"] < 0.3
    assert study.straightness(actors, 0)["past 0.1"]["ratio"] < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_figure_at_the_benchmarks_budget(tmp_path, seed):
    study = study_in(tmp_path)
    actors = {name: study.train(name, seed) for name in list(study.priors)[:5]}
    rows = {name: study.judge(actor, seed) for name, actor in actors.items()}
    assert rows["gaussian"]["switch_rate"] > 0.4 and rows["gaussian"]["collision_rate"] > 0.8
    assert rows["past 0.1"]["switch_rate"] < 0.03 and rows["past 0.1"]["collision_rate"] < 0.15
    assert rows["past 0.5"]["route_entropy"] > 1.6 and rows["past 0.5"]["collision_rate"] < 0.15
    assert rows["regression"]["collision_rate"] == 1.0
    assert math.isnan(rows["regression"]["switch_rate"])
    # Conditioning commits as well, but on a history that is slightly wrong it leaves the data.
    assert rows["history"]["switch_rate"] < 0.03
    assert rows["history"]["shifted_distance"] > 2 * rows["past 0.1"]["shifted_distance"]
    straightness = study.straightness(actors, seed)
    assert straightness["past 0.1"]["ratio"] < straightness["past 0.5"]["ratio"] < 0.3
    heights = executed_actions(study.play(actors["gaussian"], seed))[0].squeeze(-1)
    # Each decision of the base alone is right: it stays near the data, on either side.
    assert navigation_metrics(heights, 4).distance < 0.1
