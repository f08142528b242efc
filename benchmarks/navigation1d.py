"""The paper's Fig. 5: mode switching in a one-dimensional navigation toy.

python benchmarks/navigation1d.py                      # all policies, one seed, a few minutes
python benchmarks/navigation1d.py --seeds 5
python benchmarks/navigation1d.py --chunk 1            # a decision at every step
python benchmarks/navigation1d.py --preset wide        # the paper's network and iterations
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import _experiment as experiment
import torch

from warmprior import Prior
from warmprior.diagnostics import (
    executed_actions,
    flow_paths,
    markdown_table,
    plot_flow_paths,
    plot_navigation,
    summarize_seeds,
    write_results,
)
from warmprior.io.files import check_writable, write_atomic
from warmprior.training import (
    NAVIGATION_PRESETS,
    NavigationPreset,
    NavigationStudy,
    navigation_priors,
)
from warmprior.training.navigation1d import NAVIGATION_PRIORS

COLUMNS = {
    "switches at boundaries": "switch_rate",
    "rollouts on one side": "commit_rate",
    "collisions": "collision_rate",
    "route entropy (bit)": "route_entropy",
    "distance to data": "distance",
    "jump ratio": "jump_ratio",
    "kappa (H)": "kappa_executed",
    "kappa (H) / speed": "relative_executed",
    "collisions, history shifted": "shifted_collision_rate",
    "distance, history shifted": "shifted_distance",
    "distance, NFE 1": "one_step_distance",
}


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    presets = "; ".join(f"{name}: {p.summary}" for name, p in NAVIGATION_PRESETS.items())
    add("--preset", default="quick", choices=NAVIGATION_PRESETS, help=presets)
    add("--seeds", type=int, default=1, help="number of training seeds (default: 1)")
    experiment.add_prior(parser, NAVIGATION_PRIORS, "what to compare, the baseline first")
    add("--sigmas", nargs="+", type=float, default=[0.1, 0.5], help="of warm priors (%(default)s)")
    add("--chunk", type=int, default=4, help="chunk length H (default: 4)")
    add("--nfe", type=int, default=9, help="network evaluations per chunk (default: 9)")
    add("--rollouts", type=int, default=256, help="rollouts per policy (default: 256)")
    add("--iterations", type=int, help="gradient steps (default: the preset's)")
    add(
        "--cold-probability",
        type=float,
        default=0.1,
        help="share of training samples of the warm rows whose mean is withheld (default: 0.1; the "
        "paper's Algorithm 1: 0)",
    )
    add("--out", type=Path, help="output folder (default: runs/navigation1d-PRESET-hCHUNK)")
    add("--resume", action="store_true", help="reuse the trained policies of the output folder")
    return parser.parse_args(argv)


def make_study(args: argparse.Namespace) -> NavigationStudy:
    preset: NavigationPreset = NAVIGATION_PRESETS[args.preset]
    if args.iterations is not None:
        preset = replace(preset, training=replace(preset.training, iterations=args.iterations))
    if args.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, got {args.seeds}")
    if not 1 <= args.chunk <= 32:
        raise ValueError(f"--chunk must be between 1 and 32, got {args.chunk}")
    out = args.out or Path("runs") / f"navigation1d-{args.preset}-h{args.chunk}"
    if (out / "results.json").exists() and not args.resume:
        raise ValueError(f"{out} holds results: add --resume, or choose another --out")
    priors = navigation_priors(
        args.chunk, args.cold_probability, names=args.prior, sigmas=args.sigmas
    )
    study = NavigationStudy(preset, priors, out, nfe=args.nfe, rollouts=args.rollouts)
    check_writable(out)
    return study


def run_seed(study: NavigationStudy, seed: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    actors = {name: study.train(name, seed) for name in study.priors}
    straightness = study.straightness(actors, seed)
    rows = []
    for name, actor in actors.items():
        prior = actor.prior
        row = {"policy": name, "prior": prior.name, "sigma": prior.sigma, "seed": seed}
        row |= {"chunk": prior.chunk_length, "nfe": actor.ode.nfe} | study.judge(actor, seed)
        rows.append(row | straightness.get(name, {"kappa": math.nan}))
    return rows, actors


def table(rows: list[dict[str, Any]], names: Sequence[str]) -> str:
    lines = []
    for name in names:
        cells = []
        for column in COLUMNS.values():
            values = [row.get(column, math.nan) for row in rows if row["policy"] == name]
            known = [value for value in values if math.isfinite(value)]
            if not known:
                cells.append("-")
                continue
            summary = summarize_seeds(known)
            spread = "" if summary.seeds == 1 else f" ± {summary.std:.3f}"
            lost = len(values) - len(known)
            cells.append(f"{summary.mean:.3f}{spread}" + (f" ({lost} not finite)" if lost else ""))
        lines.append([name, *cells])
    return markdown_table(["policy", *COLUMNS], lines)


def panel_title(prior: Prior) -> str:
    return f"{prior.label}, sigma = {prior.sigma:g}" if prior.takes("sigma") else prior.label


def draw(study: NavigationStudy, actors: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    seed = rows[0]["seed"]
    by_name = {row["policy"]: row for row in rows if row["seed"] == seed}
    panels = {}
    for name, actor in actors.items():
        row, prior = by_name[name], actor.prior
        switches = row["switch_rate"]
        text = [f"collides {row['collision_rate']:.0%}"]
        if math.isfinite(switches):
            text[0] = f"switches sides at {switches:.1%} of boundaries, {text[0]}"
        if prior.ever_warm:
            text.append(f"with its history shifted: collides {row['shifted_collision_rate']:.0%}")
        heights = executed_actions(study.play(actor, seed))[0].squeeze(-1)
        panels[panel_title(prior)] = (heights, text)
    chunk = rows[0]["chunk"]
    recipe = f"H = {chunk}, {study.preset.hidden_dim}-d network, "
    recipe += f"{study.preset.training.iterations} iterations, seed {seed}"
    plot_navigation(
        panels,
        study.directory / "navigation1d.png",
        chunk_length=chunk,
        title=f"One-dimensional navigation: {recipe}",
    )
    # One window of a demonstration, above the first obstacle, from many source samples.
    paths = {}
    for name in (name for name, actor in actors.items() if actor.prior.is_flow):
        window = study.observations.windows(actors[name].prior)
        index = int((window["observation"][:60, 0, 0] + 0.45).abs().argmin())
        batch = window[index : index + 1].expand(48).contiguous()
        generator = torch.Generator().manual_seed(seed)
        paths[name] = flow_paths(actors[name], batch, 100, generator=generator)[..., 0, 0]
    plot_flow_paths(
        paths,
        study.directory / "flow_paths.png",
        title=f"Paths of the flow above the first obstacle, after a demonstrated history: {recipe}",
    )


def main(argv: list[str] | None = None) -> int:
    args = parse(argv)
    try:
        study = make_study(args)
    except experiment.ERRORS as error:
        print(f"navigation1d.py: error: {error}", file=sys.stderr)
        return 2
    if study.preset.hidden_dim < 512:
        torch.set_num_threads(1)  # more of them only wait for each other
    started, rows = time.monotonic(), []
    packages = ("warmprior", "torch", "torchrl", "tensordict")
    meta: dict[str, Any] = {
        "versions": {n: version(n) for n in packages} | {"python": platform.python_version()},
        "hardware": {"cores": os.cpu_count(), "torch_threads": torch.get_num_threads()},
        "options": {key: str(value) for key, value in vars(args).items() if value is not None},
        "training": asdict(study.preset.training),
        "hidden_dim": study.preset.hidden_dim,
        "priors": {name: prior.config() for name, prior in study.priors.items()},
    }
    try:
        for seed in range(args.seeds):
            new, actors = run_seed(study, seed)
            rows += new
            meta["wall_time_s"] = time.monotonic() - started
            write_results(study.directory / "results.json", meta, rows)
            if seed == 0:
                draw(study, actors, rows)
        text = table(rows, list(study.priors))
        write_atomic(study.directory / "table.md", lambda path: path.write_text(text))
    except experiment.ERRORS as error:
        print(f"navigation1d.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{text}\nResults, table and pictures: {study.directory}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
