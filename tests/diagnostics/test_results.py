from __future__ import annotations

import contextlib
import json
from dataclasses import replace

import pytest

from warmprior.diagnostics import Results, Row, paper_success, success_table, summarize
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success

META = {"data_source": "scripted"}
ROW = Row("square", "ph", "gaussian", 1.0, 8, 1, 0, 100, 10, 5, 200.0)


def filled(tmp_path, meta=META):
    """Three seeds, two checkpoints; WP-Past is better by 30 points, and less spread than that."""
    results = Results(tmp_path / "results.json", meta)
    for prior, wins in (("gaussian", (4, 5, 6)), ("past", (7, 8, 9)), ("preview", (5, 5, 5))):
        for seed, k in enumerate(wins):
            for checkpoint, successes in ((50, 0), (100, k)):
                results.add(
                    replace(ROW, prior=prior, seed=seed, checkpoint=checkpoint, successes=successes)
                )
    return results


def test_rows_survive_and_resume(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    assert stored["meta"] == META
    assert stored["rows"][1]["success_rate"] == 0.4
    again = Results(results.path, META, resume=True)
    assert again.rows == results.rows
    assert again.find(replace(ROW, successes=-1, mean_steps=0.0).cell).successes == 4
    assert again.find(replace(ROW, nfe=3).cell) is None
    assert Results(results.path, META).rows == []  # without resume


def test_damaged_file_is_named(tmp_path):
    path = tmp_path / "results.json"
    path.write_text('{"meta": {}, "rows": [{"task": 1}]}')
    with pytest.raises(ValueError, match=r"results\.json"):
        Results(path, META, resume=True)


def test_resuming_another_runs_file_is_refused(tmp_path):
    results = filled(tmp_path, META | {"training": {"betas": (0.9, 0.999)}})
    same = META | {"training": {"betas": (0.9, 0.999)}}
    assert Results(results.path, same, resume=True, identity=("training",)).rows == results.rows
    other = META | {"training": {"betas": (0.9, 0.99)}}
    with pytest.raises(ValueError, match="other options: its training"):
        Results(results.path, other, resume=True, identity=("training",))


def test_summary_takes_the_best_checkpoints_of_each_seed(tmp_path):
    summary = summarize(filled(tmp_path).rows, top_k=1)["past", 1]
    assert summary.mean == pytest.approx(0.8)
    assert summary.std == pytest.approx(0.1)
    assert summarize(filled(tmp_path).rows, top_k=2)["past", 1].mean == pytest.approx(0.4)


def test_table_shows_gains_marks_and_the_papers_row(tmp_path):
    table = success_table(
        filled(tmp_path), priors=["gaussian", "past", "preview"], nfes=[1], top_k=1
    )
    measured, paper = (line for line in table.splitlines() if line.startswith("| Square-PH"))
    assert measured == (
        "| Square-PH, measured (scripted data) | 50.0 | **80.0** (+30.0*) | 50.0 (+0.0) |"
    )
    assert paper == "| Square-PH, paper (official data) | 83.6 | 86.6 (+3.0) | 87.3 (+3.7) |"
    assert "compare gains within a row" in table
    assert "short of training" not in table and "bound" not in table


def test_a_gain_that_rounds_to_zero_has_no_minus(tmp_path):
    results = Results(tmp_path / "results.json", META)
    for prior, wins in (
        ("gaussian", (46, 46)),
        ("past", (45, 47)),
    ):  # means differ by rounding alone
        for seed, k in enumerate(wins):
            results.add(replace(ROW, prior=prior, seed=seed, episodes=50, successes=k))
    table = success_table(results, priors=["gaussian", "past"], nfes=[1], top_k=1)
    assert "(+0.0)" in table and "-0.0" not in table


def test_table_says_what_is_short_of_training(tmp_path):
    options = {"priors": ["gaussian", "past", "preview"], "nfes": [1], "top_k": 1}
    table = success_table(filled(tmp_path, META | {"short_of_training": ["preview"]}), **options)
    assert "WP-Preview: short of training" in table and "WP-Past: short" not in table


def test_table_shows_what_the_source_leaks(tmp_path):
    """Means over seeds of the last checkpoints, with a mark above the bound."""
    results = filled(tmp_path)
    results.rows = [
        replace(row, source_leak=0.2 + row.seed / 10, inner_step_ratio=1.5)
        if (row.prior, row.checkpoint) == ("past", 100)
        else replace(row, source_leak=9.0 if row.checkpoint == 50 else None)
        for row in results.rows
    ]
    table = success_table(results, priors=["gaussian", "past", "preview"], nfes=[1], top_k=1)
    assert "| spread over draws of the source / data's (bound 1) | - | 0.30 | - |" in table
    assert "| step inside chunks / data's (bound 1.3) | - | 1.50 (!) | - |" in table


def test_paper_numbers_cover_table_1():
    assert paper_success("transport", "mh", "preview", 3) == 30.4
    assert paper_success("lift", "ph", "past", 1) is None
    assert paper_success("square", "ph", "regression", 1) is None


def test_figures_are_written(tmp_path):
    np = pytest.importorskip("numpy")
    pytest.importorskip("matplotlib")
    results, priors = filled(tmp_path), ["gaussian", "past", "preview"]
    plot_success(results.rows, tmp_path / "a.png", priors=priors, nfes=[1], title="t")
    losses = {prior: [[(10, 1.0), (20, 0.5)]] * 3 for prior in priors}
    plot_learning_curves(losses, results.rows, tmp_path / "b.png", nfe=1, title="t")
    frames = [np.zeros((8, 8, 3), dtype=np.uint8)] * 2
    plot_filmstrip(frames, ["0", "8"], tmp_path / "c.png", title="t")
    for name in "abc":
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"successes": 99, "episodes": 2}, "99 successes in 2 episodes"),
        ({"successes": -1}, "successes"),
        ({"episodes": 0, "successes": 0}, "episodes"),
        ({"episodes": 10.0}, "episodes"),
        ({"episodes": True, "successes": 1}, "episodes"),
        ({"successes": "5"}, "successes"),
        ({"task": 3}, "task"),
        ({"nfe": 0}, "nfe"),
        ({"chunk": 0}, "chunk"),
        ({"sigma": -1.0}, "sigma"),
        ({"sigma": None}, "sigma"),
        ({"seed": -1}, "seed"),
        ({"mean_steps": float("nan")}, "mean_steps"),
        ({"source_leak": "high"}, "source_leak"),
        ({"inner_jump": -0.5}, "inner_jump"),
        ({"success_rate": 0.9}, "success_rate"),
        ({"success_rate": None}, "success_rate"),
        ({"unknown": 1}, "unknown"),
    ],
    ids=str,
)
def test_rows_that_cannot_have_been_measured(tmp_path, change, said):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    stored["rows"][2] |= change
    if {"successes", "episodes"} & change.keys():
        row = stored["rows"][2]
        with contextlib.suppress(TypeError, ZeroDivisionError):
            row["success_rate"] = row["successes"] / row["episodes"]
    results.path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=rf"(?s)results\.json.*row 2.*{said}"):
        Results(results.path, META, resume=True)


def test_rows_that_contradict_each_other(tmp_path):
    results = filled(tmp_path)
    stored = json.loads(results.path.read_text())
    stored["rows"].append(dict(stored["rows"][2]))  # the same once more does no harm
    results.path.write_text(json.dumps(stored))
    assert Results(results.path, META, resume=True).rows == results.rows
    stored["rows"][-1] |= {"successes": 9, "success_rate": 0.9}
    results.path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"results\.json.*row 18 contradicts row 2"):
        Results(results.path, META, resume=True)


@pytest.mark.parametrize(
    "text", ["", "[" * 100_000, "[]", "null", '{"rows": 3, "meta": {}}'], ids=range(5)
)
def test_a_file_that_is_no_results(tmp_path, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"results\.json"):
        Results(path, META, resume=True)
