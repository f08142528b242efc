"""Figures: that they are written, and which numbers end up in the curves of agents."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

from matplotlib.image import imread

from tests.experiments.row_parts import compared, row
from warmprior.experiments import (
    Row,
    guided_labels,
    navigation_figures,
    plot_budget,
    plot_chunk_lengths,
    plot_delays,
    plot_filmstrip,
    plot_learning_curves,
    plot_navigation,
    plot_reinforcement,
    plot_sigma,
    plot_success,
    plot_success_bars,
    select,
    source_labels,
    study_figures,
)
from warmprior.experiments import (
    figures as module,
)


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")


def rows(seed, points, algorithm="dsrl-na", prior="past"):
    key = {"algorithm": algorithm, "prior": prior, "seed": seed}
    for steps, values in points:
        for evaluation, value in values.items():
            facts = {"environment_steps": steps, "evaluation": evaluation}
            yield Row(key | facts, {"success_rate": value})


TWO_SEEDS = [
    *rows(0, [(0, {"base": 0.2}), (100, {"greedy": 0.4, "stochastic": 0.1})]),
    *rows(0, [(200, {"greedy": 0.9, "stochastic": 0.3})]),
    *rows(1, [(0, {"base": 0.4}), (110, {"greedy": 0.8, "stochastic": 0.1})]),
]


@pytest.fixture
def figures(monkeypatch):
    """The axes of every figure that is drawn."""
    drawn = []

    def spy(*args, **kwargs):
        figure, axes = make(*args, **kwargs)
        drawn.append(axes)
        return figure, axes

    make = module.new_figure
    for each in (module, study_figures, navigation_figures):
        monkeypatch.setattr(each, "new_figure", spy)
    return drawn


def band(axis, k=0):
    """Lower and upper edge of the ``k``-th band, by position."""
    vertices = axis.collections[k].get_paths()[0].vertices
    edges = {}
    for x, y in vertices:
        edges.setdefault(round(float(x), 6), []).append(float(y))
    return {x: (min(ys), max(ys)) for x, ys in edges.items()}


def test_mean_and_deviation_over_seeds_evaluation_by_evaluation(tmp_path, figures):
    path = tmp_path / "curves.png"
    plot_reinforcement(iter(TWO_SEEDS), path, title="toy", warmup_steps=50)
    assert is_png(path)
    ((greedy, stochastic),) = figures
    # Seed 1 has no third evaluation: what both have is averaged.
    for axis, last in ((greedy, [0.4, 0.8]), (stochastic, [0.1, 0.1])):
        (line,) = axis.get_lines()
        assert line.get_xdata() == pytest.approx([0.0, 105.0])
        assert line.get_ydata() == pytest.approx([0.3, np.mean(last)])
        spread = np.std(last, ddof=1)
        expected = (np.mean(last) - spread, np.mean(last) + spread)
        assert band(axis)[105.0] == pytest.approx(expected)
        assert "2 seeds" in line.get_label() and axis.get_title().startswith(
            "greedy" if axis is greedy else "stochastic"
        )


def test_one_seed_has_no_band_and_every_agent_a_line(tmp_path, figures):
    other = rows(0, [(0, {"base": 0.0}), (90, {"greedy": 1.0, "stochastic": 1.0})], "dsrl-sac")
    third = rows(
        0, [(0, {"base": 0.5}), (90, {"greedy": 1.0, "stochastic": 1.0})], prior="gaussian"
    )
    everything = [*TWO_SEEDS, *other, *third]
    plot_reinforcement(everything, tmp_path / "c.png", title="toy", warmup_steps=50)
    for axis in figures[0]:
        lines = axis.get_lines()
        assert [line.get_ydata()[0] for line in lines] == pytest.approx([0.3, 0.0, 0.5])
        assert all(low == high for low, high in band(axis, 1).values())
        # Algorithms differ in style, priors in colour.
        assert lines[0].get_linestyle() != lines[1].get_linestyle() == "--"
        assert lines[0].get_color() == lines[1].get_color() != lines[2].get_color()


def test_success_pools_the_seeds_of_a_source(tmp_path, figures):
    last = select(compared(), checkpoint=100)
    plot_success(iter(last), tmp_path / "a.png", title="t")
    assert is_png(tmp_path / "a.png")
    ((axis,),) = figures
    assert [text.get_text() for text in axis.texts] == ["15/30", "24/30", "15/30"]
    assert [text.get_text() for text in axis.get_xticklabels()] == ["NFE 1"]
    # The tick is the mean of Beta(k + 1, n - k + 1).
    means = [line.get_ydata()[0] for line in axis.get_lines()]
    assert means == pytest.approx([16 / 32, 25 / 32, 16 / 32])
    assert axis.get_legend_handles_labels()[1] == ["Base", "WP-Past", "WP-Preview"]


@pytest.mark.parametrize(
    "draw",
    [
        lambda rows, path: plot_success(rows, path, title="t"),
        lambda rows, path: plot_success_bars(rows, path, top_k=1, title="t"),
        lambda rows, path: plot_delays(rows, path, label=source_labels(rows), top_k=1, title="t"),
    ],
    ids=["violins", "bars", "delays"],
)
@pytest.mark.parametrize(
    "options",
    [
        [f"correlation=0.{k}" for k in range(1, 6)],
        [f"correlation=0.{k}" for k in range(10, 40)],  # the legend is higher than the axes
        ["correlation=0.5,a_long_name_of_an_option_beyond_the_width=0.5"],
    ],
    ids=["five", "thirty", "long"],
)
def test_names_of_sources_are_not_cut_off_at_the_edges(tmp_path, figures, draw, options):
    measures = {"boundary_jump": 0.5}
    draw(
        [row(prior="past", options=o, delay=0, measures=measures) for o in options],
        tmp_path / "a.png",
    )
    image = imread(tmp_path / "a.png")[..., :3]
    edges = image[:, :3], image[:, -3:], image[:3], image[-3:]
    assert all((edge == 1).all() for edge in edges)
    ((axis, *_),) = figures
    assert axis.get_window_extent().height > 100  # pixels
    (legend,) = axis.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [f"WP-Past, {o}" for o in options]


def test_violins_of_several_groups_stand_side_by_side(tmp_path, figures):
    agents = [
        Row({**row(k, prior=prior).facts, "algorithm": algorithm}, row(k).measures)
        for algorithm, k in (("dsrl-na", 3), ("dsrl-sac", 4))
        for prior in ("gaussian", "past")
    ]
    plot_success(agents, tmp_path / "a.png", title="t", group=lambda row: row["algorithm"].upper())
    ((axis,),) = figures
    assert [text.get_text() for text in axis.get_xticklabels()] == ["DSRL-NA", "DSRL-SAC"]
    assert [text.get_text() for text in axis.texts] == ["3/10", "3/10", "4/10", "4/10"]


def test_bars_are_means_over_seeds_in_groups_of_one_chunk_length(tmp_path, figures):
    shown = [*select(compared(), checkpoint=100), row(10, prior="past", chunk=1)]
    plot_success_bars(shown, tmp_path / "b.png", top_k=1, title="t")
    assert is_png(tmp_path / "b.png")
    ((axis,),) = figures
    assert [text.get_text() for text in axis.texts] == ["50", "80", "50", "100"]
    assert [text.get_text() for text in axis.get_xticklabels()] == ["H = 8", "H = 1"]


def test_bars_of_success_and_jumps_by_delay(tmp_path, figures):
    told = {"execute": 4}
    shown = [
        row(
            wins,
            measures={"boundary_jump": jump},
            prior=prior,
            guidance=guidance,
            delay=delay,
            **told,
        )
        for delay in (2, 0)
        for prior, guidance, wins, jump in (
            ("gaussian", "none", 3, 0.5),
            ("gaussian", "rtc", 5, 0.25),
            ("past", "none", 6 + delay, 0.1),
        )
    ]
    plot_delays(shown, tmp_path / "a.png", label=guided_labels(shown), top_k=1, title="t")
    assert is_png(tmp_path / "a.png")
    ((above, below),) = figures
    assert above.get_legend_handles_labels()[1] == ["Base", "RTC", "WP-Past"]
    assert [text.get_text() for text in above.texts] == ["30", "50", "60", "30", "50", "80"]
    assert [text.get_text() for text in below.texts] == 2 * ["0.50", "0.25", "0.10"]
    assert [text.get_text() for text in below.get_xticklabels()] == ["delay 0", "delay 2"]
    assert len({bar.get_facecolor() for bar in above.patches}) == 3


def test_numbers_of_bars_stand_above_their_deviation_over_seeds(tmp_path, figures):
    plot_success_bars(compared(), tmp_path / "a.png", top_k=1, title="t")
    ((axis,),) = figures
    heights = [text.xy[1] for text in axis.texts]
    # 4, 5 and 6, 7, 8 and 9, and three times 5 of 10 episodes.
    assert heights == pytest.approx([0.5 + 0.1, 0.8 + 0.1, 0.5])


def test_the_legend_of_delays_has_sources_of_later_tasks_as_well(tmp_path, figures):
    parts = (("square", "gaussian"), ("can", "gaussian"), ("can", "past"))
    shown = [
        row(task=task, prior=prior, delay=0, measures={"boundary_jump": 0.5})
        for task, prior in parts
    ]
    plot_delays(shown, tmp_path / "a.png", label=source_labels(shown), top_k=1, title="t")
    (legend,) = figures[0][0].figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["Base", "WP-Past"]


def test_a_source_has_one_colour_whichever_task_of_the_delays_has_it(tmp_path, figures):
    jumps = {"boundary_jump": 0.5}
    of_square, of_can = (
        list(variants(task=task, delay=0, measures=jumps)) for task in ("square", "can")
    )
    shown = [*of_square, *of_can[2:]]  # of can that with options alone
    plot_delays(shown, tmp_path / "a.png", label=source_labels(shown), top_k=1, title="t")
    ((square, can, *_),) = figures
    past, correlated = (bar.get_facecolor() for bar in square.patches)
    assert past != correlated
    assert [bar.get_facecolor() for bar in can.patches] == [correlated]


def test_learning_curves_have_a_loss_per_seed_and_success_per_checkpoint(tmp_path, figures):
    losses = {prior: [[(10, 1.0), (20, 0.5)]] * 3 for prior in ("gaussian", "past", "preview")}
    plot_learning_curves(losses, compared(), tmp_path / "b.png", title="t")
    assert is_png(tmp_path / "b.png")
    ((left, right),) = figures
    assert len(left.get_lines()) == 9
    means = [container.lines[0] for container in right.containers]
    assert [list(line.get_xdata()) for line in means] == [[50, 100]] * 3
    assert [line.get_ydata()[1] for line in means] == pytest.approx([0.5, 0.8, 0.5])
    assert [line.get_ydata()[0] for line in means] == [0.0] * 3


def test_a_filmstrip_is_written(tmp_path):
    frames = [np.zeros((8, 8, 3), dtype=np.uint8)] * 2
    plot_filmstrip(frames, ["0", "8"], tmp_path / "c.png", title="t")
    assert is_png(tmp_path / "c.png")


def variants(**more):
    """WP-Past as an earlier version wrote it, without options, and with options: solved more often."""
    for k, told in ((2, {}), (8, {"options": "correlation=0.5"})):
        for seed in (0, 1):
            yield row(k, prior="past", seed=seed, **told, **more)


TOLD = ["WP-Past", "WP-Past, correlation=0.5"]


def told_apart(lines):
    """Names and heights of the lines, each of a look of its own."""
    assert len({(str(line.get_color()), line.get_linestyle()) for line in lines}) == len(lines)
    return [(line.get_label(), list(line.get_ydata())) for line in lines]


def test_options_of_a_prior_have_bars_and_violins_of_their_own(tmp_path, figures):
    shown = list(variants())
    plot_success_bars(shown, tmp_path / "a.png", top_k=1, title="t")
    plot_success(shown, tmp_path / "b.png", title="t")
    (bars,), (violins,) = figures
    assert [text.get_text() for text in bars.texts] == ["20", "80"]
    assert [text.get_text() for text in violins.texts] == ["4/20", "16/20"]
    for axis in (bars, violins):
        assert axis.get_legend_handles_labels()[1] == TOLD
    assert len({bar.get_facecolor() for bar in bars.patches}) == 2
    assert len({tuple(each.get_facecolor()[0]) for each in violins.collections}) == 2


def test_options_of_a_prior_have_learning_curves_of_their_own(tmp_path, figures):
    losses = {name: [[(10, 1.0), (20, 0.5)]] for name in TOLD}
    plot_learning_curves(losses, variants(), tmp_path / "a.png", title="t")
    ((left, right),) = figures
    assert [name for name, _ in told_apart(left.get_lines())] == TOLD
    assert [k.lines[0].get_ydata()[0] for k in right.containers] == pytest.approx([0.2, 0.8])


def test_options_of_a_prior_have_lines_of_their_own_against_the_chunk_length(tmp_path, figures):
    jumps = {"boundary_jump": 1.0, "inner_jump": 0.5}
    shown = [one for chunk in (1, 8) for one in variants(chunk=chunk, measures=jumps)]
    plot_chunk_lengths(shown, tmp_path / "a.png", top_k=1, title="t")
    ((above, below),) = figures
    assert told_apart(above.get_lines()) == [(TOLD[0], [0.2, 0.2]), (TOLD[1], [0.8, 0.8])]
    assert len(told_apart(below.get_lines())) == 4


def test_options_of_a_prior_have_lines_of_their_own_against_the_budget(tmp_path, figures):
    measured = {"action_error": 0.1}
    shown = [one for n in (50, 100) for one in variants(iterations=n, measures=measured)]
    plot_budget(shown, tmp_path / "a.png", top_k=1, title="t")
    ((above, below),) = figures
    assert told_apart(above.get_lines()) == [(TOLD[0], [0.2, 0.2]), (TOLD[1], [0.8, 0.8])]
    assert len(told_apart(below.get_lines())) == 2


def _beside(axis):
    """The axis of the right-hand side."""
    (right,) = (
        each
        for each in axis.figure.axes
        if each.bbox.bounds == axis.bbox.bounds and each is not axis
    )
    return right


def test_options_of_a_prior_have_panels_of_their_own_against_sigma(tmp_path, figures):
    shown = [row(5, seed=0)]
    for sigma in (0.1, 0.5):
        shown += variants(sigma=sigma)
        for told, ratio in (("", 0.25), ("correlation=0.5", 0.75)):
            facts = {"prior": "past", "options": told, "sigma": sigma, "seed": 0}
            measures = {"ratio_executed": ratio, "bound_executed": 1.0}
            shown.append(Row(facts | {"mean": "training"}, measures))
    plot_sigma(shown, tmp_path / "a.png", top_k=1, title="t")
    (panels,) = figures
    assert [axis.get_title() for axis in panels] == TOLD
    for axis, success, ratio in zip(panels, (0.2, 0.8), (0.25, 0.75), strict=True):
        assert list(axis.get_lines()[0].get_ydata()) == [success] * 2
        assert list(_beside(axis).get_lines()[0].get_ydata()) == [ratio] * 2


def test_bounds_of_all_sources_are_told_relative_to_the_baselines(tmp_path, figures):
    shown = []
    for prior, sigma, bound in (
        *(("gaussian", 1.0, 8.0), ("past", 1.0, 4.0), ("past", 0.5, 2.0)),
        *(("preview", 1.0, 6.0), ("preview", 0.5, 1.0)),
    ):
        facts = {"prior": prior, "options": "", "sigma": sigma, "seed": 0, "nfe": 1}
        shown.append(Row(facts | {"checkpoint": 1}, {"success_rate": 0.5}))
        measures = {"ratio_executed": 1.0, "bound_executed": bound}
        shown.append(Row(facts | {"mean": "training"}, measures))
    plot_sigma(shown, tmp_path / "a.png", top_k=1, title="t")
    (panels,) = figures
    bounds = [list(_beside(axis).get_lines()[1].get_ydata()) for axis in panels]
    assert bounds == [[0.5, 0.25], [0.75, 0.125]]


@pytest.mark.parametrize("bounds", [(8.0, 2.0), (None, None)])
def test_without_a_baseline_the_bound_is_told_relative_to_the_first_sigma(
    bounds, tmp_path, figures
):
    shown = []
    for sigma, ratio, bound in zip((1.0, 0.5), (1.0, 0.4), bounds, strict=True):
        facts = {"prior": "past", "options": "", "sigma": sigma, "seed": 0, "nfe": 1}
        shown.append(Row(facts | {"checkpoint": 1}, {"success_rate": 0.5}))
        measures = {"ratio_executed": ratio, "bound_executed": bound}
        shown.append(Row(facts | {"mean": "training"}, measures))
    plot_sigma(shown, tmp_path / "a.png", top_k=1, title="t")
    ((axis,),) = figures
    told = [(line.get_label(), list(line.get_ydata())) for line in _beside(axis).get_lines()]
    curvature = ("curvature (executed H)", [1.0, 0.4])
    assert told == [curvature, ("branching bound", [1.0, 0.25])][: 1 if bounds[0] is None else 2]


def test_options_of_a_prior_are_agents_of_their_own(tmp_path, figures):
    points = [(0, {"base": 0.0}), (90, {"greedy": 1.0, "stochastic": 1.0})]
    other = [
        Row({**each.facts, "options": "correlation=0.5"}, each.measures) for each in rows(0, points)
    ]
    plot_reinforcement([*TWO_SEEDS, *other], tmp_path / "a.png", title="t", warmup_steps=50)
    for axis in figures[0]:
        (_, first), (name, second) = told_apart(axis.get_lines())
        assert first[0] == pytest.approx(0.3) and second == [0.0, 1.0]
        assert name == "DSRL-NA, WP-Past, correlation=0.5 (1 seed)"


def test_panels_beyond_the_alphabet_have_no_letters(tmp_path, figures):
    panels = {f"policy {i}": (torch.zeros(1, 64), ["told"]) for i in range(26)}
    plot_navigation(panels, tmp_path / "a.png", chunk_length=8, title="t")
    ((*axes,),) = figures
    titles = [axis.get_title() for axis in axes[:27]]
    assert titles[12] == "(m) policy 11" and titles[25:] == ["(z) policy 24", "policy 25"]
