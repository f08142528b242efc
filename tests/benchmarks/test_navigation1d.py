"""The toy's benchmark from the command line: files, rows, errors."""

from __future__ import annotations

import pytest

from tests.benchmarks.script_parts import command_line, is_png, refused, stored, written

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

import navigation1d


@pytest.mark.filterwarnings("ignore:.*curvature is NaN")
def test_run_writes_rows_report_and_pictures(tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    few = {"prior": ["gaussian", "regression", "past"], "iterations": 5, "episodes": 4, "chunk": 32}
    argv = command_line(**few, envs=1, logger="none", out=out)
    assert navigation1d.main(argv) == 0
    played, curved = stored(out), stored(out, "curvature")
    policies = {(row["prior"], row["sigma"]) for row in played}
    assert policies == {("gaussian", 1.0), ("regression", 0.0), ("past", 0.1), ("past", 0.5)}
    # All but the regression at 9 and at 1 network evaluation.
    assert len(played) == 4 * 2 - 1
    fields = "task prior sigma chunk seed nfe switch_rate collision_rate route_entropy distance"
    for row in played:
        assert set(fields.split()) <= set(row)
        assert (row["task"], row["chunk"], row["iterations"]) == ("navigation", 32, 5)
    assert {row["seed"] for row in curved} == {0}
    assert {(row["prior"], row["sigma"]) for row in curved} == policies - {("regression", 0.0)}
    deployed = {row["prior"] for row in curved if row["mean"] == "deployed"}
    assert deployed == {"past"}
    report = (out / "report.md").read_text()
    assert report.partition("\n\nColumns")[0] in capsys.readouterr().out
    for picture in ("navigation1d.png", "flow_paths.png"):
        assert is_png(out / picture)

    # A folder with results is left alone, unless its policies are to be reused.
    assert "--resume" in refused(navigation1d.main, argv, capsys)
    before = written(out.parent)
    assert before and navigation1d.main([*argv, "--resume"]) == 0
    assert stored(out) == played and written(out.parent) == before
    # Another recipe does not fit these policies.
    said = refused(navigation1d.main, [*argv, "--resume", "--cold-probability", "0.5"], capsys)
    assert "was started with other values of --cold-probability" in said
