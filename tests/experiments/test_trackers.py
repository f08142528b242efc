"""How far jobs are, and what they gave, as other processes read it."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import comparison
from warmprior.experiments import Condition, EvaluationOptions, trackers
from warmprior.experiments.cell_outcome import CellOutcome
from warmprior.experiments.contestant import Cell
from warmprior.experiments.trackers import FileTracker, MemoryTracker
from warmprior.experiments.worker import Measure, Play, PlayCell, Train
from warmprior.modules.real_time_chunking import RealTimeChunking

CELL = Cell(20, 3, Condition())
JOB = PlayCell(0, CELL, range(5, 8))


@pytest.fixture
def contestants(tmp_path):
    return comparison(tmp_path, 1).contestants


def unwanted():
    pytest.fail("computed again")


def test_results_are_found_again_exactly(tmp_path, contestants):
    given = {
        JOB: CellOutcome([True, False, True], {"mean_steps": 0.1 + 0.2, "boundary_jump": None}),
        Measure(0): {3: {"kappa": 1 / 3, "source_leak": None}, 1: {"kappa": 1e-310}},
    }
    first = FileTracker(tmp_path / "cells", contestants, EvaluationOptions())
    for job, result in given.items():
        assert first.result(job, lambda result=result: result) == result
    again = FileTracker(tmp_path / "cells", contestants, EvaluationOptions())
    assert {job: again.result(job, unwanted) for job in given} == given
    undefined = again.result(Measure(1), lambda: {1: {"kappa": math.nan}})
    assert math.isnan(undefined[1]["kappa"])
    again.remove()
    assert not (tmp_path / "cells").exists()


def test_other_jobs_policies_and_options_have_other_files(tmp_path, contestants):
    guided = Condition(delay=2, execute=2, guidance=RealTimeChunking())
    jobs = [
        JOB,
        Measure(0),
        PlayCell(1, CELL, range(5, 8)),
        PlayCell(0, Cell(10, 3, Condition()), range(5, 8)),
        PlayCell(0, Cell(20, 1, Condition()), range(5, 8)),
        PlayCell(0, Cell(20, 3, guided), range(5, 8)),
    ]
    for options in (EvaluationOptions(), EvaluationOptions(episodes=3)):
        tracker = FileTracker(tmp_path, contestants, options)
        for job in jobs:
            empty = {} if isinstance(job, Measure) else CellOutcome([], {})
            tracker.result(job, lambda empty=empty: empty)
    assert len(list(tmp_path.glob("*.json"))) == 2 * len(jobs)


def test_a_damaged_result_is_named_and_kept(tmp_path, contestants):
    tracker = FileTracker(tmp_path, contestants, EvaluationOptions())
    tracker.result(JOB, lambda: CellOutcome([True], {}))
    (path,) = tmp_path.glob("*.json")
    path.write_text('{"successes": [tr')
    with pytest.raises(ValueError, match=path.name):
        tracker.result(JOB, unwanted)


def test_others_see_how_far_a_job_is(tmp_path, contestants, monkeypatch):
    writer, reader = (FileTracker(tmp_path, contestants, EvaluationOptions()) for _ in range(2))
    assert reader.count(JOB) == 0
    writer.report(JOB, 1)
    writer.report(JOB, 2)  # too soon to be told
    assert reader.count(JOB) == 1 and reader.count(Train(0)) == 0
    monkeypatch.setattr(trackers, "REPORT_EVERY", 0.0)
    writer.report(Train(1), 7)
    assert reader.count(Train(1)) == 7 and reader.count(Train(0)) == 0


def test_in_memory_only_trainings_are_counted():
    tracker = MemoryTracker(2)
    tracker.report(Train(1), 7)
    assert tracker.count(Train(1)) == 7 and tracker.count(Train(0)) == 0
    assert tracker.count(Play(1, CELL, 5)) == 0 and tracker.result(JOB, lambda: 3) == 3


def test_a_training_waits_for_a_process_that_is_about_to_end(tmp_path, contestants, monkeypatch):
    tracker, attempts = FileTracker(tmp_path, contestants, EvaluationOptions()), []

    def train():
        attempts.append(None)
        if len(attempts) < 3:
            raise BlockingIOError("in use by another process")
        return [(20, 0.5)]

    monkeypatch.setattr(trackers, "LOCK_POLL", 0.01)
    assert tracker.result(Train(0), train) == [(20, 0.5)] and len(attempts) == 3
    attempts.clear()
    monkeypatch.setattr(trackers, "LOCK_PATIENCE", 0.0)
    with pytest.raises(BlockingIOError):
        tracker.result(Train(0), train)
