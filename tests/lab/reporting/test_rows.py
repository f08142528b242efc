import json
import math

import pytest

from lab.reporting.rows import AGENT, PLAYED, read_rows
from tests.errors import raises, refuses

ROW = {
    **{"task": "lift", "data": "ph", "prior": "past", "options": "", "sigma": 0.5, "chunk": 8, "seed": 0},
    **{
        "iterations": 30,
        "policy": "lift-ph-past-seed0-01234",
        "checkpoint": 30,
        "nfe": 9,
        "temperature": 1.0,
    },
    **{"episodes": 4, "successes": 3, "success_rate": 0.75, "outcomes": "1011", "mean_steps": 31.5},
    **{"boundary_jump": None, "kappa": 0, "episode_side": 0.5, "training_seconds": 12.0},
}
OTHER = ROW | {"nfe": 1}


def read(folder, *rows, needed=PLAYED):
    path = folder / "results.jsonl"
    path.write_text("".join(f"{row if isinstance(row, str) else json.dumps(row)}\n" for row in rows))
    return read_rows(path, needed)


def test_what_is_written_is_read(tmp_path):
    assert read(tmp_path, ROW, OTHER) == [ROW, OTHER]
    average = {"policy": "past, H = 8", "mean": "training", "seed": None, "kappa": 0.5}
    assert read(tmp_path, average, needed=()) == [average]
    assert read(tmp_path) == []


COUNTS = ("episodes", "successes", "success_rate", "seed")  # they hang together in any file


@pytest.mark.parametrize(
    ("name", "needed"), [*((name, PLAYED) for name in PLAYED), *((name, ()) for name in COUNTS)]
)
def test_a_column_that_is_missing(tmp_path, name, needed):
    without = {key: value for key, value in ROW.items() if key != name}
    refuses(lambda: read(tmp_path, OTHER, without, needed=needed), ValueError, "results.jsonl, line 2", name)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("seed", "nfe", "checkpoint") for value in ("0", 0.5, None, True, [0])],
        *[(name, value) for name in ("task", "outcomes", "policy") for value in (3, None, ["1"])],
        *[("mean_steps", value) for value in ("31.5", math.nan, math.inf, False, {})],
        *[("sigma", None), ("success_rate", None), ("suceesses", 3)],
        *[("outcomes", "1010"), ("outcomes", "10112")],
    ],
)
def test_a_value_that_cannot_be(tmp_path, name, value):
    refuses(lambda: read(tmp_path, ROW | {name: value}), ValueError, "results.jsonl, line 1", name)


@pytest.mark.parametrize(
    ("name", "value"),
    [("successes", 5), ("successes", -1), ("episodes", 0), ("episodes", 5), ("success_rate", 0.5)],
)
def test_counts_that_contradict(tmp_path, name, value):
    row = ROW | {name: value}
    said = (f"{row['successes']} successes", f"{row['episodes']} episodes", f"rate of {row['success_rate']}")
    refuses(lambda: read(tmp_path, row), ValueError, "results.jsonl, line 1", *said)


def test_lines_that_cannot_be(tmp_path):
    # A row twice, also with other results: one of them would count as another training.
    for again in (ROW, ROW | {"successes": 1, "success_rate": 0.25, "outcomes": "1000"}):
        with raises(ValueError, "results.jsonl, line 3", "line 1"):
            read(tmp_path, ROW, OTHER, again)
    refuses(lambda: read(tmp_path, ROW, needed=AGENT), ValueError, "results.jsonl, line 1", "algorithm")
    for line in ("[1]", "{", '"text"', "1e400", "[" * 100_000):
        with raises(ValueError, "results.jsonl, line 2"):
            read(tmp_path, ROW, line)
