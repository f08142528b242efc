"""The comparison with Real-Time Chunking from the command line: rows, pictures, resuming, errors."""

from __future__ import annotations

import json

import pytest

from tests.benchmarks.script_parts import (
    command_line,
    described,
    is_png,
    options,
    stored,
    written,
)

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import real_time_chunking as script

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")

TINY = {
    "iterations": 20,
    "episodes": 2,
    "envs": 1,
    "nfe": 2,
    "logger": "none",
    "hidden_dim": 16,
    "prior": ["gaussian", "past"],
}


def test_a_task_beside_the_toy(dataset, tmp_path, capsys):
    out = tmp_path / "out"
    argv = options(
        dataset,
        out,
        **TINY | {"episodes": 1, "prior": ["gaussian", "preview"], "delay": [0, 3]},
        rtc__schedule="linear",
    )
    assert script.main(argv) == 0
    rows = stored(out)
    cells = [(row["task"], row["prior"], row["delay"], row["guidance"], row["execute"]) for row in rows]
    assert cells == [
        (task, prior, delay, guidance, 5)  # of 8, as many as the largest delay leaves
        for task in ("lift", "navigation")
        for prior in ("gaussian", "preview")
        for delay in (0, 3)
        for guidance in ("none", "rtc")
    ]
    report = (out / "report.md").read_text()
    for method in ("Base", "RTC", "WP-Preview", "RTC + WP-Preview"):
        assert f"| Lift-PH | 2 | 3 | {method} |" in report
    assert "schedule linear" in report and report.partition("\n\nColumns")[0] in capsys.readouterr().out
    assert is_png(out / "real_time_chunking.png")
    # The latency and the guidance change what is done, and not what is trained.
    lift = [row for row in rows if row["task"] == "lift"]
    assert len({row["boundary_jump"] for row in lift}) == len(lift)
    assert len({row["policy"] for row in rows}) == 4
    kept = described(out, "options")["options"]
    assert kept["rtc"]["schedule"] == "linear" and kept["delay"] == [0, 3]


def test_it_continues_with_the_rows_that_are_missing(tmp_path):
    out = tmp_path / "out"
    argv = command_line(**TINY, toy="alone", delay=[0, 1], chunk=4, out=out)
    assert script.main(argv) == 0
    before, policies = stored(out), written(tmp_path)
    assert {row["task"] for row in before} == {"navigation"} and len(before) == 2 * 2 * 2
    assert {row["execute"] for row in before} == {3}
    kept = [*before[:3], *before[6:]]
    (out / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept))
    assert script.main(command_line(resume=[], out=out)) == 0
    assert stored(out) == before and written(tmp_path) == policies
