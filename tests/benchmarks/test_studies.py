"""The studies on manipulation tasks from the command line: shared policies, rows, pictures, errors."""

from __future__ import annotations

import importlib
import json

import pytest

from tests.benchmarks.script_parts import (
    command_line,
    having,
    is_png,
    options,
    refused,
    stored,
    written,
)
from tests.data.synthetic import write_robomimic_file
from tests.experiments.row_parts import row as evaluation

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

from warmprior.experiments import PRESETS, Row, parse, started, success_study
from warmprior.experiments.methods import Method

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module")
def scripts():
    names = ("robomimic", "curvature", "sigma", "chunking")
    return {name: importlib.import_module(name) for name in names}


@pytest.fixture(scope="module")
def finished(scripts, dataset, tmp_path_factory):
    """A finished run of robomimic.py with two seeds."""
    out = tmp_path_factory.mktemp("runs") / "main"
    with pytest.MonkeyPatch.context() as patch:  # filmstrips take long, and are not tested here
        patch.setattr(success_study, "rendering_backend", lambda: None)
        code = scripts["robomimic"].main(options(dataset, out, seeds=2, iterations=60))
    assert code == 0
    return out


def measured(out, validation, script="curvature"):
    held_out = {"out": out, "validation": validation, "observations": 20, "steps": 8}
    # What is not played has none of these options.
    return held_out | ({"episodes": None, "nfe": None} if script == "curvature" else {})


def test_curvature_of_a_finished_run_trains_nothing(scripts, finished, validation, capsys):
    before = written(finished.parent)
    out = finished.parent / "of-main"
    told = {"run": finished, **measured(out, validation)}
    assert scripts["curvature"].main(command_line(**told)) == 0
    assert written(finished.parent) == before
    rows = stored(out)["rows"]
    assert len(rows) == (1 + 2 + 2) * 3  # training and deployed means; two seeds and their average
    assert {row["observations"] for row in rows} == {20}
    base = [row for row in rows if row["prior"] == "gaussian"]
    assert len(base) == 3 and all(row["ratio"] in (1.0, None) for row in base)
    printed = capsys.readouterr().out
    table = (out / "table.md").read_text()
    assert table in printed and "20 observations of val.hdf5" in table
    assert "averaged over 2 training seeds" in table and "not held out" not in table
    assert is_png(out / "flow_paths.png")
    # The training data are allowed, but called what they are.
    training = stored(finished)["meta"]["identity"]["recipe"]["data"]["dataset"]
    again = finished.parent / "curvature-training"
    told |= {"validation": training, "out": again}
    assert scripts["curvature"].main(command_line(**told)) == 0
    assert "not held out" in (again / "table.md").read_text()


def test_curvature_finds_the_policies_of_the_same_options(scripts, finished, dataset, validation):
    before = written(finished.parent)
    own, of_run = (finished.parent / name for name in ("own", "of-run"))
    argv = options(dataset, seeds=2, iterations=60, **measured(own, validation))
    assert scripts["curvature"].main(argv) == 0
    assert (
        scripts["curvature"].main(command_line(run=finished, **measured(of_run, validation))) == 0
    )
    assert written(finished.parent) == before
    assert stored(own)["rows"] == stored(of_run)["rows"]
    assert all(row["speed"] > 0 for row in stored(own)["rows"])


def test_sigma_study(scripts, finished, dataset, validation):
    before = written(finished.parent)
    out = finished.parent / "sigma"
    argv = options(
        dataset,
        seeds=2,
        iterations=60,
        prior=["gaussian", "past"],
        sigma=[0.5, 1.0, 0.0],
        **measured(out, validation, "sigma"),
    )
    assert scripts["sigma"].main(argv) == 0
    after = written(finished.parent)
    assert before.items() <= after.items()
    # Of 2 x (1 + 3) policies the Gaussian ones and those with sigma 0.5 existed: 4 are new.
    new = {path.parents[1].name for path in after.keys() - before.keys() if "policy_" in str(path)}
    assert len(new) == 4
    rows = stored(out)["rows"]
    played, curved = having(rows, "success_rate"), having(rows, "ratio")
    cells = {(row["prior"], row["sigma"], row["seed"]) for row in played}
    assert len(cells) == len(played) == 8 and len(played) + len(curved) == len(rows)
    curvatures = {(r["policy"], r["seed"], r["mean"]) for r in curved}
    assert len(curvatures) == len(curved) == (1 + 3 * 2) * 3
    bounds = {r["sigma"]: r["bound"] for r in curved if r["prior"] == "past"}
    assert bounds[0.0] < bounds[0.5] < bounds[1.0]  # the bound grows with sigma^2
    assert is_png(out / "sigma.png")
    table = (out / "table.md").read_text()
    assert table.count("| WP-Past, sigma ") == 3 and table.count("| Base, sigma 1 |") == 1
    # Continuing measures the same again, once.
    assert scripts["sigma"].main([*argv, "--resume"]) == 0
    assert written(finished.parent) == after
    assert stored(out)["rows"] == rows and (out / "table.md").read_text() == table


def test_studies_cover_the_papers_grid_by_default(scripts, monkeypatch):
    made = {}

    def keep(recipe, study):
        made[study] = recipe
        raise ValueError("enough")

    for name in ("sigma", "chunking"):
        monkeypatch.setattr(scripts[name], "started", keep)
        assert scripts[name].main([]) == 2
    grid = {(method.name, method.sigma) for method in made["sigma"].sources.methods()}
    sigmas = {1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0}
    assert grid == {("gaussian", 1.0)} | {(n, s) for n in ("past", "preview") for s in sigmas}
    assert made["sigma"].evaluation.nfes == [1]
    lengths = {(m.name, m.chunk_length) for m in made["chunking"].sources.methods()}
    names = ("gaussian", "past", "preview")
    assert lengths == {(n, h) for n in names for h in (1, 2, 4, 8, 16)}
    assert made["chunking"].evaluation.nfes == [9, 3, 1]


def test_chunk_length_study(scripts, dataset, tmp_path):
    out = tmp_path / "chunks"
    assert scripts["chunking"].main(options(dataset, out, chunk=[1, 8])) == 0
    rows = stored(out)["rows"]
    assert len(rows) == 2 * 3 and {row["chunk"] for row in rows} == {1, 8}
    for row in rows:
        assert row["boundary_jump"] > 0
        assert (row["inner_jump"] is None) == (row["chunk"] == 1)
    for picture in ("chunk_lengths.png", "bars.png", "violins.png"):
        assert is_png(out / picture)
    assert (out / "table.md").read_text().count("| H = ") == 4
    # Continuing plays nothing again.
    before = written(out.parent)
    assert scripts["chunking"].main([*options(dataset, out, chunk=[1, 8]), "--resume"]) == 0
    assert stored(out)["rows"] == rows and written(out.parent) == before


@pytest.mark.parametrize(
    ("script", "extra", "message"),
    [
        ("sigma", {"sigma": [-1.0]}, "sigma"),
        ("sigma", {"nfe": 0}, "--nfe"),
        ("sigma", {"nfe": [1, 3]}, "this study has one --nfe, got 1 3"),
        ("sigma", {"chunk": [4, 8]}, "this study has one --chunk, got 4 8"),
        ("chunking", {"chunk": [0]}, "--chunk"),
        ("chunking", {"dataset": None, "task": ["lift", "can"]}, "this study has one --task"),
        ("curvature", {"coordinate": 9}, "--coordinate must be in [0, 7)"),
    ],
)
def test_bad_options_are_named(
    scripts, finished, dataset, validation, capsys, no_work, script, extra, message
):
    out = finished.parent / f"bad-{script}-{next(iter(extra))}"
    values = {"out": out} if script == "chunking" else measured(out, validation, script)
    argv = options(dataset, **{"seeds": 2, "iterations": 60} | values | extra)
    assert message in refused(scripts[script].main, argv, capsys)


@pytest.mark.parametrize("content", [None, '{"meta": {}, "rows": []}'])
def test_a_folder_that_is_no_finished_run_is_named(scripts, tmp_path, capsys, content):
    run = tmp_path / "run"
    run.mkdir()
    if content is not None:
        (run / "results.json").write_text(content)
    argv = command_line(run=run, out=tmp_path / "out")
    assert "robomimic.py" in refused(scripts["curvature"].main, argv, capsys)


@pytest.mark.parametrize("script", ["sigma", "curvature"])
@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"validation": None}, "add --validation FILE"),
        ({"validation": "missing.hdf5"}, "missing.hdf5"),
        ({"validation": "square"}, "holds demonstrations of square"),
        ({"observations": 5_000}, "5000 observations are asked for"),
        ({"steps": 1}, "--steps must be between 2 and"),
        ({"draws": 0}, "--draws must be between 1 and"),
    ],
)
def test_what_cannot_be_measured_is_named_before_any_training(
    scripts, dataset, validation, tmp_path, capsys, no_work, script, extra, message
):
    if extra.get("validation") == "square":
        path = tmp_path / "other.hdf5"
        write_robomimic_file(path, lengths=(25, 30), task="square", seed=1)
        extra = {"validation": path}
    argv = options(dataset, **measured(tmp_path / "out", validation, script) | extra)
    assert message in refused(scripts[script].main, argv, capsys)


def test_policies_without_a_flow_have_no_curvature(
    scripts, dataset, validation, tmp_path, capsys, no_work
):
    argv = options(dataset, prior="regression", **measured(tmp_path / "out", validation))
    told = refused(scripts["curvature"].main, argv, capsys)
    assert "none of these policies has a flow" in told


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--seeds", "3"], "leave out --seeds"),
        (["--chunk", "4", "--iterations", "3"], "leave out --chunk, --iterations"),
        (["--prior", "past"], "leave out --prior"),
        (["--out", "{run}"], "holds a run"),
        (["--resume", "--out", "{run}"], "another study (None)"),
        (["--resume", "--out", "{run}-other"], "--resume: there is no run"),
    ],
)
def test_a_measured_run_is_neither_overwritten_nor_given_other_options(
    scripts, tmp_path, capsys, extra, message
):
    run = tmp_path / "run"
    run.mkdir()
    for name in ("results", "options"):
        (run / f"{name}.json").write_text('{"meta": {}, "rows": []}')
    argv = ["--run", run, *([] if "--out" in extra else ["--out", tmp_path / "out"])]
    argv += [word.format(run=run) for word in extra]
    assert message in refused(scripts["curvature"].main, argv, capsys)
    for name in ("results", "options"):
        assert json.loads((run / f"{name}.json").read_text()) == {"meta": {}, "rows": []}


def test_measuring_a_run_twice_keeps_both_results(
    scripts, finished, validation, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in ("curvature-main-quick", "curvature-main-quick-2"):
        argv = command_line(run=finished, **measured(None, validation))
        assert scripts["curvature"].main(argv) == 0
        assert len(stored(tmp_path / "runs" / name)["rows"]) == 15


def test_only_the_same_study_continues_a_folder(scripts, dataset, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    told = json.dumps({"study": "sigma", "nfe": 1})
    (out / "options.json").write_text(told)
    message = refused(scripts["robomimic"].main, ["--resume", "--out", out], capsys)
    assert "another study (sigma)" in message
    assert (out / "options.json").read_text() == told


def test_a_relative_path_continues_the_run_of_the_same_file(
    scripts, dataset, tmp_path, monkeypatch
):
    presets = {name: scripts["sigma"].study(preset) for name, preset in PRESETS.items()}
    monkeypatch.chdir(dataset.parent)
    argv = ["--dataset", dataset.name, "--out", str(tmp_path / "out")]
    with started(parse(presets, argv, study="sigma"), "sigma"):
        pass
    assert parse(presets, [*argv, "--resume"], study="sigma").data.dataset.resolve() == dataset
    monkeypatch.chdir(tmp_path)
    again = parse(presets, ["--out", "out", "--resume"], study="sigma")
    assert again.data.dataset == dataset
    with pytest.raises(ValueError, match="started with --dataset"):
        parse(presets, ["--out", "out", "--resume", "--dataset", "another.hdf5"], study="sigma")


@pytest.mark.parametrize("changes", [{"sigma": 1.0}, {"chunk_length": 4}, {"iterations": 2}])
def test_a_run_of_several_policies_of_a_prior_is_not_taken_for_seeds(
    scripts, tmp_path, capsys, changes
):
    run = tmp_path / "sigma"
    run.mkdir()
    policies = []
    for change in ({}, changes):
        values = {"chunk_length": 8, "sigma": 0.5, "iterations": 1} | change
        iterations = values.pop("iterations")
        method = Method("past", values["chunk_length"], {"sigma": values["sigma"]})
        entry = {"method": method.config(), "iterations": iterations, "seed": 0}
        policies.append(entry | {"folder": "past"})
    meta = {"policies": policies, "problems": [{"task": "lift"}]}
    (run / "results.json").write_text(json.dumps({"meta": meta, "rows": []}))
    argv = command_line(run=run, out=tmp_path / "out")
    told = refused(scripts["curvature"].main, argv, capsys)
    assert "one sigma and one chunk length" in told


def test_a_missing_policy_of_a_run_is_named(scripts, tmp_path, capsys):
    run = tmp_path / "main"
    run.mkdir()
    entry = {"method": Method("past", 8).config(), "iterations": 1, "seed": 0, "folder": "past"}
    meta = {"policies": [entry], "problems": [{"task": "lift"}]}
    (run / "results.json").write_text(json.dumps({"meta": meta, "rows": []}))
    argv = command_line(run=run, out=tmp_path / "out")
    told = refused(scripts["curvature"].main, argv, capsys)
    assert "policy_000001 is missing: finish the run with --resume" in told


def test_jumps_are_those_of_the_last_checkpoint_as_in_the_figure(scripts):
    def row(prior, checkpoint, jump):
        facts = {"task": "lift", "data": "ph", "prior": prior, "sigma": 1.0, "chunk": 1, "nfe": 1}
        facts |= {"seed": 0, "iterations": 10, "checkpoint": checkpoint}
        counts = {"episodes": 10, "successes": 5, "success_rate": 0.5}
        return Row(facts, counts | {"boundary_jump": jump})

    rows = [row(p, *at) for p in ("gaussian", "past", "preview") for at in ((5, 9.0), (10, 0.25))]
    table = scripts["chunking"].make_table(rows, 2)
    assert "| H = 1, success (%) | 50.0 | 50.0 | 50.0 |" in table
    assert "| H = 1, jump at boundaries | 0.250 | 0.250 | 0.250 |" in table


def test_options_of_a_prior_have_columns_of_their_own(scripts):
    shown = [
        evaluation(k, prior="past", chunk=chunk, **told)
        for chunk in (1, 8)
        for k, told in ((2, {}), (8, {"options": "correlation=0.5"}))
    ]
    head, _, first, *_ = scripts["chunking"].make_table(shown, 1).splitlines()
    assert head == "|  | NFE 1: WP-Past | NFE 1: WP-Past, correlation=0.5 |"
    assert first == "| H = 1, success (%) | 20.0 | 80.0 |"


def test_sigma_of_several_options_of_a_prior(scripts, dataset, validation, tmp_path):
    argv = options(
        dataset,
        tmp_path / "runs" / "sigma",
        prior=["past", "past,correlation=0.5"],
        sigma=[0.5],
        iterations=2,
        **{k: v for k, v in measured(None, validation, "sigma").items() if k != "out"},
    )
    assert scripts["sigma"].main(argv) == 0
    table = (tmp_path / "runs" / "sigma" / "table.md").read_text()
    lines = [line.split("|")[1].strip() for line in table.splitlines()[2:4]]
    assert lines == ["WP-Past, sigma 0.5", "WP-Past, correlation=0.5, sigma 0.5"]
