"""The paper's Table 2 and Fig. 4: how straight the learned flows are, on held-out observations.

python benchmarks/curvature.py                              # trains what is missing, like robomimic.py
python benchmarks/curvature.py --run runs/square-ph-quick   # the policies of a finished run
python benchmarks/curvature.py --run runs/paper --validation square_held_out.hdf5
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import _experiment as experiment
import robomimic
import torch

from warmprior import Prior, WarmPriorActor
from warmprior._files import check_writable, write_atomic
from warmprior.diagnostics import (
    PRIOR_LABELS,
    SharedObservations,
    curvature_table,
    flow_paths,
    plot_flow_paths,
    straightness,
    write_results,
)

SHOWN = 40


def make_parser() -> argparse.ArgumentParser:
    parser = robomimic.make_parser()
    parser.description = __doc__
    add = parser.add_argument
    add(
        "--run", type=Path, help="folder of a finished run of robomimic.py; no other options needed"
    )
    add(
        "--validation",
        type=Path,
        help="robomimic HDF5 file of held-out demonstrations (default: newly generated ones)",
    )
    add(
        "--observations",
        type=int,
        default=2_000,
        help="how many (default: the paper's %(default)s)",
    )
    add("--steps", type=int, default=100, help="Euler steps (default: the paper's %(default)s)")
    add("--draws", type=int, default=1, help="source samples per observation (%(default)s)")
    add("--coordinate", type=int, default=0, help="of the action, in flow_paths.png (%(default)s)")
    return parser


def finished_run(
    args: argparse.Namespace,
) -> tuple[dict[str, Any], dict[str, list[WarmPriorActor]]]:
    """The facts of a run of robomimic.py and its last policies, by prior."""
    path = args.run / "results.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"--run {args.run}: it has no results.json; name a run of robomimic.py"
        )
    meta = json.loads(path.read_text())["meta"]
    if not {"policies", "task"} <= meta.keys():
        raise ValueError(f"{path} does not say where its policies lie: run robomimic.py again")
    last = meta["training"]["iterations"]
    actors: dict[str, list[WarmPriorActor]] = {}
    for entry in meta["policies"]:
        folder = args.run.parent / "policies" / entry["folder"] / f"policy_{last:06d}"
        prior = Prior.from_config(entry["prior"])
        actor = WarmPriorActor.from_pretrained(folder, prior=prior, device=args.device)
        actors.setdefault(prior.name, []).append(actor)
    return meta, actors


def own_run(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, list[WarmPriorActor]]]:
    """The policies of these options: those of earlier runs where they exist, or trained now."""
    preset, priors = experiment.make_preset(args), robomimic.make_priors(args)
    options = experiment.store_options(args)
    policies = experiment.find_policies(args, preset)
    actors = {p.name: [policies.policy(p, seed) for seed in range(preset.seeds)] for p in priors}
    demonstrations = policies.demonstrations
    return {
        "task": policies.task,
        "style": demonstrations.style,
        "data_source": demonstrations.source,
        "data": {"file": demonstrations.path.name, "sha256": demonstrations.sha256},
        "options": options,
    }, actors


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
        paths[PRIOR_LABELS[name]] = path[..., 0, args.coordinate].cpu()
    plot_flow_paths(paths, args.out / "flow_paths.png", title=title)


def main(argv: list[str] | None = None) -> int:
    try:
        args = make_parser().parse_args(argv)
        if args.run is not None and args.out is None:
            args.out = args.run.parent / f"curvature-{args.run.name}"
        elif args.run is None:
            args = experiment.parse(make_parser, argv, "curvature-")
        experiment.check(args)
        check_writable(args.out)
        print(f"Output folder: {args.out}", flush=True)
        meta, actors = own_run(args) if args.run is None else finished_run(args)
        flows = {name: group for name, group in actors.items() if group[0].prior.max_nfe is None}
        for name in actors.keys() - flows.keys():
            print(f"{name} has no flow and is left out.")
        demonstrations, source = experiment.held_out(args, meta)
        first = next(iter(flows.values()))[0]
        width = first.network.action_dim
        if not 0 <= args.coordinate < width:
            raise ValueError(f"--coordinate must be in [0, {width}), got {args.coordinate}")
        observations = experiment.observe(args, demonstrations.path, first)
        rows = straightness(
            flows, observations, n_steps=args.steps, draws=args.draws, description="curvature"
        )
        task, data = meta["task"], meta["style"]
        meta["curvature"] = {"observations": source, "steps": args.steps, "draws": args.draws}
        write_results(args.out / "results.json", meta, rows)
        table = curvature_table(rows, task=task, data=data, source=source)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        title = f"{task} {data}: action coordinate {args.coordinate} along the flow, held-out observations"
        draw(args, flows, observations, title)
    except experiment.ERRORS as error:
        print(f"curvature.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and picture: {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
