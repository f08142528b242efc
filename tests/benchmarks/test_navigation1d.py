"""The toy's benchmark from the command line: files, rows, errors."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "navigation1d.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_navigation1d", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore:.*curvature is NaN")
def test_run_writes_results_table_and_pictures(benchmark, tmp_path, capsys):
    out = tmp_path / "out"
    argv = ["--iterations", "5", "--rollouts", "4", "--chunk", "32", "--out", str(out)]
    assert benchmark.main(argv) == 0
    stored = json.loads((out / "results.json").read_text())
    assert len(stored["rows"]) == 7
    fields = "policy prior sigma seed switch_rate collision_rate route_entropy kappa"
    for row in stored["rows"]:
        assert set(fields.split()) <= set(row) and row["chunk"] == 32
    assert [row["kappa"] for row in stored["rows"] if row["prior"] == "regression"] == [None]
    assert {"versions", "hardware", "training", "priors", "wall_time_s"} <= set(stored["meta"])
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out
    assert table.count("\n") == 2 + 7
    for picture in ("navigation1d.png", "flow_paths.png"):
        assert (out / picture).read_bytes().startswith(b"\x89PNG")

    # A folder with results is left alone, unless its policies are to be reused.
    assert benchmark.main(argv) == 2
    assert "--resume" in capsys.readouterr().err
    assert benchmark.main([*argv, "--resume"]) == 0
    assert json.loads((out / "results.json").read_text())["rows"] == stored["rows"]
    # Another recipe does not fit these policies.
    assert benchmark.main([*argv, "--resume", "--cold-probability", "0.5"]) == 2
    assert "another prior" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("seeds", "0"),
        ("nfe", "0"),
        ("rollouts", "0"),
        ("chunk", "0"),
        ("chunk", "64"),
        ("iterations", "0"),
        ("cold-probability", "2"),
    ],
)
def test_bad_options_stop_before_any_work(benchmark, tmp_path, capsys, option, value):
    out = tmp_path / "out"
    assert benchmark.main([f"--{option}", value, "--out", str(out)]) == 2
    assert "error" in capsys.readouterr().err and not (out / "results.json").exists()


def test_a_training_that_diverges_ends_without_a_traceback(
    benchmark, tmp_path, capsys, monkeypatch
):
    def diverge(study, seed):
        raise FloatingPointError("the loss became nan")

    monkeypatch.setattr(benchmark, "run_seed", diverge)
    assert benchmark.main(["--out", str(tmp_path / "out")]) == 2
    assert "error: the loss became nan" in capsys.readouterr().err


def test_table_tells_what_is_missing(benchmark):
    rows = [
        {"policy": "a", "switch_rate": 0.25, "kappa_executed": math.nan},
        {"policy": "a", "switch_rate": 0.75, "kappa_executed": 1.0},
        {"policy": "b", "switch_rate": math.nan},
    ]
    lines = benchmark.table(rows, ["a", "b"]).splitlines()
    assert "0.500 ± 0.354" in lines[2] and "1.000 (1 not finite)" in lines[2]
    assert set(lines[3].replace("| b |", "").split()) <= {"-", "|"}
