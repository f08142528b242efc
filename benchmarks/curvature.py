"""The paper's Table 2 and Fig. 4: how straight the learned flows are, on held-out observations.

python benchmarks/curvature.py                              # trains what is missing, like robomimic.py
python benchmarks/curvature.py --run runs/square-ph-quick   # the policies of a finished run
python benchmarks/curvature.py --run runs/paper --validation square_held_out.hdf5
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import _experiment as experiment
import _measurement as measurement
import robomimic
import torch

from warmprior import Prior, WarmPriorActor
from warmprior.diagnostics import (
    SharedObservations,
    curvature_table,
    flow_paths,
    plot_flow_paths,
    prior_label,
    straightness,
    write_results,
)
from warmprior.io.files import check_writable, write_atomic

SHOWN = 40

Measured = tuple[dict[str, Any], dict[str, list[WarmPriorActor]], SharedObservations, str]
"""Facts, policies by prior, the observations to measure on, and what these are in words."""


def make_parser() -> argparse.ArgumentParser:
    parser = robomimic.make_parser()
    parser.description = __doc__
    add = parser.add_argument
    add(
        "--run",
        type=Path,
        help="folder of a finished run of robomimic.py; only the options below and --out, --device "
        "go with it, and --prior package.module:Class where it compares priors of your own",
    )
    measurement.add_options(parser, observations=2_000)
    add("--coordinate", type=int, default=0, help="of the action, in flow_paths.png (%(default)s)")
    return parser


def parse(argv: list[str] | None) -> argparse.Namespace:
    args = make_parser().parse_args(argv)
    if args.run is None:
        return experiment.parse(make_parser, argv, "curvature-")
    allowed = {"run", "out", "device", "coordinate", "validation", "observations", "steps", "draws"}
    defaults = vars(make_parser().parse_args([]))
    if all(":" in name for name in args.prior):  # not what to compare, but what to import for it
        for place in args.prior:
            Prior.find(place)
        allowed.add("prior")
    ignored = [k for k, v in vars(args).items() if k not in allowed and v != defaults[k]]
    if ignored:
        told = ", ".join(f"--{key.replace('_', '-')}" for key in ignored)
        raise ValueError(f"--run measures policies as they were trained: leave out {told}")
    run = args.run = args.run.resolve()
    default = experiment.numbered_folder(run.parent, f"curvature-{run.name}")
    args.out = experiment.output_folder(args) if args.out is not None else default
    return args


def flows_of(priors: Sequence[Prior]) -> list[Prior]:
    """The priors that have a flow to measure; says which have none."""
    for prior in priors:
        if not prior.is_flow:
            print(f"{prior.name} has no flow and is left out.")
    flows = [prior for prior in priors if prior.is_flow]
    if not flows:
        raise ValueError("none of these policies has a flow: compare gaussian, past or preview")
    return flows


def finished_run(args: argparse.Namespace) -> Measured:
    """The last policies of a run of robomimic.py."""
    meta, actors = experiment.finished_run(args.run, args.device)
    flows = flows_of([group[0].prior for group in actors.values()])
    actors = {prior.name: actors[prior.name] for prior in flows}
    first = next(iter(actors.values()))[0]
    observations, source = measurement.observe(
        args,
        meta,
        first.normalizer,
        chunk_length=first.prior.chunk_length,
        observation_steps=first.network.observation_steps,
    )
    return meta, actors, observations, source


def own_run(args: argparse.Namespace) -> Measured:
    """The policies of these options: those of earlier runs where they exist, or trained now."""
    preset, priors = experiment.make_preset(args), flows_of(robomimic.make_priors(args))
    options = experiment.store_options(args)
    policies = experiment.find_policies(args, preset)
    meta = policies.facts() | {"options": options}
    # Before the training: what cannot be measured on is better known now.
    observations, source = measurement.observe(
        args,
        meta,
        policies.normalizer,
        chunk_length=args.chunk,
        observation_steps=preset.observation_steps,
    )
    actors = {p.name: [policies.policy(p, seed) for seed in range(preset.seeds)] for p in priors}
    return meta, actors, observations, source


def draw(
    args: argparse.Namespace,
    actors: dict[str, list[WarmPriorActor]],
    observations: SharedObservations,
    title: str,
) -> None:
    few = observations.subset(torch.linspace(0, len(observations) - 1, SHOWN).long())
    paths = {}
    for name, (actor, *_) in actors.items():
        generator = torch.Generator(args.device).manual_seed(0)
        path = flow_paths(actor, few.windows(actor.prior), args.steps, generator=generator)
        paths[prior_label(name)] = path[..., 0, args.coordinate].cpu()
    plot_flow_paths(paths, args.out / "flow_paths.png", title=title)


def main(argv: list[str] | None = None) -> int:
    try:
        args = parse(argv)
        experiment.check(args)
        measurement.check(args)
        check_writable(args.out)
        print(f"Output folder: {args.out}", flush=True)
        meta, actors, observations, source = (
            own_run(args) if args.run is None else finished_run(args)
        )
        width = observations.data["action"].shape[-1]
        if not 0 <= args.coordinate < width:
            raise ValueError(f"--coordinate must be in [0, {width}), got {args.coordinate}")
        rows = straightness(
            actors, observations, n_steps=args.steps, draws=args.draws, description="curvature"
        )
        task, data = meta["task"], meta["style"]
        meta["curvature"] = {"observations": source, "steps": args.steps, "draws": args.draws}
        write_results(args.out / "results.json", meta, rows)
        table = curvature_table(rows, task=task, data=data, source=source)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        title = f"{task} {data}: action coordinate {args.coordinate} along the flow, {source}"
        draw(args, actors, observations, title)
    except experiment.ERRORS as error:
        print(f"curvature.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and picture: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
