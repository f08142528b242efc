"""What is trained and played when, and what a failure stops."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.script import PartialFailure

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import (
    METHODS,
    DriftEnv,
    H,
    comparison,
    drift_problem,
    rows_of,
)
from warmprior.experiments import Comparison, Condition, Method, Store
from warmprior.experiments.contestant import Cell
from warmprior.experiments.schedule import Schedule
from warmprior.experiments.worker import Measure, Play, Train


def started(schedule):
    """All jobs that may start now."""
    return list(iter(schedule.next, None))


CELL = Cell(checkpoint=10, nfe=1, condition=Condition())
FOLLOWING = {n: [Measure(n), Play(n, CELL, 0)] for n in range(4)}


def test_the_last_trainings_alone_start_at_once():
    schedule = Schedule([2, 0, 1, 3], FOLLOWING, teachers={}, workers=2, trainings_at_once=1)
    assert started(schedule) == [Train(2)]
    schedule.trained(2)
    # Three trainings are left for two workers: what is ready comes first.
    assert [schedule.next(), schedule.next()] == FOLLOWING[2]
    assert started(schedule) == [Train(0)]
    schedule.trained(0)
    assert started(schedule) == [Train(1), *FOLLOWING[0]]


def test_what_a_failure_ends_is_told_once_and_never_starts():
    schedule = Schedule([0, 1, 2], FOLLOWING, teachers={1: 0, 2: 0}, workers=3)
    assert started(schedule) == [Train(0)]
    schedule.trained(0)
    assert schedule.next() == Train(1)
    assert schedule.failed(Train(1)) == [1]
    assert schedule.failed(Measure(0)) == [0, 2]
    assert schedule.failed(Play(0, CELL, 0)) == [] and started(schedule) == []


class WaitsForAnEpisode(Store):
    """The last training does not end before an episode was played."""

    def train(self, method, training, progress=None):
        deadline = time.monotonic() + 30
        while method.name == "preview" and not any(self.problem.make_env().log.iterdir()):
            assert time.monotonic() < deadline, "nothing was played while this training ran"
            time.sleep(0.05)
        return super().train(method, training, progress)


def test_a_policy_is_played_before_the_last_training_ended(tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    comparison(
        tmp_path, 2, kind=WaitsForAnEpisode, problem=drift_problem(DriftEnv(log)), seeds=1
    ).run()


class Timed(Store):
    """Notes when its trainings ran."""

    def train(self, method, training, progress=None):
        started = time.monotonic()
        losses = super().train(method, training, progress)
        time.sleep(0.2)
        note = {"from": started, "to": time.monotonic()}
        (self.directory / f"{method.name}-{training.seed}.json").write_text(json.dumps(note))
        return losses


@pytest.mark.parametrize("at_once", [None, 1])
def test_trainings_share_a_device_only_where_they_may(tmp_path, monkeypatch, at_once):
    """One at a time, as beside CUDA, and the others' episodes meanwhile."""
    monkeypatch.setattr(Comparison, "trainings_at_once", at_once)
    comparison(tmp_path, 3, kind=Timed).run()
    notes = [json.loads(path.read_text()) for path in (tmp_path / "policies").glob("*.json")]
    notes.sort(key=lambda note: note["from"])
    apart = [a["to"] <= b["from"] for a, b in pairwise(notes)]
    assert len(notes) == 6 and (all(apart) if at_once else not all(apart))


def test_a_student_waits_for_its_teacher(tmp_path, capsys):
    """Whatever the order; and without the teacher in the comparison, it is trained on the way."""
    methods = [Method("reflow", H, {"teacher_nfe": 2}), Method("gaussian", H)]
    compared = comparison(tmp_path / "both", 3, methods=methods, seeds=1)
    compared.run()
    told = capsys.readouterr().out
    assert told.index("trained drift own, gaussian") < told.index("trained drift own, reflow")
    comparison(tmp_path / "one", 2, methods=methods[:1], seeds=1).run()
    both, one = rows_of(tmp_path / "both"), rows_of(tmp_path / "one")
    assert [row["prior"] for row in both] == ["reflow"] * 4 + ["gaussian"] * 4 and both[:4] == one
    reflow, gaussian = (c.policy().network.state_dict() for c in compared.contestants)
    assert any(not torch.equal(reflow[name], gaussian[name]) for name in reflow)


def test_students_of_one_teacher_share_it(tmp_path, capsys):
    """It is trained once, by one worker, though it is not compared itself."""
    methods = [Method("reflow", H, {"teacher_nfe": n}) for n in (2, 3)]
    for envs in (1, 3):
        compared = comparison(tmp_path / str(envs), envs, methods=methods, seeds=1)
        compared.run()
        told = capsys.readouterr().out
        assert not compared.failures and told.count("trained drift own, gaussian") == 1
        teacher = compared.contestants[0].teacher()
        whole = teacher.store.training_seconds(teacher.method, teacher.training)
        assert all(row["training_seconds"] > whole for row in compared.timed())
    assert rows_of(tmp_path / "1") == rows_of(tmp_path / "3")


class Unteachable(Store):
    def train(self, method, training, progress=None):
        if method.name == "gaussian":
            raise FloatingPointError("the teacher diverged")
        return super().train(method, training, progress)


def test_without_its_teacher_a_student_fails_at_once(tmp_path):
    methods = [Method("reflow", H), Method("past", H)]
    compared = comparison(tmp_path, 2, kind=Unteachable, methods=methods, seeds=1)
    compared.run()
    assert [c.method.name for c in compared.contestants] == ["past"]
    assert len(compared.failures) == 2
    assert all("the teacher diverged" in failure for failure in compared.failures)


class Diverging(Store):
    def train(self, method, training, progress=None):
        if method.name != "past":
            return super().train(method, training, progress)
        data = self.problem.data.clone()
        data["action"].fill_(1e30)
        problem = replace(self.problem, data=data)
        broken = Store(problem, self.network, self.directory, self.logs, self.run)
        return broken.train(method, training, progress)


def test_a_policy_that_fails_is_named_and_does_not_stop_the_others(undisturbed, tmp_path, capsys):
    # Moments would refuse such actions before any training.
    compared = comparison(tmp_path, 3, kind=Diverging, seeds=1, precondition=False)
    file = str(compared.contestants[1].folder / "state.safetensors")
    rows = compared.run().rows
    assert [row["prior"] for row in rows] == ["gaussian"] * 4 + ["preview"] * 4
    assert [c.method.name for c in compared.contestants] == ["gaussian", "preview"]
    (failure,) = compared.failures
    assert failure.startswith("drift") and "past" in failure and file in failure
    assert f"FAILED {failure}" in capsys.readouterr().out
    assert set(compared.policies()) == {METHODS[0], METHODS[2]}
    # A second attempt, in which nothing fails, adds what is missing.
    again = comparison(tmp_path, 2, seeds=1, precondition=False, resume=True)
    assert [row["prior"] for row in again.run().rows][4:8] == ["past"] * 4
    assert again.failures == []


def test_a_training_that_fails_is_told_when_all_others_are_done(tmp_path):
    compared = comparison(tmp_path, 3, kind=Diverging, seeds=1, precondition=False)
    with pytest.raises(PartialFailure, match="past"):
        compared.train()
    assert [c.path.is_dir() for c in compared.contestants] == [True, True]


class Stumbling(DriftEnv):
    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2:
            raise AssertionError("the simulator stumbled")
        return super()._step(tensordict)


def test_where_everything_fails_the_run_does(tmp_path):
    compared = comparison(tmp_path, 2, problem=drift_problem(Stumbling()), seeds=1)
    with pytest.raises(PartialFailure, match=r"(?s)gaussian.*stumbled.*preview.*stumbled"):
        compared.run()
