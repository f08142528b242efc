"""The study of training budgets from the command line."""

from __future__ import annotations

import importlib
import json

import pytest

from tests.benchmarks.conftest import options
from tests.data.synthetic import write_robomimic_file
from warmprior import WarmPriorActor
from warmprior.diagnostics import action_error
from warmprior.training.policies import Policies

pytest.importorskip("robosuite")


@pytest.fixture(scope="module")
def budget():
    return importlib.import_module("budget")


@pytest.fixture(scope="module")
def validation(tmp_path_factory):
    path = tmp_path_factory.mktemp("held-out") / "val.hdf5"
    write_robomimic_file(path, lengths=(25, 30), task="lift", seed=1)
    return path


def arguments(dataset, out, held_out, **extra):
    extra = {"validation": held_out, "observations": 20, "prior": "past"} | extra
    return options(dataset, out, **{"iterations": None, "budgets": [4, 2]} | extra)


def test_every_budget_is_a_training_of_its_own(budget, dataset, validation, tmp_path, capsys):
    out = tmp_path / "runs" / "budget"
    argv = arguments(dataset, out, validation)
    assert budget.main(argv) == 0
    stored = json.loads((out / "results.json").read_text())
    assert [row["checkpoint"] for row in stored["rows"]] == [2, 4]
    assert all("success_rate" in row for row in stored["rows"])
    assert [b["iterations"] for b in stored["meta"]["budgets"]] == [2, 4]
    assert all((out / b["folder"] / "results.json").exists() for b in stored["meta"]["budgets"])
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out and "| 2 |" in table and "| 4 |" in table
    assert (out / "budget.png").read_bytes().startswith(b"\x89PNG")

    # The errors are those of the policies on disk, each trained for its own number of iterations.
    folders = sorted((out.parent / "policies").iterdir())
    names = sorted(path.name for folder in folders for path in folder.glob("policy_*"))
    assert names == ["policy_000002", "policy_000004"]
    held_out = {row["iterations"]: row["action_error"] for row in stored["held_out"]}
    paths = {int(p.name[-6:]): p for folder in folders for p in folder.glob("policy_*")}
    for iterations, path in paths.items():
        actor = WarmPriorActor.from_pretrained(path)
        # Of all held-out steps, as many as there are: any draw of 20 is close.
        error = action_error(actor, held_out_windows(actor, validation), nfes=(1,))[1]
        assert held_out[iterations] == pytest.approx(error, rel=0.3)

    # What is finished is not trained again.
    before = {path: path.stat().st_mtime_ns for path in out.parent.rglob("*.safetensors")}
    assert budget.main([*argv, "--resume"]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    assert json.loads((out / "results.json").read_text())["rows"] == stored["rows"]


def held_out_windows(actor, validation):
    from warmprior.data import RobomimicExperienceReplay
    from warmprior.diagnostics import SharedObservations

    data = actor.normalizer.normalize(RobomimicExperienceReplay(validation).data.exclude("next"))
    return SharedObservations(data, 8, observation_steps=2).windows(actor.prior)


def test_bad_options_stop_before_any_work(
    budget, dataset, validation, tmp_path, capsys, monkeypatch
):
    def never(self, *args):
        raise AssertionError("training started")

    monkeypatch.setattr(Policies, "train", never)
    for i, (extra, message) in enumerate(
        (
            ({"iterations": 3}, "name it with --budgets"),
            ({"budgets": [0]}, "--budgets must be at least 1, got 0"),
            ({"nfe": 0}, "--nfe must be at least 1"),
            ({"validation": None}, "add --validation"),
            ({"observations": 1_000}, "1000 observations are asked for"),
            ({"observations": 0}, "--observations must be at least 1"),
            ({"validation": tmp_path / "none.hdf5"}, "none.hdf5"),
        )
    ):
        assert budget.main(arguments(dataset, tmp_path / str(i), validation, **extra)) == 2
        assert message in capsys.readouterr().err
