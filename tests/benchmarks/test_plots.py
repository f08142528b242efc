"""Pictures of the benchmarks: that they are written, and which numbers they show."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

import plots
import prior_space_rl
from report import labelled, per_seed

from tests.benchmarks.test_report import compared as rows_compared
from tests.benchmarks.test_report import row

NAMES = ["WP-Past", "WP-Past, correlation=0.5"]


@pytest.fixture
def figures(monkeypatch):
    """The axes of every figure that is drawn."""
    drawn, make = [], plots.new_figure

    def spy(*args, **options):
        figure, axes = make(*args, **options)
        drawn.append(axes)
        return figure, axes

    monkeypatch.setattr(plots, "new_figure", spy)
    return drawn


def compared():
    return labelled(rows_compared())


def variants(**more):
    """WP-Past without options and with: solved more often."""
    return [
        row(k, prior="past", seed=seed, options=options, **more)
        for k, options in ((2, ""), (8, "correlation=0.5"))
        for seed in (0, 1)
    ]


def texts(artists):
    return [artist.get_text() for artist in artists]


def lines_of(axis):
    """Names and heights of the lines, each of a look of its own."""
    lines = axis.get_lines()
    assert len({(str(line.get_color()), line.get_linestyle(), line.get_marker()) for line in lines}) == len(
        lines
    )
    return [(line.get_label(), list(line.get_ydata())) for line in lines]


def named(rows, *apart):
    return labelled(pd.DataFrame(rows), *apart)


def edges(axis, k=0):
    """Lower and upper edge of the k-th band, by position."""
    found = {}
    for x, y in axis.collections[k].get_paths()[0].vertices:
        found.setdefault(round(float(x), 6), []).append(float(y))
    return {x: (min(ys), max(ys)) for x, ys in found.items()}


def test_violins_pool_the_seeds_of_a_method(tmp_path, figures):
    rows = compared()
    plots.plot_success(rows[rows["checkpoint"] == 100], tmp_path / "a.png", "t")
    ((axis,),) = figures
    assert texts(axis.texts) == ["15/30", "24/30", "15/30"] and texts(axis.get_xticklabels()) == ["NFE 1"]
    means = [line.get_ydata()[0] for line in axis.get_lines()]
    assert means == pytest.approx([16 / 32, 25 / 32, 16 / 32])  # of Beta(k + 1, n - k + 1)
    assert axis.get_legend_handles_labels()[1] == ["Base", "WP-Past", "WP-Preview"]
    rows = named([row(k, algorithm=a, prior=p) for a, k in (("na", 3), ("sac", 4)) for p in ("past", "ot")])
    plots.plot_success(rows, tmp_path / "b.png", "t", group="algorithm")
    assert texts(figures[1][0].get_xticklabels()) == ["ALGORITHM NA", "ALGORITHM SAC"]
    assert texts(figures[1][0].texts) == ["3/10", "3/10", "4/10", "4/10"]


def test_bars_are_means_over_seeds_with_their_number_above_the_deviation(tmp_path, figures):
    rows = per_seed(
        labelled(
            pd.concat([rows_compared(), pd.DataFrame([row(10, prior="past", chunk=1)])], ignore_index=True),
            "chunk",
        ),
        1,
    )
    plots.plot_bars(rows, tmp_path / "a.png", "t", "chunk", {"success": "success"})
    ((axis,),) = figures
    assert texts(axis.texts) == ["50", "80", "50", "100"]
    assert texts(axis.get_xticklabels()) == ["8", "1"]
    # 4, 5 and 6; 7, 8 and 9; three times 5; and 10 of 10 episodes.
    assert [text.xy[1] for text in axis.texts] == pytest.approx([0.6, 0.9, 0.5, 1.0])


def test_agents_are_averaged_evaluation_by_evaluation(tmp_path, figures):
    points = [(0, 0, "base", 0.2), (0, 100, "greedy", 0.4), (0, 100, "stochastic", 0.1)]
    points += [(0, 200, "greedy", 0.9), (1, 0, "base", 0.4), (1, 110, "greedy", 0.8)]
    points += [(1, 110, "stochastic", 0.1)]
    rows = named(
        row(prior="past", algorithm=a, seed=s, environment_steps=n, evaluation=e, options=o)
        | {"success_rate": rate}
        for a, o in (("dsrl-na", ""), ("dsrl-sac", ""), ("dsrl-na", "correlation=0.5"))
        for s, n, e, rate in points
    )
    prior_space_rl.draw(rows, tmp_path / "a.png", "toy", 50)
    ((greedy, stochastic),) = figures
    # Seed 1 has no third evaluation: what both have is averaged.
    for axis, last in ((greedy, (0.4, 0.8)), (stochastic, (0.1, 0.1))):
        assert lines_of(axis)[0][1] == pytest.approx([0.3, np.mean(last)])
        assert axis.get_lines()[0].get_xdata() == pytest.approx([0.0, 105.0])
        spread = np.std(last, ddof=1)
        assert edges(axis)[105.0] == pytest.approx((np.mean(last) - spread, np.mean(last) + spread))
    assert [name for name, _ in lines_of(greedy)] == [
        *("DSRL-NA, WP-Past", "DSRL-SAC, WP-Past", "DSRL-NA, WP-Past, correlation=0.5")
    ]


def test_lines_have_a_panel_per_measure_and_column(tmp_path, figures):
    jumps = {"boundary_jump": 1.0, "inner_jump": 0.5}
    rows = [one for chunk in (1, 8) for nfe in (9, 1) for one in variants(chunk=chunk, nfe=nfe, **jumps)]
    lines = {"success_rate": "success", ("boundary_jump", "inner_jump"): "jump"}
    plots.plot_lines(named(rows, "chunk"), tmp_path / "a.png", "t", "chunk", lines)
    (nine, one, below, _) = figures[0]
    assert (nine.get_title(), one.get_title()) == ("NFE 9", "NFE 1")
    assert lines_of(nine) == [(NAMES[0], [0.2, 0.2]), (NAMES[1], [0.8, 0.8])]
    assert [heights for _, heights in lines_of(below)] == [[1.0, 1.0], [0.5, 0.5]] * 2
    assert list(nine.get_lines()[0].get_xdata()) == [0, 1] and texts(nine.get_xticklabels()) == ["1", "8"]
    rows = [one for n in (50, 100) for one in variants(iterations=n, action_error=n / 1000)]
    error = {"action_error": "error"}
    plots.plot_lines(named(rows), tmp_path / "b.png", "t", "iterations", error, scale="log")
    assert [heights for _, heights in lines_of(figures[1][0])] == [[0.05, 0.1]] * 2
    assert figures[1][0].get_xscale() == "log"
