"""Draw the picture of the landing page: three sources, their flows, and executed paths.

PYTHONPATH=benchmarks python docs/figures/what_changes.py

It trains the toy's policies, which takes two minutes, and writes docs/_static/what_changes.png.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from navigation1d import NAVIGATION_PRESETS
from shared import DOCS, GAUSSIAN, INK, PAST, PREVIEW, SOURCES

from lab.demonstrations.loading import navigation_task
from lab.measures.navigation import play_navigation
from lab.reporting.plots import ABOVE, BELOW, new_figure
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import SharedObservations, executed_actions, flow_paths
from warmprior.envs.navigation1d import HALF_HEIGHT, HALF_WIDTH, OBSTACLES, navigation_positions
from warmprior.training import train_policy

OUT = DOCS / "_static" / "what_changes.png"
PRIORS = {GAUSSIAN: GaussianPrior(16), PAST: PastPrior(16), PREVIEW: PreviewPrior(16)}
AHEAD = 4
"""Position of the chunk that is shown."""


def main() -> None:
    """Train the policies, and draw."""
    options, task = NAVIGATION_PRESETS["quick"], navigation_task()
    data = SharedObservations(task.data, 16)
    figure, axes = new_figure(8.4, 4.6, 2, 3)
    flows, paths = axes[:3], axes[3:]
    with tempfile.TemporaryDirectory() as folder:
        for column, (name, prior) in enumerate(PRIORS.items()):
            place = Path(folder) / prior.name
            # The Gaussian source reads no history, so none is withheld.
            withheld = options.training.cold_probability if column else 0.0
            training = replace(options.training, cold_probability=withheld)
            actor = train_policy(task, prior, place, network=options.network, training=training)
            window = data.windows(actor.prior)
            # A window of a demonstration, above the first obstacle.
            index = int((window["observation"][:60, 0, 0] + 0.45).abs().argmin())
            batch = window[index : index + 1].expand(160).contiguous()
            generator = torch.Generator().manual_seed(0)
            lines = flow_paths(actor, batch, 50, generator=generator)[..., AHEAD, 0]
            axis, t = flows[column], torch.linspace(0, 1, lines.shape[-1])
            for line in lines[:48]:
                axis.plot(t, line, color=ABOVE if line[-1] > 0 else BELOW, lw=0.6, alpha=0.6)
            axis.hist(
                lines[:, 0].numpy(),
                30,
                orientation="horizontal",
                color=INK,
                bottom=-0.02,
                weights=torch.full((len(lines),), -0.006).tolist(),
            )
            label, color, _ = SOURCES[name]
            axis.set(xlim=(-0.22, 1.02), ylim=(-2.6, 2.6))
            axis.set_title(label, fontweight="bold", loc="left", color=color)
            axis.set_xticks([0, 1], ["source", "action"])
            rollout = play_navigation(actor, 0, nfe=9, rollouts=64)
            heights = executed_actions(rollout)[0].squeeze(-1)
            axis, x = paths[column], navigation_positions()
            for c in OBSTACLES:
                axis.fill_between(
                    [c - HALF_WIDTH, c + HALF_WIDTH], -HALF_HEIGHT, HALF_HEIGHT, color=INK, alpha=0.35
                )
            for line in heights[:24]:
                axis.plot(x, line, color=ABOVE if line[0] > 0 else BELOW, lw=0.6, alpha=0.6)
            axis.plot(x, heights[0], color=color, lw=2.2, marker="o", ms=4, markevery=16)
            axis.set(xlabel="position along the way", ylim=(-1.5, 1.5))
    flows[0].set_ylabel("one action of the chunk")
    paths[0].set_ylabel("height of the robot")
    figure.savefig(OUT, dpi=150)
    print(f"written to {OUT}")


if __name__ == "__main__":
    main()
