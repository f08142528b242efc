"""The study of training budgets from the command line."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import pytest

from tests.benchmarks.script_parts import is_png, options, refused, stored, written
from tests.experiments.row_parts import row as evaluation
from warmprior import PastPrior
from warmprior.data import RobomimicExperienceReplay
from warmprior.diagnostics import SharedObservations, action_error
from warmprior.experiments.methods import Method
from warmprior.training.saved import load_policy

pytest.importorskip("robosuite")
pytest.importorskip("tyro")


@pytest.fixture(scope="module")
def budget():
    return importlib.import_module("budget")


def arguments(dataset, out, held_out, **extra):
    extra = {"validation": held_out, "observations": 20, "prior": "past"} | extra
    return options(dataset, out, **{"iterations": None, "budgets": [4, 2]} | extra)


def held_out_windows(actor, validation):
    """All of them: any draw of 20 is close."""
    data = actor.normalizer.normalize(RobomimicExperienceReplay(validation).data.exclude("next"))
    return SharedObservations(data, 8, observation_steps=2).windows(actor.prior)


def test_every_budget_is_a_training_of_its_own(budget, dataset, validation, tmp_path, capsys):
    out = tmp_path / "runs" / "budget"
    argv = arguments(dataset, out, validation)
    assert budget.main(argv) == 0
    result = stored(out)
    places = [(row["iterations"], row["checkpoint"]) for row in result["rows"]]
    assert places == [(2, 2), (4, 4)]
    assert all("success_rate" in row for row in result["rows"])
    assert [policy["iterations"] for policy in result["meta"]["policies"]] == [2, 4]
    assert "val.hdf5" in result["meta"]["observations"]
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out and "| 2 |" in table and "| 4 |" in table
    assert is_png(out / "budget.png")

    # The errors are those of the policies on disk, each trained for its own number of iterations.
    folders = {p["iterations"]: p["folder"] for p in result["meta"]["policies"]}
    policies = out.parent / "policies"
    assert {folder.name for folder in policies.iterdir()} == set(folders.values())
    names = sorted(path.name for path in policies.glob("*/policy_*"))
    assert names == ["policy_000002", "policy_000004"]
    for row in result["rows"]:
        n = row["iterations"]
        actor = load_policy(policies / folders[n] / f"policy_{n:06d}")
        error = action_error(actor, held_out_windows(actor, validation), nfes=(1,))[1]
        assert row["action_error"] == pytest.approx(error, rel=0.3)
        assert f"({row['action_error']:.4f})" in table

    # What is finished is not trained again.
    before = written(out.parent)
    assert budget.main([*argv, "--resume"]) == 0
    assert written(out.parent) == before
    assert stored(out)["rows"] == result["rows"]


def test_several_seeds_and_nfes(budget, dataset, validation, tmp_path):
    """The error of every cell is that of its own policy, at its own number of evaluations."""
    out = tmp_path / "runs" / "budget"
    assert budget.main(arguments(dataset, out, validation, seeds=2, nfe=[1, 3])) == 0
    rows = stored(out)["rows"]
    cells = {(row["iterations"], row["seed"], row["nfe"]): row["action_error"] for row in rows}
    assert len(cells) == len(rows) == len(set(cells.values())) == 2 * 2 * 2
    table = (out / "table.md").read_text()
    mean = (cells[2, 0, 3] + cells[2, 1, 3]) / 2
    (line,) = (line for line in table.splitlines() if line.startswith("| 2 |"))
    assert f"({mean:.4f})" in line.split("|")[2]  # the larger NFE stands first


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"iterations": 3}, "makes no use of it: leave out --iterations"),
        ({"budgets": [0]}, "--budgets must be between 1 and 1,000,000, got 0"),
        ({"nfe": 0}, "--nfe must be between 1 and"),
        ({"validation": None}, "add --validation"),
        ({"observations": 1_000}, "1000 observations are asked for"),
        ({"observations": 0}, "--observations must be between 1 and"),
        ({"validation": "none.hdf5"}, "none.hdf5"),
    ],
    ids=str,
)
def test_bad_options_stop_before_any_work(
    budget, dataset, validation, tmp_path, capsys, no_work, extra, message
):
    argv = arguments(dataset, tmp_path / "out", validation, **extra)
    assert message in refused(budget.main, argv, capsys)


def test_options_of_a_prior_have_cells_of_their_own(budget, monkeypatch):
    """Also where an earlier version wrote rows without options."""
    first = evaluation(2, prior="past")
    second = evaluation(8, prior="past", options="correlation=0.5")
    names = ("prior", "options", "sigma", "chunk", "seed", "iterations")
    contestants = [
        SimpleNamespace(
            prior=PastPrior(8, sigma=1.0, correlation=each),
            method=Method("past", 8, {"sigma": 1.0, "correlation": each}),
            facts=lambda r=r: {n: r.facts[n] for n in names},
        )
        for r, each in ((first, 0.0), (second, 0.5))
    ]
    comparison = SimpleNamespace(
        contestants=contestants,
        nfes=[1],
        player=lambda contestant: contestant,
        rows=[first, second],
    )
    monkeypatch.setattr(
        budget, "action_error", lambda actor, windows, nfes: {1: actor.prior.correlation}
    )
    monkeypatch.setattr(budget, "encoded_windows", lambda actor, windows: windows)
    observations = SimpleNamespace(windows=lambda prior, see_history: None)
    rows = budget.with_errors(comparison, observations)
    assert [each["action_error"] for each in rows] == [0.0, 0.5]
    assert [each.outcomes for each in rows] == [first.outcomes, second.outcomes]
    head, _, line, *_ = budget.make_table(rows, 1).splitlines()
    assert head == "| iterations | NFE 1: WP-Past | NFE 1: WP-Past, correlation=0.5 |"
    assert line == "| 100 | 20.0 (0.0000) | 80.0 (0.5000) |"
