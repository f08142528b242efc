"""Rows of a comparison: what they tell, and in which order."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import replace

import pytest
import torch
from torchrl.envs import TransformedEnv

from warmprior.diagnostics import (
    SharedObservations,
    branching_bound,
    curvature,
    memory_gain,
    source_leak,
)
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.training import play_episode

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import (
    METHODS,
    TRAINING,
    DriftEnv,
    comparison,
    rows_of,
)
from warmprior.experiments import Store


class LastIsFirst(Store):
    """The trainings end in the opposite order, each some time after the one behind it."""

    def train(self, method, training, progress=None):
        losses = super().train(method, training, progress)
        place = 2 * [p.name for p in METHODS].index(method.name) + training.seed
        ended = [self.folder(method, training).parent / f"ended-{i}" for i in range(6)]
        patience = time.monotonic() + 120
        while place < 5 and not ended[place + 1].exists():
            assert time.monotonic() < patience
            time.sleep(0.05)
        time.sleep(0.2)  # the results of those behind it are on their way
        ended[place].touch()
        return losses


def test_rows_have_their_order_whatever_ends_first(undisturbed, tmp_path, capsys):
    comparison(tmp_path, 6, kind=LastIsFirst).run()
    rows = rows_of(tmp_path)
    cells = [(row["prior"], row["seed"], row["checkpoint"], row["nfe"]) for row in rows]
    names = ("gaussian", "past", "preview")
    assert cells == [(p, s, c, n) for p in names for s in (0, 1) for c in (10, 20) for n in (3, 1)]
    assert rows == rows_of(undisturbed)
    told = capsys.readouterr().out
    assert told.count("trained ") == 6 and told.count("played ") == 24
    assert told.index("trained drift own, preview") < told.index("trained drift own, gaussian")


def test_rows_tell_what_was_measured_of_their_policy(undisturbed):
    """The same as measured here, on the policy that the row is about, if it is a last checkpoint."""
    (store,) = comparison(undisturbed, 1, resume=True).stores
    for row in rows_of(undisturbed):
        if row["checkpoint"] != TRAINING.iterations:
            assert row.get("source_leak") is None and row.get("kappa") is None
            continue
        method = next(method for method in METHODS if method.name == row["prior"])
        prior = method.prior()
        shared = SharedObservations(store.problem.data, prior.chunk_length, observation_steps=2)
        order = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        shared = shared.subset(order.sort()[0])
        windows = shared.windows(prior)
        policy = store.load(method, replace(TRAINING, seed=row["seed"]), row["checkpoint"])
        leak = source_leak(policy, windows, nfes=(1, 3), episodes=shared.episodes)[row["nfe"]]
        assert row["source_leak"] == pytest.approx(leak.leak)
        assert row["inner_step_ratio"] == pytest.approx(leak.inner_step_ratio)
        gain = memory_gain(policy, windows, nfes=(1, 3))[row["nfe"]]
        assert row["memory_gain"] == pytest.approx(gain)
        assert (gain != 0) == (method.name != "gaussian")
        generator = torch.Generator().manual_seed(0)
        if method.name != "gaussian":
            windows = shared.deployed(policy, generator=generator)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            flow = curvature(policy, windows, generator=generator)
        for name, key in (("kappa", "kappa_executed"), ("relative_curvature", "relative_executed")):
            value = float(flow[key].nanmean())
            told = math.nan if row[name] is None else row[name]  # it does not move
            assert told == pytest.approx(value, nan_ok=True)
        bound = branching_bound(windows, prior)["total_executed"].mean()
        assert row["bound"] == pytest.approx(float(bound))


def test_rows_tell_every_episode_in_the_order_of_the_seeds(undisturbed):
    (store,) = comparison(undisturbed, 1, resume=True).stores
    row = rows_of(undisturbed)[-1]
    policy = store.load(METHODS[2], replace(TRAINING, seed=row["seed"]), row["checkpoint"])
    env = TransformedEnv(DriftEnv(), store.transforms(METHODS[2])())
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + row["episodes"])
    options = {"nfe": row["nfe"], "policy_seed": row["seed"]}
    solved = [play_episode(policy, env, seed, **options).success for seed in seeds]
    assert row["outcomes"] == "".join(str(int(s)) for s in solved)
    assert 0 < sum(solved) < len(solved)
