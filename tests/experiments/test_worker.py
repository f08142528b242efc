"""Worker processes of a comparison: the same rows for any number of them, and of any problem."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace

import pytest
import torch

from tests.training.cloning_parts import same
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io import workers
from warmprior.training import WorkerError

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import (
    METHODS,
    TRAINING,
    DriftEnv,
    comparison,
    drift_problem,
    rows_of,
    weights,
)
from warmprior.experiments import (
    Comparison,
    EvaluationOptions,
    NetworkOptions,
    Recipe,
    RunOptions,
    Store,
)


@pytest.mark.parametrize("envs", [2, 3])
def test_rows_and_weights_do_not_depend_on_the_number_of_workers(undisturbed, tmp_path, envs):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # the parent's number is none of their business either
    try:
        comparison(tmp_path, envs).run()
    finally:
        torch.set_num_threads(threads)
    assert same(weights(tmp_path), weights(undisturbed))
    assert rows_of(tmp_path) == rows_of(undisturbed)
    rows = rows_of(undisturbed)
    assert all(row["boundary_jump"] > 0 and row["inner_jump"] > 0 for row in rows)
    # The comparison above says something: the policies and their noise decide.
    assert len({row["boundary_jump"] for row in rows}) == len(rows)
    assert 0 < sum(row["successes"] for row in rows) < sum(row["episodes"] for row in rows)


def test_spawned_workers_give_the_same_rows(undisturbed, tmp_path, monkeypatch):
    """As beside CUDA: everything that a worker needs is handed over instead of inherited."""
    monkeypatch.setattr(workers, "start_method", lambda: "spawn")
    comparison(tmp_path, 2, methods=METHODS[1:2], seeds=1).run()
    expected = [r for r in rows_of(undisturbed) if (r["prior"], r["seed"]) == ("past", 0)]
    assert rows_of(tmp_path) == expected


def test_every_worker_plays_each_seed_once_per_cell(tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    env = DriftEnv(log, sleep=0.01)
    comparison(tmp_path, 2, problem=drift_problem(env), methods=METHODS[:2]).run()
    names = [path.name.split("-") for path in log.iterdir()]
    seeds = [int(seed) for seed, _, _ in names]
    cells = 2 * 2 * 2 * 2
    assert sorted(seeds) == sorted([*range(EVALUATION_SEED, EVALUATION_SEED + 5)] * cells)
    processes = {pid for _, pid, _ in names}
    assert len(processes) == 2 and str(os.getpid()) not in processes


class Mortal(DriftEnv):
    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


def test_a_killed_worker_ends_the_run_which_continues(undisturbed, tmp_path):
    result = []

    def run():
        try:
            comparison(tmp_path, 2, problem=drift_problem(Mortal())).run()
        except BaseException as error:
            result.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive(), "the comparison hangs after its worker was killed"
    assert isinstance(result[0], WorkerError) and "--envs" in str(result[0])
    comparison(tmp_path, 3, resume=True).run()
    assert rows_of(tmp_path) == rows_of(undisturbed)


def unbuildable(**options):
    raise RuntimeError("this simulator cannot be built")


def test_a_problem_that_cannot_be_built_leaves_the_others_alone(tmp_path):
    """In one worker, which plays the sound problem before and after."""
    sound, broken = drift_problem(), replace(drift_problem(), task="broken", make_env=unbuildable)
    options = {"methods": METHODS[:2], "seeds": 1}
    alone = comparison(tmp_path / "alone", 1, **options)
    alone.run()
    both = comparison(tmp_path / "both", 1, **options)
    store = both.stores[0]
    recipe = both.recipe
    stores = [
        Store(p, store.network, store.directory, store.logs, store.run) for p in (sound, broken)
    ]
    both = Comparison(recipe, "two", stores=stores, directory=tmp_path / "two", methods=METHODS[:2])
    both.run()
    assert len(both.failures) == 2 and all("cannot be built" in f for f in both.failures)
    assert both.rows == alone.rows


class SolvedEarly(DriftEnv):
    """Solved at its third step, and at no other."""

    def __init__(self, terminate_on_success=True):
        super().__init__()
        self.ends = terminate_on_success

    def _reset(self, tensordict=None, **kwargs):
        self.steps = 0
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        out = super()._step(tensordict)
        self.steps += 1
        solved = torch.tensor([self.steps == 3])
        out["success"] = solved
        out["done"] = out["terminated"] = out["done"] | (solved & self.ends)
        return out


def test_several_problems_in_one_run_are_what_each_is_alone(tmp_path):
    """Other demonstrations, and an environment of its own for each; in one table and one store."""
    other = replace(drift_problem(), task="early", identity="2", make_env=SolvedEarly)
    recipe = Recipe(
        network=NetworkOptions(hidden_dim=16),
        training=TRAINING,
        evaluation=EvaluationOptions(episodes=3, nfe=(1,)),
        run=RunOptions(out=tmp_path / "both" / "out", envs=1, logger="none"),
    )

    def run(*problems, folder, resume=False):
        options = replace(recipe.run, out=tmp_path / folder / "out", resume=resume)
        stores = [
            Store(p, recipe.network, tmp_path / folder / "policies", tmp_path / "logs", options)
            for p in problems
        ]
        compared = Comparison(replace(recipe, run=options), stores=stores, methods=METHODS[:2])
        return compared.run().rows

    rows = run(drift_problem(), other, folder="both")
    alone = [
        *run(drift_problem(), folder="first"),
        *run(other, folder="second"),
    ]
    assert rows == alone
    assert [row["task"] for row in rows] == ["drift"] * 4 + ["early"] * 4
    assert run(drift_problem(), other, folder="both", resume=True) == rows


def test_play_on_goes_to_the_end_and_remembers_success(tmp_path):
    found = {}
    for play_on in (False, True):
        folder = tmp_path / str(play_on)
        problem = replace(drift_problem(), make_env=SolvedEarly)
        compared = comparison(
            folder, 1, methods=METHODS[:1], seeds=1, problem=problem, play_on=play_on
        )
        (found[play_on], *_) = compared.run().rows
    assert [row["success_rate"] for row in found.values()] == [1.0, 1.0]
    lengths = [9 + (EVALUATION_SEED + i) % 7 for i in range(5)]
    assert found[False]["mean_steps"] == 3
    assert found[True]["mean_steps"] == sum(lengths) / 5
