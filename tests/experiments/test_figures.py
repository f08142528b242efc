"""Figures: that they are written, and which numbers end up in the curves of agents."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("tyro")

from tests.experiments.row_parts import compared, row
from warmprior.experiments import (
    Row,
    plot_filmstrip,
    plot_learning_curves,
    plot_reinforcement,
    plot_success,
    plot_success_bars,
    select,
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
    monkeypatch.setattr(module, "new_figure", spy)
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
