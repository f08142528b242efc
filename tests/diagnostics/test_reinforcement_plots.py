"""Curves of agents in source space: which numbers end up in the figure."""

from __future__ import annotations

import numpy as np
import pytest

from warmprior.diagnostics import plot_reinforcement, reinforcement_plots

pytest.importorskip("matplotlib")


def rows(seed, points, algorithm="dsrl-na", prior="past"):
    key = {"algorithm": algorithm, "prior": prior, "seed": seed}
    for steps, values in points:
        for evaluation, value in values.items():
            row = {"environment_steps": steps, "evaluation": evaluation, "success_rate": value}
            yield key | row


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

    make = reinforcement_plots.new_figure
    monkeypatch.setattr(reinforcement_plots, "new_figure", spy)
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
    assert path.read_bytes().startswith(b"\x89PNG")
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
