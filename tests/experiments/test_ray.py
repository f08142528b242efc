"""Comparisons on a Ray cluster: the rows of the local engine, whatever dies on the way."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("tyro")
pytest.importorskip("ray")

from tests.experiments.comparison_parts import (
    METHODS,
    DriftEnv,
    comparison,
    drift_problem,
    rows_of,
)
from tests.processes import apart, ended
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments import Comparison, Store
from warmprior.io.script import run_script
from warmprior.io.workers import end_with_parent


def told_of(rows):
    return [{**row.facts, **row.measures, "outcomes": row.outcomes} for row in rows]


class MortalOnce(DriftEnv):
    """The process that plays it is killed in the middle of an episode, the first time."""

    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2 and self.left < 5:
            try:
                (self.log / "died").touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


class Failing(DriftEnv):
    def _step(self, tensordict):
        raise RuntimeError("the motors are off")


@apart
def test_rows_are_those_of_the_local_engine_though_a_process_dies_and_a_cell_fails(
    undisturbed, tmp_path, ray_address, monkeypatch
):
    (tmp_path / "log").mkdir()
    monkeypatch.chdir(tmp_path)  # that of the cluster is another
    options = {"engine": "ray", "ray_address": ray_address, "methods": METHODS[1:2], "seeds": 1}
    sound = drift_problem(MortalOnce(tmp_path / "log"))
    compared = comparison(Path(), None, problem=sound, **options)
    (store,) = compared.stores
    broken = replace(drift_problem(Failing()), task="broken")
    stores = [store, Store(broken, store.network, store.directory, store.logs, store.run)]
    both = Comparison(compared.recipe, stores=stores, methods=METHODS[1:2])
    both.run()
    expected = [r for r in rows_of(undisturbed) if (r["prior"], r["seed"]) == ("past", 0)]
    assert told_of(both.rows) == rows_of(tmp_path) == expected and len(expected) == 4
    assert (tmp_path / "log" / "died").exists()
    (failure,) = both.failures
    assert failure.startswith("broken own, past") and "the motors are off" in failure
    assert "checkpoint 10, nfe" in failure or "checkpoint 20, nfe" in failure
    assert both.results.meta["hardware"]["engine"] == "ray"
    # Kept for another attempt at the broken one.
    assert len(list((tmp_path / "out" / "cells").glob("*.json"))) == 4 + 2
    # The local engine continues it.
    assert not {"engine", "ray_address"} & both.results.meta["identity"]["recipe"]["run"].keys()


def driver(folder, address, resume=False):
    """A run of its own process; its workers sleep a little in every step."""
    env = DriftEnv(folder / "log", sleep=0.02)
    compared = comparison(
        folder,
        None,
        problem=drift_problem(env),
        methods=METHODS[:2],
        seeds=1,
        resume=resume,
        engine="ray",
        ray_address=address,
    )
    compared.run()


def started(function, *args):
    """A driver in a process of its own."""

    def run():
        end_with_parent()
        os._exit(run_script(lambda: function(*args), "driver"))

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    return process


def played(folder):
    return [path.name.split("-")[:2] for path in (folder / "log").iterdir()]


def wait_for(happened, process):
    end = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < end and process.is_alive()
        time.sleep(0.05)


@pytest.mark.slow
def test_a_killed_driver_resumes_and_plays_nothing_twice(undisturbed, tmp_path, ray_address):
    (tmp_path / "log").mkdir()
    process = started(driver, tmp_path, ray_address)
    cells = tmp_path / "out" / "cells"
    wait_for(lambda: len(list(cells.glob("*.json"))) >= 3, process)
    process.kill()
    process.join()
    workers = {int(pid) for _, pid in played(tmp_path)}
    end = time.monotonic() + 30
    while not all(map(ended, workers)):
        assert time.monotonic() < end, "jobs go on though nobody waits for them"
        time.sleep(0.1)
    finished, before = len(list(cells.glob("*.json"))), len(played(tmp_path))
    process = started(driver, tmp_path, ray_address, True)
    process.join(60)
    assert process.exitcode == 0
    assert rows_of(tmp_path) == rows_of(undisturbed)[:4] + rows_of(undisturbed)[8:12]
    assert not cells.exists()
    # Eight cells and two measures: what was finished is not played again.
    assert len(played(tmp_path)) - before <= 5 * (8 - (finished - 2))


@pytest.mark.slow
def test_ctrl_c_is_one_line_and_ends_all_jobs(tmp_path, ray_address, capfd):
    (tmp_path / "log").mkdir()
    process = started(driver, tmp_path, ray_address)
    wait_for(lambda: len(played(tmp_path)) >= 2, process)
    workers = {int(pid) for _, pid in played(tmp_path)}
    os.kill(process.pid, signal.SIGINT)
    process.join(30)
    assert process.exitcode == 130
    assert capfd.readouterr().err.strip() == "driver: interrupted; --resume continues"
    end = time.monotonic() + 10
    while not all(map(ended, workers)):
        assert time.monotonic() < end, "jobs go on"
        time.sleep(0.1)
