"""Pictures of the benchmarks: that they are written, and which numbers they show."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

import plots
import prior_space_rl
import sigma
from matplotlib.image import imread
from report import labelled, per_seed

from tests.benchmarks.test_report import compared as rows_compared
from tests.benchmarks.test_report import curved, row

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


def test_bars_are_one_colour_per_method_in_all_problems(tmp_path, figures):
    rows = named(
        row(k + d, prior=p, guidance=g, delay=d, boundary_jump=jump, task=task)
        for task, skipped in (("square", 0), ("can", 2))
        for d in (0, 2)
        for p, g, k, jump in (
            ("gaussian", "none", 3, 0.5),
            ("past", "none", 6, 0.1),
            ("past", "rtc", 5, None),
        )[skipped:]
    )
    measures = {"success_rate": "success", "boundary_jump": "jump"}
    plots.plot_bars(rows, tmp_path / "a.png", "t", "delay", measures)
    ((square, can, jumps, _),) = figures
    assert texts(square.texts) == ["30", "60", "50", "50", "80", "70"]
    assert texts(jumps.texts) == ["0.50", "0.10"] * 2
    assert texts(can.get_xticklabels()) == ["0", "2"] and can.get_title() == "Can-PH"
    (legend,) = square.figure.legends
    assert texts(legend.get_texts()) == ["Base", "WP-Past", "RTC + WP-Past"]
    colors = [bar.get_facecolor() for bar in square.patches]
    assert len(set(colors)) == 3 and {bar.get_facecolor() for bar in can.patches} == {colors[2]}


@pytest.mark.parametrize("options", [[f"correlation=0.{k}" for k in range(10, 40)], ["o" * 70 + "=0.5"]])
def test_names_are_not_cut_off_at_the_edges(tmp_path, figures, options):
    rows = named(row(prior="past", options=o) for o in options)
    plots.plot_success(rows, tmp_path / "a.png", "t")
    image = imread(tmp_path / "a.png")[..., :3]
    assert all((edge == 1).all() for edge in (image[:, :3], image[:, -3:], image[:3], image[-3:]))
    ((axis,),) = figures
    assert axis.get_window_extent().height > 100  # pixels
    assert texts(axis.figure.legends[0].get_texts()) == [f"WP-Past, {o}" for o in options]


def test_learning_curves_have_a_loss_per_seed_and_success_per_checkpoint(tmp_path, figures):
    losses = {name: [[(10, 1.0), (20, 0.5)]] * 3 for name in ("Base", "WP-Past", "WP-Preview")}
    plots.plot_learning_curves(losses, compared(), tmp_path / "a.png", "t")
    ((left, right),) = figures
    assert len(left.get_lines()) == 9
    means = [container.lines[0] for container in right.containers]
    assert [list(line.get_xdata()) for line in means] == [[50, 100]] * 3
    assert [line.get_ydata()[1] for line in means] == pytest.approx([0.5, 0.8, 0.5])
    assert left.get_lines()[3].get_color() == means[1].get_color()


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


def test_sigma_is_drawn_relative_to_the_first_policy(tmp_path, figures):
    facts = [("gaussian", 1.0, 8.0), ("past", 1.0, 4.0), ("past", 0.5, 2.0)]
    rows, flows = [], []
    for prior, level, bound in facts:
        rows.append(row(int(10 * level), prior=prior, sigma=level))
        flow = {"sigma": level, "bound_executed": bound, "ratio_executed": bound / 10}
        flows.append(curved(prior, **flow))
    sigma.draw(pd.DataFrame(rows), pd.DataFrame(flows), tmp_path / "a.png", 1, "t")
    ((success, below),) = figures
    assert lines_of(success) == [("Base", [1.0]), ("WP-Past", [1.0, 0.5])]
    heights = [heights for _, heights in lines_of(below)]
    assert heights == [[0.8], [1.0], [0.4, 0.2], [4 / 8, 2 / 8]]
    assert texts(below.get_xticklabels()) == ["1", "0.5"]


def test_pictures_of_the_toy_and_of_episodes(tmp_path, figures):
    panels = {f"policy {i}": (torch.ones(2, 64), ["text"]) for i in range(26)}
    plots.plot_navigation(panels, tmp_path / "a.png", chunk_length=8, title="t")
    titles = [axis.get_title() for axis in figures[0][:27]]
    assert titles[12] == "(m) policy 11" and titles[25:] == ["(z) policy 24", "policy 25"]
    lines = torch.linspace(0, 1, 5) * torch.tensor([[-1.0], [1.0]])
    plots.plot_flow_paths({"Base": lines, "WP-Past": lines}, tmp_path / "b.png", "t")
    colors = [line.get_color() for line in figures[1][0].get_lines()]
    assert colors[:2] == [plots.BELOW, plots.ABOVE] and imread(tmp_path / "b.png").shape[1] == 825
    plots.plot_filmstrip([np.zeros((8, 8, 3), np.uint8)] * 3, list("abc"), tmp_path / "c.png", "t")
    assert imread(tmp_path / "c.png").shape[:2] == (300, 675)
