"""The studies on manipulation tasks from the command line: shared policies, rows, pictures, errors."""

from __future__ import annotations

import importlib

import pytest

from tests.benchmarks.script_parts import command_line, is_png, options, stored, written

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

from warmprior.data import RobomimicExperienceReplay
from warmprior.diagnostics import SharedObservations, action_error
from warmprior.training import load_policy

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")
NAMES = ("robomimic", "curvature", "sigma", "chunking", "budget")


@pytest.fixture(scope="module")
def scripts():
    return {name: importlib.import_module(name) for name in NAMES}


@pytest.fixture(scope="module")
def finished(scripts, inline, short_episodes, dataset, tmp_path_factory):
    """A finished run of robomimic.py with two seeds."""
    out = tmp_path_factory.mktemp("runs") / "main"
    assert scripts["robomimic"].main(options(dataset, out, seeds=2, iterations=60)) == 0
    return out


def measured(out, validation):
    return {"out": out, "validation": validation, "observations": 20, "steps": 8}


def test_curvature_of_a_finished_run_trains_nothing(scripts, finished, dataset, validation, capsys):
    before = written(finished.parent)
    out, own = finished.parent / "of-main", finished.parent / "own"
    argv = {"run": finished, **measured(out, validation)}
    assert scripts["curvature"].main(command_line(**argv)) == 0
    rows, report = stored(out, "curvature"), (out / "report.md").read_text()
    assert len(rows) == (1 + 2 + 2) * 3  # training and deployed means; two seeds and their average
    assert {row["observations"] for row in rows} == {20}
    base = [row for row in rows if row["prior"] == "gaussian"]
    assert len(base) == 3 and all(row["ratio"] in (1.0, None) for row in base)
    assert all(row["speed"] > 0 for row in rows)
    said = capsys.readouterr().out
    assert report.partition("\n\nColumns")[0] in said and "20 observations of val.hdf5, 2 seed(s)" in report
    assert "not held out" not in report
    assert is_png(out / "flow_paths.png")
    # The same options find the same policies.
    same = options(dataset, seeds=2, iterations=60, **measured(own, validation))
    assert scripts["curvature"].main(same) == 0
    assert stored(own, "curvature") == rows and written(finished.parent) == before
    # The training data are allowed, but called what they are.
    argv |= {"validation": dataset, "out": finished.parent / "training"}
    assert scripts["curvature"].main(command_line(**argv)) == 0
    assert "not held out" in (finished.parent / "training" / "report.md").read_text()


def test_sigma_study(scripts, finished, dataset, validation):
    before, out = written(finished.parent), finished.parent / "sigma"
    argv = options(
        dataset,
        seeds=1,
        iterations=60,
        prior=["gaussian", "past", "past,correlation=0.5"],
        sigma=[0.5, 0.0],
        **measured(out, validation),
    )
    assert scripts["sigma"].main(argv) == 0
    after = written(finished.parent)
    assert before.items() <= after.items()
    # Of 1 + 4 policies the Gaussian one and that of past with sigma 0.5 existed: 3 are new.
    new = {path.parents[1].name for path in after.keys() - before.keys() if "policy_" in str(path)}
    assert len(new) == 3
    cells = [(r["prior"], r["options"], r["sigma"], r["seed"]) for r in stored(out)]
    assert len(set(cells)) == len(cells) == 5
    flow = stored(out, "curvature")
    assert len(flow) == 1 + 4 * 2
    bounds = {r["sigma"]: r["bound"] for r in flow if r["prior"] == "past" and not r["options"]}
    assert bounds[0.0] < bounds[0.5]  # the bound grows with sigma^2
    assert is_png(out / "sigma.png")
    rows, report = stored(out), (out / "report.md").read_text()
    for line in ("| Base | 1 |", "| WP-Past, correlation=0.5 | 0.5 |"):
        assert report.count(line) == (2 if "Base" in line else 3)  # success; flow, by mean
    # Continuing measures the same again, once.
    assert scripts["sigma"].main([*argv, "--resume"]) == 0
    assert written(finished.parent) == after
    assert stored(out) == rows and (out / "report.md").read_text() == report


def test_chunk_length_study(scripts, dataset, tmp_path):
    out = tmp_path / "chunks"
    argv = options(dataset, out, chunk=[1, 8], prior=["gaussian", "past"])
    assert scripts["chunking"].main(argv) == 0
    rows = stored(out)
    assert [row["chunk"] for row in rows] == [1, 1, 8, 8]
    for row in rows:
        assert row["boundary_jump"] > 0
        assert (row["inner_jump"] is None) == (row["chunk"] == 1)
    for picture in ("chunk_lengths.png", "bars.png", "violins.png"):
        assert is_png(out / picture)
    assert (out / "report.md").read_text().count("| WP-Past |") == 2  # a line per chunk length
    # Continuing plays nothing again.
    before = written(out.parent)
    assert scripts["chunking"].main([*argv, "--resume"]) == 0
    assert stored(out) == rows and written(out.parent) == before


def test_every_budget_is_a_training_of_its_own(scripts, dataset, validation, tmp_path, capsys):
    out = tmp_path / "runs" / "budget"
    more = {"budgets": [4, 2], "prior": "past", "seeds": 2, "nfe": [1, 3], "checkpoints": 2}
    argv = options(dataset, **measured(out, validation) | more)
    assert scripts["budget"].main(argv) == 0
    cells = {(r["iterations"], r["seed"], r["nfe"]): r for r in stored(out)}
    assert list(cells) == [(n, s, f) for n in (2, 4) for s in (0, 1) for f in (3, 1)]
    assert all(row["checkpoint"] == n for (n, *_), row in cells.items())
    report = (out / "report.md").read_text()
    assert report.partition("\n\nColumns")[0] in capsys.readouterr().out and is_png(out / "budget.png")
    names = sorted(path.name for path in (out.parent / "policies").glob("*/policy_*"))
    assert names == ["policy_000002"] * 2 + ["policy_000004"] * 2

    # The errors are those of the policies on disk, each trained for its own number of iterations.
    for (n, _, nfe), row in cells.items():
        actor = load_policy(out.parent / "policies" / row["policy"] / f"policy_{n:06d}")
        replay = RobomimicExperienceReplay(validation).data.exclude("next")
        shared = SharedObservations(actor.normalizer.normalize(replay), 8, observation_steps=2)
        error = action_error(actor, shared.windows(actor.prior), nfes=(nfe,))[nfe]
        assert row["action_error"] == pytest.approx(error, rel=0.3)  # any draw of 20 is close
    assert len({row["action_error"] for row in cells.values()}) == len(cells)
    mean = (cells[2, 0, 3]["action_error"] + cells[2, 1, 3]["action_error"]) / 2
    (line,) = (line for line in report.splitlines() if line.startswith("| 2 | 3 |"))
    assert line.split("|")[5].startswith(f" {mean:.4f} ±")

    before, rows = written(out.parent), stored(out)
    assert scripts["budget"].main([*argv, "--resume"]) == 0
    assert written(out.parent) == before and stored(out) == rows


def test_studies_cover_the_papers_grid_by_default(scripts, monkeypatch):
    made = {}

    def keep(found, study):
        made[study] = found
        raise ValueError("enough")

    for name in ("sigma", "chunking"):
        monkeypatch.setattr(scripts[name], "started", keep)
        assert scripts[name].main([]) == 2
    grid = {(method.name, method.sigma) for method in made["sigma"].sources.methods()}
    sigmas = {1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0}
    assert grid == {("gaussian", 1.0)} | {(n, s) for n in ("past", "preview") for s in sigmas}
    assert made["sigma"].evaluation.nfe == (1,)
    lengths = {(m.name, m.chunk_length) for m in made["chunking"].sources.methods()}
    names = ("gaussian", "past", "preview")
    assert lengths == {(n, h) for n in names for h in (1, 2, 4, 8, 16)}
    assert made["chunking"].evaluation.nfe == (9, 3, 1)
