"""Comparisons as users see them: what is trained, continued, told and refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from warmprior import PastPrior
from warmprior.io.script import PartialFailure

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import (
    METHODS,
    H,
    comparison,
    rows_of,
    stored,
)
from warmprior.experiments import Method, Store, store, write_report


def test_losses_are_those_of_the_workers_and_nothing_is_trained_again(
    undisturbed, tmp_path, monkeypatch
):
    finished = comparison(tmp_path, 2, logger="csv")
    finished.run()
    iterations = [5, 10, 15, 20]
    monkeypatch.setattr(Store, "new_actor", lambda *args: pytest.fail("something was trained"))
    losses = finished.losses(finished.stores[0])
    assert {name: len(curves) for name, curves in losses.items()} == {p.label: 2 for p in METHODS}
    assert all([i for i, _ in curve] == iterations for c in losses.values() for curve in c)
    monkeypatch.undo()
    again = comparison(undisturbed, 1, resume=True)
    assert again.losses(again.stores[0]) == losses
    logs = tmp_path / "out" / "logs"
    logged = {path.relative_to(logs).parts[0] for path in logs.rglob("*loss*.csv")}
    assert logged == {path.name for path in (tmp_path / "policies").iterdir()}


def test_meta_tells_what_computed(undisturbed):
    meta = stored(undisturbed)["meta"]
    assert meta["hardware"]["torch_threads"] == 1 and meta["hardware"]["workers"] == 1
    assert "envs" not in meta["identity"]["recipe"]["run"] and meta["wall_time_s"] > 0
    assert [p["seed"] for p in meta["policies"]] == [0, 1] * 3


def test_a_run_of_another_version_is_not_continued(undisturbed, monkeypatch):
    before = stored(undisturbed)
    for module in ("results", "store"):
        monkeypatch.setattr(f"warmprior.experiments.{module}.version", lambda package: "9.9.9")
    number = before["meta"]["versions"]["warmprior"]
    with pytest.raises(
        ValueError, match=rf"was begun with warmprior {number}, not 9.9.9 and torch"
    ):
        comparison(undisturbed, 1, resume=True)
    assert stored(undisturbed) == before


def test_another_number_of_workers_continues(undisturbed, tmp_path):
    """Stored rows are kept, missing ones played."""
    whole = stored(undisturbed)["rows"]
    comparison(tmp_path, 1).run()
    path = tmp_path / "out" / "results.json"
    results = json.loads(path.read_text())
    results["rows"] = [
        row | {"measures": row["measures"] | {"mean_steps": 12_345.0}} for row in whole[3:9]
    ]
    path.write_text(json.dumps(results))
    comparison(tmp_path, 2, resume=True).run()
    assert stored(tmp_path)["rows"] == whole[:3] + results["rows"] + whole[9:]


def test_rows_of_a_policy_that_failed_on_the_way_are_kept_but_not_shown(tmp_path):
    compared = comparison(tmp_path, 1, methods=METHODS[:2], seeds=2)
    compared.run()
    everything = compared.results.rows
    failed = compared.contestants.pop()
    assert [row for row in everything if row["prior"] == "past" and row["seed"] == 1]
    assert len(compared.rows) == len(everything) - 4 and failed.method.name == "past"
    assert {(row["prior"], row["seed"]) for row in compared.timed()} == {
        ("gaussian", 0),
        ("gaussian", 1),
        ("past", 0),
    }
    write_report(tmp_path, "| table |\n")
    with pytest.raises(PartialFailure, match="1 failed"):
        write_report(tmp_path, "| table |\n", [f"{failed}: it stumbled"])
    assert (tmp_path / "table.md").read_text() == f"| table |\n\n- Missing: {failed}: it stumbled\n"


def test_the_same_policy_is_trained_once(tmp_path, capsys):
    twice = [Method("past", H), Method("past", H, {"sigma": 0.5})]
    compared = comparison(tmp_path, 2, methods=twice, seeds=1)
    assert len(compared.run().rows) == 4  # two checkpoints, two NFEs
    assert capsys.readouterr().out.count("trained ") == 1
    (tmp_path / "out" / "results.json").unlink()
    comparison(tmp_path, 2, methods=[Method("past", H)], seeds=2).run()
    told = capsys.readouterr().out
    assert told.count("found drift own, past") == 1 and told.count("trained drift own, past") == 1
    assert "found" in told.partition("seed 0, 20 iterations")[0]


class Widening(PastPrior, torch.nn.Module):
    """Its noise is learnt."""

    name = "widening"

    def __init__(self, chunk_length, *, sigma=0.5):
        torch.nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma)
        self.scale = torch.nn.Parameter(torch.ones(()))

    def distribution(self, history, observation=None):
        source = super().distribution(history, observation)
        return replace(source, scale=self.scale * source.scale)


def test_a_prior_of_ones_own_that_learns_with_the_flow(tmp_path):
    method = Method.parse(f"{__name__}:Widening", H)
    compared = comparison(tmp_path, 2, methods=[method], seeds=1)
    assert [row["prior"] for row in compared.run().rows] == ["widening"] * 4
    assert float(compared.contestants[0].policy().prior.scale) != 1.0


def test_parts_that_learn_before_the_flow_learn_once(tmp_path, monkeypatch):
    methods = [Method("forecast", H), Method("step", H)]
    compared = comparison(tmp_path, 2, methods=methods, seeds=1)
    compared.run()
    assert all((c.folder / "learner.safetensors").exists() for c in compared.contestants)
    rows = rows_of(tmp_path)
    monkeypatch.setattr(store, "learn", lambda *args, **kwargs: pytest.fail("learnt again"))
    comparison(tmp_path, 1, methods=methods, seeds=1, resume=True).run()
    assert rows_of(tmp_path) == rows
    forecast = compared.contestants[0]
    again = forecast.store.new_actor(forecast.method, forecast.training).prior.state_dict()
    learnt = forecast.policy().prior.state_dict()
    assert learnt and all(torch.equal(learnt[name], again[name]) for name in learnt)


def test_times_of_trainings_are_told_beside_the_rows(tmp_path):
    compared = comparison(tmp_path, 2, methods=METHODS[:2], seeds=1)
    assert compared.timed() == []
    compared.run()
    first = compared.timed()
    assert [replace(row, measures={}) for row in first] == [
        replace(row, measures={}) for row in compared.results.rows
    ]
    assert all(row["training_seconds"] > 0 for row in first)
    assert len({row["training_seconds"] for row in first}) == 2
    again = comparison(tmp_path, 1, methods=METHODS[:2], seeds=1, resume=True)
    again.run()
    assert again.timed() == first  # nothing was trained
    (compared.contestants[0].folder / "training_time.json").unlink()
    assert compared.timed()[0]["training_seconds"] is None


def test_a_chunk_longer_than_every_demonstration_is_refused(tmp_path):
    with pytest.raises(ValueError, match="longest demonstration of drift own has, 40"):
        comparison(tmp_path, 1, methods=[Method("past", 41)])


def test_results_of_another_recipe_are_not_continued(undisturbed):
    with pytest.raises(ValueError, match=r"results\.json belongs to another"):
        comparison(undisturbed, 1, resume=True, episodes=6)


def test_options_at_their_defaults_make_no_other_method(tmp_path):
    twins = [Method("past", 3), Method("past", 3, {"correlation": 0.0, "sigma": 0.5})]
    assert twins[0] == twins[1] and hash(twins[0]) == hash(twins[1])
    assert len(comparison(tmp_path, 1, methods=twins, seeds=1).contestants) == 1
    ordered = [
        Method.parse(f"step,{told}", 3)
        for told in ("stall=1,start_time=0.7", "start_time=0.7,stall=1")
    ]
    assert ordered[0] == ordered[1] and ordered[0].config() == ordered[1].config()
