"""The comparison with Real-Time Chunking from the command line: rows, pictures, resuming, errors."""

from __future__ import annotations

import importlib
import json
import re

import pytest

from tests.benchmarks.script_parts import command_line, is_png, options, refused, stored, written

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

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


@pytest.fixture(scope="module")
def script():
    return importlib.import_module("real_time_chunking")


def test_a_task_beside_the_toy(script, dataset, tmp_path, capsys):
    out = tmp_path / "out"
    argv = options(
        dataset,
        out,
        **TINY | {"episodes": 1, "prior": ["gaussian", "preview"], "delay": [0, 3]},
        rtc__schedule="linear",
    )
    assert script.main(argv) == 0
    result = stored(out)
    cells = [
        (row["task"], row["prior"], row["delay"], row["guidance"], row["execute"])
        for row in result["rows"]
    ]
    assert cells == [
        (task, prior, delay, guidance, 5)  # of 8, as many as the largest delay leaves
        for task in ("lift", "navigation")
        for prior in ("gaussian", "preview")
        for delay in (0, 3)
        for guidance in ("none", "rtc")
    ]
    table = (out / "table.md").read_text()
    assert "|  | Base | RTC | WP-Preview | RTC + WP-Preview |" in table
    assert "| lift ph, NFE 2, delay 3, success (%) |" in table and "schedule linear" in table
    assert table in capsys.readouterr().out
    assert is_png(out / "real_time_chunking.png")
    # The latency and the guidance change what is done, and not what is trained.
    lift = [row for row in result["rows"] if row["task"] == "lift"]
    assert len({row["boundary_jump"] for row in lift}) == len(lift)
    assert len(result["meta"]["policies"]) == 4
    identity = result["meta"]["identity"]["recipe"]
    assert identity["rtc"]["schedule"] == "linear" and identity["delay"] == [0, 3]


def test_it_continues_with_the_rows_that_are_missing(script, tmp_path):
    out = tmp_path / "out"
    argv = command_line(**TINY, toy="alone", delay=[0, 1], chunk=4, out=out)
    assert script.main(argv) == 0
    before, policies = stored(out)["rows"], written(tmp_path)
    assert {row["task"] for row in before} == {"navigation"} and len(before) == 2 * 2 * 2
    assert {row["execute"] for row in before} == {3}
    path = out / "results.json"
    result = json.loads(path.read_text())
    del result["rows"][3:6]
    path.write_text(json.dumps(result))
    assert script.main(command_line(resume=[], out=out)) == 0
    assert stored(out)["rows"] == before and written(tmp_path) == policies


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"delay": 5},
            r"--delay 5 with --execute 3 and gaussian.*too long for predictions of 8 actions.*at most 4",
        ),
        (
            {"delay": 2, "execute": 7},
            r"--delay 2 with --execute 7 and gaussian, which predicts 8.*at most 6",
        ),
        ({"delay": 3, "rtc__horizon": 2}, r"horizon=2, before the delay of 3"),
        ({"execute": 9}, r"--execute must be between 1 and 8"),
        ({"delay": -1}, r"--delay must be between 0"),
        ({"chunk": [4, 8]}, r"one --chunk"),
        ({"play_on": []}, r"leave out --play-on, or add --toy no"),
        ({"prior": "regression", "nfe": 1, "guidance": "rtc"}, r"regression is no flow to guide"),
        ({"rtc__max_guidance_weight": 0}, r"max_guidance_weight must be > 0"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(script, no_work, given, told, tmp_path, capsys):
    line = refused(script.main, command_line(**given, out=tmp_path / "out"), capsys)
    assert re.search(told, line), line
