"""Pictures of the benchmarks: which numbers they show. That each is written, the studies' tests say."""

import pandas as pd
import pytest
from matplotlib.image import imread

from lab.reporting import plots
from lab.reporting.report import labelled, per_seed
from tests.benchmarks.test_report import compared, row


@pytest.fixture
def figures(monkeypatch):
    drawn, make = [], plots.new_figure

    def spy(*args, **options):
        figure, axes = make(*args, **options)
        drawn.append(axes)
        return figure, axes

    monkeypatch.setattr(plots, "new_figure", spy)
    return drawn


def texts(artists):
    return [artist.get_text() for artist in artists]


def lines_of(axis):
    """Names and heights of the lines, each of a look of its own."""
    lines = axis.get_lines()
    looks = {(str(line.get_color()), line.get_linestyle(), line.get_marker()) for line in lines}
    assert len(looks) == len(lines)
    return [(line.get_label(), list(line.get_ydata())) for line in lines]


def test_violins_and_bars_show_what_the_seeds_of_a_method_have_in_common(tmp_path, figures):
    rows = labelled(compared())
    plots.plot_success(rows[rows["checkpoint"] == 100], tmp_path / "a.png", "t")
    ((axis,),) = figures
    assert texts(axis.texts) == ["15/30", "24/30", "15/30"] and texts(axis.get_xticklabels()) == ["NFE 1"]
    ticks, dots = axis.get_lines()[::2], axis.get_lines()[1::2]
    means = [line.get_ydata()[0] for line in ticks]
    assert means == pytest.approx([16 / 32, 25 / 32, 16 / 32])  # of Beta(k + 1, n - k + 1)
    assert [list(line.get_ydata()) for line in dots] == [[0.4, 0.5, 0.6], [0.7, 0.8, 0.9], [0.5] * 3]
    assert axis.get_legend_handles_labels()[1] == ["Gaussian source", "WP-Past", "WP-Preview"]
    image = imread(tmp_path / "a.png")[..., :3]  # nothing is cut off at the edges
    assert all((edge == 1).all() for edge in (image[:, :3], image[:, -3:], image[:3], image[-3:]))

    both = pd.concat([compared(), pd.DataFrame([row(10, prior="past", chunk=1)])], ignore_index=True)
    bars = per_seed(labelled(both, "chunk"), 1)
    plots.plot_bars(bars, tmp_path / "b.png", "t", "chunk", {"success": "success"})
    (axis,) = figures[1]
    assert texts(axis.texts) == ["50", "80", "50", "100"] and texts(axis.get_xticklabels()) == ["8", "1"]
    # Above the deviation: 4, 5 and 6; 7, 8 and 9; three times 5; and 10 of 10 episodes.
    assert [text.xy[1] for text in axis.texts] == pytest.approx([0.6, 0.9, 0.5, 1.0])


@pytest.mark.parametrize("logged", [[100], [60, 80, 100]])
def test_learning_curves_show_every_checkpoint_and_every_loss(logged, tmp_path, figures):
    rows = labelled(compared())  # checkpoints at 50 and 100
    losses = {"WP-Past": [[(n, 1.0) for n in logged]]}
    plots.plot_learning_curves(losses, rows, tmp_path / "a.png", "t")
    for axis in figures[0]:
        low, high = axis.get_xlim()
        assert low < 50 and high > 100
    (line,) = figures[0][0].get_lines()  # a single point has no line
    assert (line.get_marker() == "") == (len(logged) > 1)
    plots.plot_learning_curves(losses, rows[rows.checkpoint == 100], tmp_path / "b.png", "t")
    assert [len(axes) for axes in figures] == [2, 1]  # one checkpoint is no curve


def test_priors_of_ones_own_have_colours_of_their_own():
    names = ["anchor", "damped", "last", "mean", "slow", "fast", "mine"]
    rows = pd.DataFrame([row(prior=name, sigma=1.0) for name in names])
    assert len(set(plots.colors_of(labelled(rows)).values())) == 7
    (first, *_), (alone,) = (plots.colors_of(labelled(part)).values() for part in (rows, rows[:1]))
    assert first == alone  # by its name, whatever it is compared with


def test_lines_have_a_panel_per_measure_and_column(tmp_path, figures):
    options = {"": 2, "correlation=0.5": 8}
    rows = [
        row(k, prior="past", seed=seed, options=o, chunk=chunk, nfe=nfe, boundary_jump=1.0, inner_jump=0.5)
        for o, k in options.items()
        for seed in (0, 1)
        for chunk in (1, 8)
        for nfe in (9, 1)
    ]
    lines = {"success_rate": "success", ("boundary_jump", "inner_jump"): "jump"}
    plots.plot_lines(labelled(pd.DataFrame(rows), "chunk"), tmp_path / "a.png", "t", "chunk", lines)
    (nine, one, below, _) = figures[0]
    assert (nine.get_title(), one.get_title()) == ("NFE 9", "NFE 1")
    assert lines_of(nine) == [("WP-Past", [0.2, 0.2]), ("WP-Past, correlation=0.5", [0.8, 0.8])]
    assert [heights for _, heights in lines_of(below)] == [[1.0, 1.0], [0.5, 0.5]] * 2
    assert list(nine.get_lines()[0].get_xdata()) == [0, 1] and texts(nine.get_xticklabels()) == ["1", "8"]
