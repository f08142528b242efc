"""The toy's benchmark from the command line: files, rows, errors."""

from __future__ import annotations

import importlib
import math

import pytest

from tests.benchmarks.script_parts import command_line, having, is_png, refused, stored, written

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

from warmprior.experiments import Row


@pytest.fixture(scope="module")
def benchmark():
    return importlib.import_module("navigation1d")


@pytest.mark.filterwarnings("ignore:.*curvature is NaN")
def test_run_writes_results_table_and_pictures(benchmark, tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    argv = command_line(iterations=5, episodes=4, chunk=32, envs=1, logger="none", out=out)
    assert benchmark.main(argv) == 0
    result = stored(out)
    played, curved = having(result["rows"], "collision_rate"), having(result["rows"], "kappa")
    assert len(played) + len(curved) == len(result["rows"])
    policies = {(row["prior"], row["sigma"]) for row in played}
    warm = {(name, sigma) for name in ("past", "preview") for sigma in (0.1, 0.5)}
    assert len(policies) == 7 and warm < policies
    # All but the regression at 9 and at 1 network evaluation.
    assert len(played) == 7 * 2 - 1
    fields = (
        "task prior sigma chunk seed nfe switch_rate collision_rate route_entropy distance jerk"
    )
    for row in played:
        assert set(fields.split()) <= set(row)
        assert (row["task"], row["chunk"], row["iterations"]) == ("navigation", 32, 5)
    assert {row["seed"] for row in curved} == {0}
    assert {(row["prior"], row["sigma"]) for row in curved} == policies - {("regression", 0.0)}
    deployed = {row["prior"] for row in curved if row["mean"] == "deployed"}
    assert deployed == {"history", "past", "preview"}
    assert {"versions", "hardware", "identity", "policies", "wall_time_s"} <= set(result["meta"])
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out
    assert table.count("\n") == 2 + 7 * 2 - 1
    for picture in ("navigation1d.png", "flow_paths.png"):
        assert is_png(out / picture)

    # A folder with results is left alone, unless its policies are to be reused.
    assert "--resume" in refused(benchmark.main, argv, capsys)
    before = written(out.parent)
    assert before
    assert benchmark.main([*argv, "--resume"]) == 0
    assert stored(out)["rows"] == result["rows"] and written(out.parent) == before
    # Another recipe does not fit these policies.
    told = refused(benchmark.main, [*argv, "--resume", "--cold-probability", "0.5"], capsys)
    assert "was started with --cold-probability 0.1" in told


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--seeds 0", "--seeds must be"),
        ("--nfe 0", "--nfe must be"),
        ("--episodes 0", "--episodes must be"),
        ("--chunk 0", "--chunk must be"),
        ("--chunk 64", "--chunk must be between 1 and 32, got 64"),
        ("--chunk 4 8", "this study has one --chunk"),
        ("--iterations 0", "iterations must be at least 1"),
        ("--cold-probability 2", "cold_probability"),
        ("--task lift --data mh", "demonstrations and an end of its own: leave out --data, --task"),
        ("--play-on", "leave out --play-on"),
    ],
)
def test_bad_options_stop_before_any_work(benchmark, tmp_path, capsys, no_work, words, message):
    out = tmp_path / "runs" / "out"
    told = refused(benchmark.main, [*words.split(), "--out", out], capsys)
    assert message in told
    assert not out.exists() and not (tmp_path / "runs" / "policies").exists()


def test_a_training_that_diverges_ends_without_a_traceback(benchmark, tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    argv = command_line(learning_rate=1e30, iterations=40, save_every=10, prior="past", out=out)
    told = refused(benchmark.main, argv, capsys)
    assert told.startswith("navigation1d.py: error: ") and "nan" in told.lower()
    assert stored(out)["rows"] == [] and not (out / "table.md").exists()


def test_a_picture_that_cannot_be_drawn_costs_no_table(benchmark, tmp_path, capsys, monkeypatch):
    def broken(*args):
        raise ValueError("no picture")

    monkeypatch.setattr(benchmark, "draw", broken)
    out = tmp_path / "out"
    argv = command_line(
        iterations=2,
        episodes=2,
        chunk=32,
        nfe=1,
        prior="gaussian",
        sigma=None,
        envs=1,
        logger="none",
        out=out,
    )
    assert "no picture" in refused(benchmark.main, argv, capsys)
    assert "| Base, NFE 1 |" in (out / "table.md").read_text()


def test_table_tells_what_is_missing(benchmark):
    def rows(prior, seed, nfe=1, **measures):
        facts = {"prior": prior, "sigma": 1.0, "chunk": 4, "seed": seed}
        yield Row(facts | {"nfe": nfe}, {"collision_rate": 0.0} | measures)

    def curvature(prior, seed, mean, kappa):
        facts = {"prior": prior, "sigma": 1.0, "chunk": 4, "seed": seed, "mean": mean}
        yield Row(facts, {"kappa_executed": kappa})

    lines = benchmark.make_table(
        [
            *rows("past", 0, switch_rate=0.25),
            *rows("past", 1, switch_rate=0.75),
            *rows("gaussian", 0, switch_rate=math.nan),
            *curvature("past", 0, "training", math.nan),
            *curvature("past", 1, "training", 1.0),
            *curvature("past", 1, "deployed", 7.0),  # not this mean's
        ]
    ).splitlines()
    assert lines[2].startswith("| WP-Past, NFE 1 | 0.500 ± 0.354 |")
    assert "| 1.000 (1 not finite) |" in lines[2] and "7.0" not in lines[2]
    cells = [cell.strip() for cell in lines[3].strip("|").split("|")]
    collisions = 1 + list(benchmark.COLUMNS).index("collisions")
    assert cells.pop(collisions) == "0.000"
    assert cells.pop(0) == "Base, NFE 1" and set(cells) == {"-"}


def test_curvature_stands_beside_the_largest_number_of_evaluations(benchmark):
    facts = {"prior": "past", "sigma": 0.5, "chunk": 4, "seed": 0}
    rows = [Row(facts | {"nfe": nfe}, {"collision_rate": nfe / 10}) for nfe in (9, 1)]
    curved = Row(facts | {"mean": "training"}, {"kappa_executed": 2.5})
    first, second = benchmark.make_table([*rows, curved]).splitlines()[2:]
    assert first.startswith("| WP-Past, NFE 9 |") and "0.900" in first and "2.500" in first
    assert second.startswith("| WP-Past, NFE 1 |") and "0.100" in second and "2.500" not in second
