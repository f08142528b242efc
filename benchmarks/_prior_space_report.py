"""What prior_space_rl.py tells about its agents: rows, a table and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warmprior.diagnostics import (
    Row,
    markdown_table,
    plot_reinforcement,
    plot_success,
    summarize_seeds,
)
from warmprior.diagnostics.reinforcement_plots import agent_label
from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining


def summarize(seed: int, config: PriorSpaceConfig, training: PriorSpaceTraining) -> dict[str, Any]:
    """One row per agent: from where to where."""
    last = {row["evaluation"]: row for row in training.curve}
    return {
        "algorithm": config.algorithm,
        "prior": training.actor.prior.name,
        "backup_entropy": config.backup_entropy,
        "delta": training.decoder.delta,
        "nfe": config.nfe,
        "chunk": training.actor.prior.chunk_length,
        "seed": seed,
        "environment_steps": training.steps,
        "episodes": config.evaluation_episodes,
        "base_success": last["base"]["success_rate"],
        "final_success": last["greedy"]["success_rate"],
        "final_success_stochastic": last["stochastic"]["success_rate"],
    }


def make_table(rows: list[dict[str, Any]]) -> str:
    """Success before and after, mean and standard deviation over seeds."""
    head = ["agent", "delta", "control steps"]
    head += ["frozen policy (%)", "greedy agent (%)", "stochastic agent (%)"]
    lines = []
    for algorithm, prior in dict.fromkeys((row["algorithm"], row["prior"]) for row in rows):
        group = [row for row in rows if (row["algorithm"], row["prior"]) == (algorithm, prior)]
        cells = []
        for key in ("base_success", "final_success", "final_success_stochastic"):
            summary = summarize_seeds([row[key] for row in group])
            spread = f" ± {100 * summary.std:.1f}" if summary.seeds > 1 else ""
            cells.append(f"{100 * summary.mean:.1f}{spread}")
        label = agent_label(algorithm, prior, len(group))
        steps = max(row["environment_steps"] for row in group)
        lines.append([label, f"{group[0]['delta']:g}", str(steps), *cells])
    return markdown_table(head, lines)


def draw(rows: list[dict[str, Any]], out: Path, curve: Any, title: str, warmup: int) -> None:
    """The curves, and the posteriors of the greedy agents of each algorithm."""
    plot_reinforcement(curve, out / "curves.png", title=title, warmup_steps=warmup)
    for algorithm in dict.fromkeys(row["algorithm"] for row in rows):
        cells = [
            Row(
                task="",
                data="",
                prior=row["prior"],
                sigma=0.0,
                chunk=row["chunk"],
                nfe=row["nfe"],
                seed=row["seed"],
                checkpoint=0,
                episodes=row["episodes"],
                successes=round(row["final_success"] * row["episodes"]),
                mean_steps=0.0,
            )
            for row in rows
            if row["algorithm"] == algorithm
        ]
        plot_success(
            cells,
            out / f"success_{algorithm}.png",
            priors=list(dict.fromkeys(cell.prior for cell in cells)),
            nfes=[cells[0].nfe],
            title=f"{title}: greedy {algorithm.upper()} agents",
        )
