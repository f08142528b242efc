"""Comparisons of policies that take time: cells, and what is played in them."""

from __future__ import annotations

import pytest

pytest.importorskip("tyro")

from torchrl.envs import TransformedEnv

from tests.experiments.comparison_parts import DriftEnv, H, comparison, rows_of
from warmprior import RealTimeChunking
from warmprior.diagnostics import smoothness
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments import Comparison, Condition, DelayedRecipe, Method
from warmprior.training import play_episode

RTC = RealTimeChunking(schedule="linear")


def delayed(folder):
    """The comparison of :func:`comparison`, of WP-Past alone, under conditions."""
    usual = comparison(folder, 1, methods=[Method("past", H)], seeds=1)
    parts = {n: getattr(usual.recipe, n) for n in ("network", "training", "evaluation", "run")}
    recipe = DelayedRecipe(delay=(1, 0), execute=3, rtc=RTC, **parts)
    return Comparison(recipe, stores=usual.stores, methods=[Method("past", H)])


def test_rows_tell_what_was_played_under_their_condition(tmp_path):
    compared = delayed(tmp_path)
    compared.run()
    rows = rows_of(tmp_path)
    cells = [(r["checkpoint"], r["nfe"], r["delay"], r["guidance"], r["execute"]) for r in rows]
    assert cells == [
        (checkpoint, nfe, delay, guidance, 3)
        for checkpoint in (10, 20)
        for nfe in (3, 1)
        for delay in (0, 1)
        for guidance in ("none", "rtc")
    ]
    # The same episode as played here.
    (contestant,) = compared.contestants
    (store,) = compared.stores
    for guidance, name in ((None, "none"), (RTC, "rtc")):
        transforms = store.transforms(contestant.method)(execute=3, delay=1)
        env = TransformedEnv(DriftEnv(), transforms)
        policy = contestant.policy().replace(guidance=guidance)
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + 5)
        episodes = [play_episode(policy, env, seed, nfe=3) for seed in seeds]
        (mine,) = (
            r
            for r in rows
            if (r["checkpoint"], r["nfe"], r["delay"], r["guidance"]) == (20, 3, 1, name)
        )
        assert mine["outcomes"] == "".join(str(int(e.success)) for e in episodes)
        assert mine["mean_steps"] == sum(e.steps for e in episodes) / 5
        jumps = [smoothness(e.decisions) for e in episodes]
        mean = sum(j.boundary_jump * j.boundaries for j in jumps) / sum(j.boundaries for j in jumps)
        assert mine["boundary_jump"] == pytest.approx(mean, rel=1e-5)


def test_the_usual_condition_is_not_told():
    assert Condition().facts() == {}
    assert Condition(delay=0, execute=2, guidance=RTC).facts() == {
        "delay": 0,
        "execute": 2,
        "guidance": "rtc",
    }
