"""Rows on disk: what is kept, continued and refused."""

from __future__ import annotations

import json
import math

import pytest

pytest.importorskip("tyro")

from tests.experiments.row_parts import FACTS, compared, row
from warmprior.experiments import Results, Row, grouped, mean_known, select, success_summary

META = {"problems": []}
IDENTITY = {"study": "test", "recipe": {"betas": (0.9, 0.999)}}


def filled(tmp_path):
    results = Results(tmp_path / "results.json", META, IDENTITY)
    for each in compared():
        results.add(each)
    return results


def resumed(path, identity=IDENTITY):
    return Results(path, META, identity, resume=True)


def test_rows_survive_and_resume(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    assert stored["meta"]["problems"] == [] and stored["meta"]["wall_time_s"] > 0
    assert stored["rows"][1]["facts"] == FACTS
    assert stored["rows"][1]["measures"]["success_rate"] == 0.4
    again = resumed(results.path)
    assert again.rows == results.rows
    assert again.find(FACTS)["successes"] == 4
    assert again.find(FACTS).outcomes == "1111000000"
    assert again.find(FACTS | {"nfe": 3}) is None
    assert Results(results.path, META, IDENTITY).rows == []  # without resume


def test_the_time_of_all_attempts_is_told(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    stored["meta"]["wall_time_s"] = 1_000.0
    results.path.write_text(json.dumps(stored))
    again = resumed(results.path)
    again.save()
    assert 1_000 < json.loads(results.path.read_text())["meta"]["wall_time_s"] < 2_000


def test_a_row_of_the_same_facts_takes_the_place_of_the_old(tmp_path):
    results = filled(tmp_path)
    results.add(row(9), order=lambda row: (row["prior"], row["seed"], row["checkpoint"]))
    assert len(results.rows) == 18 and results.rows[1] == row(9)
    assert resumed(results.path).rows == results.rows
    results.add(row(8))  # without an order the new ones come last
    assert results.rows[-1] == row(8) and len(results.rows) == 18


def test_what_is_not_known_is_null_in_the_file(tmp_path):
    results = Results(tmp_path / "results.json", META, IDENTITY)
    nan, inf = math.nan, math.inf
    results.add(row(measures={"boundary_jump": nan, "ratio": inf, "inner_jump": None}))
    text = results.path.read_text()
    assert "NaN" not in text and "Infinity" not in text
    measures = json.loads(text)["rows"][0]["measures"]
    assert [measures[name] for name in ("boundary_jump", "ratio", "inner_jump")] == [None] * 3
    assert resumed(results.path).rows == results.rows


def test_damaged_file_is_named(tmp_path):
    path = tmp_path / "results.json"
    text = {"meta": {"identity": IDENTITY, "wall_time_s": 1.0}, "rows": [{"task": 1}]}
    path.write_text(json.dumps(text))
    with pytest.raises(ValueError, match=r"results\.json.*row 0"):
        resumed(path)


def test_resuming_another_runs_file_is_refused(tmp_path):
    results = filled(tmp_path)
    same = {"study": "test", "recipe": {"betas": (0.9, 0.999)}}
    assert resumed(results.path, same).rows == results.rows
    other = {"study": "test", "recipe": {"betas": (0.9, 0.99)}}
    with pytest.raises(ValueError, match=r"results\.json belongs to another recipe: .*0\.999"):
        resumed(results.path, other)
    with pytest.raises(ValueError, match="belongs to another study: it has test"):
        resumed(results.path, IDENTITY | {"study": "another"})


def test_a_run_whose_policies_other_versions_trained_is_refused(tmp_path):
    def meta(number, torch, *folders):
        policies = [{"seed": i, "folder": folder} for i, folder in enumerate(folders)]
        return {"versions": {"warmprior": number, "torch": torch}, "policies": policies}

    path, mine = tmp_path / "results.json", meta("0.2.0", "2.11.0", "a-2", "b-2")
    for theirs, told in (
        (meta("0.1.0", "2.11.0", "a-1", "b-1"), "begun with warmprior 0.1.0, not 0.2.0: other"),
        (meta("0.2.0", "2.10.0", "a-1", "b-1"), "begun with torch 2.10.0, not 2.11.0: other"),
        (meta("0.1.0", "2.10.0", "a-1", "b-1"), "0.1.0, not 0.2.0 and torch 2.10.0, not 2.11.0"),
        (meta("0.2.0", "2.11.0", "a-1", "b-1"), "another build of this version"),
    ):
        Results(path, theirs, IDENTITY).save()
        with pytest.raises(ValueError, match=rf"results\.json was .*{told}.*another --out"):
            Results(path, mine, IDENTITY, resume=True)
    Results(path, meta("0.2.0", "2.11.0", "b-2"), IDENTITY).save()
    Results(path, mine, IDENTITY, resume=True)  # those of a failed seed may be missing


def test_summary_takes_the_best_checkpoints_of_each_seed():
    cell = select(compared(), prior="past", nfe=1)
    summary = success_summary(cell, top_k=1)
    assert summary.mean == pytest.approx(0.8)
    assert summary.std == pytest.approx(0.1)
    assert summary.seeds == 3
    assert success_summary(cell, top_k=2).mean == pytest.approx(0.4)


def test_rows_are_found_by_their_facts_and_measures():
    rows = [*compared(), Row({"prior": "past", "seed": None}, {"ratio": None})]
    assert select(rows, "ratio") == rows[-1:]  # known or not
    assert select(rows, seed=None) == rows[-1:]  # a fact that others lack is no match
    assert select(rows, prior="past", seed=1) == rows[8:10]
    assert [row["successes"] for row in select(rows, "success_rate", prior="past")][1::2] == [
        7,
        8,
        9,
    ]
    groups = grouped(rows, lambda row: row["prior"])
    assert list(groups) == ["gaussian", "past", "preview"] and len(groups["past"]) == 7
    assert mean_known(groups["past"], "success_rate") == pytest.approx(
        0.4
    )  # of the six that have it
    assert mean_known(rows, "ratio") is None
    with pytest.raises(KeyError, match="nfe"):
        rows[-1]["nfe"]


def test_a_memory_gain_may_be_negative(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    stored["rows"][2]["measures"]["memory_gain"] = -0.1
    results.path.write_text(json.dumps(stored))
    assert resumed(results.path).rows[2]["memory_gain"] == -0.1


@pytest.mark.parametrize(
    ("part", "change", "said"),
    [
        ("measures", {"successes": 99, "episodes": 2}, "99 successes in 2 episodes"),
        ("measures", {"successes": -1}, "successes"),
        ("measures", {"episodes": 0, "successes": 0}, "episodes"),
        ("measures", {"episodes": 10.0}, "episodes"),
        ("measures", {"episodes": True, "successes": 1}, "episodes"),
        ("measures", {"successes": "5"}, "successes"),
        ("facts", {"task": 3}, "task"),
        ("facts", {"task": ["square"]}, "task"),
        ("facts", {"nfe": 0}, "nfe"),
        ("facts", {"nfe": 1.5}, "nfe"),
        ("facts", {"chunk": 0}, "chunk"),
        ("facts", {"sigma": -1.0}, "sigma"),
        ("facts", {"sigma": None}, "sigma"),
        ("facts", {"seed": -1}, "seed"),
        ("measures", {"mean_steps": -1.0}, "mean_steps"),
        ("measures", {"source_leak": "high"}, "source_leak"),
        ("measures", {"inner_jump": -0.5}, "inner_jump"),
        ("measures", {"memory_gain": "high"}, "memory_gain"),
        ("measures", {"success_rate": 0.9}, "success_rate"),
        ("measures", {"success_rate": None}, "successes"),
        (None, {"outcomes": "11111"}, "5 successes in 5 episodes"),
        (None, {"outcomes": "12"}, "outcomes"),
        (None, {"outcomes": [1, 0]}, "outcomes"),
        (None, {"unknown": 1}, "unknown"),
    ],
    ids=str,
)
def test_rows_that_cannot_have_been_measured(tmp_path, part, change, said):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    changed = stored["rows"][2]
    if part is not None:
        changed = changed[part]
    changed |= change
    counts = [changed.get(name) for name in ("successes", "episodes")]
    if {"successes", "episodes"} & change.keys() and "5" not in counts and counts[1]:
        changed["success_rate"] = counts[0] / counts[1]
    results.path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=rf"(?s)results\.json.*row 2.*{said}"):
        resumed(results.path)


def test_rows_that_contradict_each_other(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    stored["rows"].append(json.loads(json.dumps(stored["rows"][2])))  # once more does no harm
    results.path.write_text(json.dumps(stored))
    assert resumed(results.path).rows == results.rows
    stored["rows"][-1]["measures"]["mean_steps"] = 3.0
    results.path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"results\.json.*row 18 contradicts row 2"):
        resumed(results.path)


@pytest.mark.parametrize(
    "text",
    ["", "[" * 100_000, "[]", "null", '{"rows": 3, "meta": {}}', '{"rows": [], "meta": {}}'],
    ids=range(6),
)
def test_a_file_that_is_no_results(tmp_path, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"results\.json"):
        resumed(path)
