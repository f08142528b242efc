"""The studies on manipulation tasks from the command line: shared policies, rows, pictures, errors."""

from __future__ import annotations

import importlib
import json

import pytest

from tests.benchmarks.conftest import options
from tests.data.synthetic import write_robomimic_file
from warmprior import PastPrior
from warmprior.diagnostics import Row
from warmprior.training.policies import Policies

pytest.importorskip("robosuite")

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module")
def scripts():
    names = ("robomimic", "curvature", "sigma", "chunking")
    return {name: importlib.import_module(name) for name in names}


@pytest.fixture(scope="module")
def validation(tmp_path_factory):
    path = tmp_path_factory.mktemp("held-out") / "val.hdf5"
    write_robomimic_file(path, lengths=(25, 30), task="lift", seed=1)
    return path


@pytest.fixture(scope="module")
def finished(scripts, dataset, tmp_path_factory):
    """A finished run of robomimic.py with two seeds."""
    out = tmp_path_factory.mktemp("runs") / "main"
    with pytest.MonkeyPatch.context() as patch:  # filmstrips take long, and are not tested here
        patch.setattr(scripts["robomimic"], "rendering_backend", lambda: None)
        code = scripts["robomimic"].main(options(dataset, out, seeds=2, iterations=60))
    assert code == 0
    return out


def written(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")}


def stored(out):
    return json.loads((out / "results.json").read_text())


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")


def measured(out, validation):
    return {"out": out, "validation": validation, "observations": 20, "steps": 8}


def test_curvature_of_a_finished_run_trains_nothing(scripts, finished, validation, capsys):
    before = written(finished.parent)
    argv = ["--run", finished, "--validation", validation, "--observations", 20, "--steps", 8]
    assert scripts["curvature"].main([str(word) for word in argv]) == 0
    assert written(finished.parent) == before
    out = finished.parent / "curvature-main"
    rows = stored(out)["rows"]
    assert len(rows) == (1 + 2 + 2) * 3  # training and deployed means; two seeds and their average
    assert {row["observations"] for row in rows} == {20}
    base = [row for row in rows if row["prior"] == "gaussian"]
    assert all(row["ratio"] in (1.0, None) for row in base)
    assert (out / "table.md").read_text() in capsys.readouterr().out
    assert is_png(out / "flow_paths.png")
    # The training data are allowed, but called what they are.
    training = stored(finished)["meta"]["options"]["dataset"]
    again = finished.parent / "curvature-training"
    argv = [*argv[:3], training, *argv[4:], "--out", again]
    assert scripts["curvature"].main([str(word) for word in argv]) == 0
    assert "not held out" in (again / "table.md").read_text()


def test_curvature_finds_the_policies_of_the_same_options(scripts, finished, dataset, validation):
    before = written(finished.parent)
    out = finished.parent / "own"
    argv = options(dataset, seeds=2, iterations=60, **measured(out, validation))
    assert scripts["curvature"].main(argv) == 0
    assert written(finished.parent) == before
    assert stored(out)["rows"] == stored(finished.parent / "curvature-main")["rows"]
    assert all(row["speed"] > 0 for row in stored(out)["rows"])


def test_sigma_study(scripts, finished, dataset, validation):
    before = written(finished.parent)
    out = finished.parent / "sigma"
    argv = options(
        dataset,
        seeds=2,
        iterations=60,
        prior="past",
        sigmas=[0.5, 1.0, 0.0],
        **measured(out, validation),
    )
    assert scripts["sigma"].main(argv) == 0
    after = written(finished.parent)
    assert before.items() <= after.items()
    # Of 2 x (1 + 3) policies the Gaussian ones and those with sigma 0.5 existed: 4 are new.
    new = {path.parents[1].name for path in after.keys() - before.keys() if "policy_" in str(path)}
    assert len(new) == 4
    result = stored(out)
    cells = {(row["prior"], row["sigma"], row["seed"]) for row in result["rows"]}
    assert len(cells) == len(result["rows"]) == 8
    curvatures = {(r["policy"], r["seed"], r["mean"]) for r in result["curvature"]}
    assert len(curvatures) == (1 + 3 * 2) * 3
    bounds = {r["sigma"]: r["bound"] for r in result["curvature"] if r["prior"] == "past"}
    assert bounds[0.0] < bounds[0.5] < bounds[1.0]  # the bound grows with sigma^2
    assert is_png(out / "sigma.png")
    assert (out / "table.md").read_text().count("| WP-Past |") == 3


def test_studies_cover_the_papers_grid_by_default(scripts):
    sigma, chunking = scripts["sigma"], scripts["chunking"]
    priors = sigma.make_priors(sigma.make_parser().parse_args([]))
    grid = {(prior.name, prior.sigma) for prior in priors}
    sigmas = {1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0}
    assert grid == {("gaussian", 1.0)} | {(n, s) for n in ("past", "preview") for s in sigmas}
    args = chunking.make_parser().parse_args([])
    lengths = {(prior.name, prior.chunk_length) for prior in chunking.make_priors(args)}
    names = ("gaussian", "past", "preview")
    assert lengths == {(n, h) for n in names for h in (1, 2, 4, 8, 16)}
    assert sorted(args.nfe) == [1, 3, 9]


def test_chunk_length_study(scripts, dataset, tmp_path):
    out = tmp_path / "chunks"
    assert scripts["chunking"].main(options(dataset, out, chunks=[1, 8])) == 0
    rows = stored(out)["rows"]
    assert len(rows) == 2 * 3
    for row in rows:
        assert row["boundary_jump"] > 0
        assert (row["inner_jump"] is None) == (row["chunk"] == 1)
    for picture in ("chunk_lengths.png", "bars.png", "violins.png"):
        assert is_png(out / picture)
    assert (out / "table.md").read_text().count("| H = ") == 4
    # Continuing plays nothing again.
    assert scripts["chunking"].main([*options(dataset, out, chunks=[1, 8]), "--resume"]) == 0
    assert stored(out)["rows"] == rows


@pytest.mark.parametrize(
    ("script", "extra", "message"),
    [
        ("sigma", {"sigmas": [-1.0]}, "sigma"),
        ("sigma", {"nfe": 0}, "--nfe"),
        ("chunking", {"chunks": [0]}, "chunk_length"),
        ("curvature", {"coordinate": 9}, "--coordinate must be in [0, 7)"),
    ],
)
def test_bad_options_are_named(
    scripts, finished, dataset, validation, tmp_path, capsys, script, extra, message
):
    out = finished.parent / f"bad-{script}-{next(iter(extra))}"
    values = measured(out, validation) if script == "curvature" else {"out": out}
    argv = options(dataset, **{"seeds": 2, "iterations": 60} | values | extra)
    assert scripts[script].main(argv) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, '{"meta": {}, "rows": []}'])
def test_a_folder_that_is_no_finished_run_is_named(scripts, tmp_path, capsys, content):
    run = tmp_path / "run"
    run.mkdir()
    if content is not None:
        (run / "results.json").write_text(content)
    assert scripts["curvature"].main(["--run", str(run)]) == 2
    assert "robomimic.py" in capsys.readouterr().err


@pytest.fixture
def no_training(monkeypatch):
    def train(*args, **options):
        pytest.fail("something was trained")

    monkeypatch.setattr(Policies, "train", train)


@pytest.mark.parametrize("script", ["sigma", "curvature"])
@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"validation": None}, "add --validation FILE"),
        ({"validation": "missing.hdf5"}, "missing.hdf5"),
        ({"validation": "square"}, "holds demonstrations of square"),
        ({"observations": 5_000}, "5000 observations are asked for"),
        ({"steps": 1}, "--steps must be at least 2"),
        ({"draws": 0}, "--draws must be at least 1"),
    ],
)
def test_what_cannot_be_measured_is_named_before_any_training(
    scripts, dataset, validation, tmp_path, capsys, no_training, script, extra, message
):
    if extra.get("validation") == "square":
        path = tmp_path / "other.hdf5"
        write_robomimic_file(path, lengths=(25, 30), task="square", seed=1)
        extra = {"validation": path}
    argv = options(dataset, **measured(tmp_path / "out", validation) | extra)
    assert scripts[script].main(argv) == 2
    assert message in capsys.readouterr().err


def test_policies_without_a_flow_have_no_curvature(
    scripts, dataset, validation, tmp_path, capsys, no_training
):
    argv = options(dataset, prior="regression", **measured(tmp_path / "out", validation))
    assert scripts["curvature"].main(argv) == 2
    assert "none of these policies has a flow" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--seeds", "3"], "leave out --seeds"),
        (["--out", "{run}"], "holds a run"),
        (["--resume"], "leave out --resume"),
    ],
)
def test_a_measured_run_is_neither_overwritten_nor_given_other_options(
    scripts, tmp_path, capsys, extra, message
):
    run = tmp_path / "run"
    run.mkdir()
    (run / "results.json").write_text('{"meta": {}, "rows": []}')
    argv = ["--run", str(run), *(word.format(run=run) for word in extra)]
    assert scripts["curvature"].main(argv) == 2
    assert message in capsys.readouterr().err
    assert stored(run) == {"meta": {}, "rows": []}


def test_measuring_a_run_twice_keeps_both_results(scripts, tmp_path):
    parse = scripts["curvature"].parse
    argv = ["--run", str(tmp_path / "main")]
    assert parse(argv).out == tmp_path / "curvature-main"
    (tmp_path / "curvature-main").mkdir()
    assert parse(argv).out == tmp_path / "curvature-main-2"


def test_only_the_same_study_continues_a_folder(scripts, dataset, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    told = json.dumps({"study": "sigma", "nfe": 1})
    (out / "options.json").write_text(told)
    assert scripts["robomimic"].main(["--resume", "--out", str(out)]) == 2
    assert "another study (sigma)" in capsys.readouterr().err
    assert (out / "options.json").read_text() == told


def test_a_relative_path_continues_the_run_of_the_same_file(
    scripts, dataset, tmp_path, monkeypatch
):
    experiment = importlib.import_module("_experiment")
    monkeypatch.chdir(dataset.parent)
    argv = ["--dataset", dataset.name, "--out", str(tmp_path)]
    make_parser = scripts["sigma"].make_parser
    experiment.store_options(experiment.parse(make_parser, argv, "sigma-"))
    again = experiment.parse(make_parser, [*argv, "--resume"], "sigma-")
    assert again.dataset.resolve() == dataset


def test_a_run_of_several_sigmas_is_not_taken_for_seeds(scripts, tmp_path, capsys):
    run = tmp_path / "sigma"
    run.mkdir()
    policies = [
        {"prior": PastPrior(8, sigma=sigma).config(), "seed": 0, "folder": f"past-{sigma}"}
        for sigma in (0.5, 1.0)
    ]
    meta = {"policies": policies, "task": "lift", "training": {"iterations": 1}}
    (run / "results.json").write_text(json.dumps({"meta": meta, "rows": []}))
    assert scripts["curvature"].main(["--run", str(run)]) == 2
    assert "one sigma and one chunk length" in capsys.readouterr().err


def test_jumps_are_those_of_the_last_checkpoint_as_in_the_figure(scripts):
    def row(prior, checkpoint, jump):
        return Row("lift", "ph", prior, 1.0, 1, 1, 0, checkpoint, 10, 5, 9.0, jump)

    rows = [row(p, *at) for p in ("gaussian", "past", "preview") for at in ((5, 9.0), (10, 0.25))]
    table = scripts["chunking"].make_table(rows, [1], [1], 2)
    assert table.splitlines()[6] == "| H = 1 | 0.250 | 0.250 | 0.250 |"
