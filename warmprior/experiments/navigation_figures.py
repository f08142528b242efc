"""Figures of the navigation toy: executed paths and paths of the flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
from torch import Tensor

from warmprior.envs.navigation1d import (
    HALF_HEIGHT,
    HALF_WIDTH,
    OBSTACLES,
    navigation_heights,
    navigation_positions,
)
from warmprior.experiments.figures import new_figure

__all__ = ["plot_flow_paths", "plot_navigation"]

_ABOVE, _BELOW, _INK = "#1f77b4", "#d95f02", "#202020"


def plot_navigation(
    panels: Mapping[str, tuple[Tensor, Sequence[str]]],
    path: str | Path,
    *,
    chunk_length: int,
    title: str,
    shown: int = 24,
) -> None:
    """Executed paths between the obstacles, one panel per policy after one of the data (Fig. 5).

    Paths are coloured by the side of their first action; one of them is drawn in black, with a dot at
    the first action of each chunk.

    Args:
        panels: by title the heights ``[n, 64]`` and the lines of text below.
        path: of the PNG.

    Keyword Args:
        chunk_length: ``H``.
        title: of the figure.
        shown: how many rollouts to draw.

    See Also:
        :func:`~warmprior.experiments.play_navigation`: makes the paths.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from matplotlib.image import imread
        >>> panels = {"straight on": (navigation_heights() * 0, ["all collide"])}
        >>> with TemporaryDirectory() as folder:
        ...     plot_navigation(panels, f"{folder}/paths.png", chunk_length=4, title="the toy")
        ...     imread(f"{folder}/paths.png").shape[:2]  # one row of up to three panels
        (555, 1650)
    """
    rows = -(-(len(panels) + 1) // 3)
    figure, axes = new_figure(11.0, 0.7 + 3.0 * rows, rows, 3, share=True)
    x, demonstrations = navigation_positions().numpy(), navigation_heights().numpy()
    for axis in axes[len(panels) + 1 :]:
        axis.set_visible(False)
    for i, (axis, name) in enumerate(zip(axes, ["demonstrations", *panels], strict=False)):
        for c in OBSTACLES:
            axis.fill_between(
                [c - HALF_WIDTH, c + HALF_WIDTH], -HALF_HEIGHT, HALF_HEIGHT, color="0.8"
            )
        if i == 0:
            _draw(axis, x, demonstrations, width=1.4, alpha=1.0)
            lines: Sequence[str] = ("three above, three below",)
        else:
            axis.plot(x, demonstrations.T, color="0.6", lw=0.6, ls=":")
            heights, lines = panels[name]
            drawn = heights[:shown].numpy()
            _draw(axis, x, drawn, width=0.8, alpha=0.45)
            axis.plot(x, drawn[0], color=_INK, lw=1.3)
            starts = slice(None, None, chunk_length)
            axis.plot(x[starts], drawn[0, starts], "o", color=_INK, ms=2.8)
        letter = f"({ascii_lowercase[i]}) " if i < len(ascii_lowercase) else ""
        axis.set_title(f"{letter}{name}", fontsize=10)
        axis.text(
            0.5,
            0.02,
            "\n".join(lines),
            transform=axis.transAxes,
            ha="center",
            va="bottom",
            fontsize=8,
        )
        axis.set_xlim(-1, 1)
        axis.set_ylim(-1.5, 1.15)
        axis.set_yticks([-1, 0, 1])
        if i % 3 == 0:
            axis.set_ylabel("height (action)")
        if i >= len(panels) + 1 - 3:
            axis.set_xlabel("position (observation)")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)


def _draw(axis: Any, x: np.ndarray, heights: np.ndarray, *, width: float, alpha: float) -> None:
    for line in heights:
        axis.plot(x, line, color=_ABOVE if line[0] > 0 else _BELOW, lw=width, alpha=alpha)


def plot_flow_paths(paths: Mapping[str, Tensor], path: str | Path, *, title: str) -> None:
    """One action coordinate along the flow, from source to prediction, a panel per policy (Fig. 4).

    Args:
        paths: by title one coordinate of :func:`~warmprior.diagnostics.flow_paths`, ``[n, steps + 1]``.
        path: of the PNG.

    Keyword Args:
        title: of the figure.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> import torch
        >>> from matplotlib.image import imread
        >>> lines = torch.linspace(0, 1, 5) * torch.tensor([[-1.0], [1.0]])  # two straight paths
        >>> with TemporaryDirectory() as folder:
        ...     plot_flow_paths({"Base": lines, "WP-Past": lines}, f"{folder}/flow.png", title="the toy")
        ...     imread(f"{folder}/flow.png").shape[:2]  # 375 pixels per policy
        (510, 825)
    """
    figure, axes = new_figure(2.5 * len(paths) + 0.5, 3.4, 1, len(paths), share=True)
    for axis, (name, lines) in zip(axes, paths.items(), strict=True):
        values = lines.numpy()
        t = np.linspace(0.0, 1.0, values.shape[1])
        for line in values:
            axis.plot(t, line, color=_ABOVE if line[-1] > 0 else _BELOW, lw=0.7, alpha=0.5)
        ends = ((0.0, values[:, 0]), (1.0, values[:, -1]))
        for time, end in ends:
            axis.plot(np.full(len(end), time), end, "o", color=_INK, ms=1.8, alpha=0.6)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("flow time t")
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("first action of the chunk")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=150)
