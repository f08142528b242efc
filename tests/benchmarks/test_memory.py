"""The experiment over finished runs that docs/benchmarks.md walks through."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("tyro")

import memory

from tests.benchmarks.script_parts import is_png, refused
from tests.benchmarks.test_report import row


def run(folder, *rows):
    folder.mkdir()
    (folder / "results.jsonl").write_text("".join(json.dumps(one) + "\n" for one in rows))
    return str(folder)


def test_gains_of_all_runs_stand_beside_what_is_remembered(tmp_path, capsys):
    base, past = row(5, memory_gain=0.0), row(8, prior="past", memory_gain=0.25)
    one = run(tmp_path / "one", base, past)
    two = run(tmp_path / "two", base | {"task": "can"}, past | {"task": "can", "memory_gain": None})
    assert memory.main([one, two, "--out", str(tmp_path / "a.png")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    # The first method has no gain, and what was not measured no point.
    assert lines[2:] == ["| Square-PH | 1 | WP-Past | 0.250 | +30.0% |"]
    assert is_png(tmp_path / "a.png")
    assert "no method beside their first" in refused(memory.main, [run(tmp_path / "none", base)], capsys)
