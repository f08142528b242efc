"""The paper's sigma ablation: success, curvature and the branching bound against the residual noise.

python benchmarks/sigma.py                                # square ph, one seed, under an hour on two cores
python benchmarks/sigma.py --data mh --preset cpu         # the paper's task, three seeds
python benchmarks/sigma.py --resume                       # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import _experiment as experiment
import _measurement as measurement

from warmprior import Prior
from warmprior.diagnostics import (
    Row,
    SharedObservations,
    markdown_table,
    plot_sigma,
    straightness,
    summarize_cell,
)
from warmprior.io.files import write_atomic
from warmprior.training.comparison import Comparison

SIGMAS = (1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = experiment.add_options(parser)
    add("--sigmas", nargs="+", type=float, default=list(SIGMAS), help="default: the paper's seven")
    experiment.add_prior(parser, experiment.COMPARED[1:], "warm priors, beside the Gaussian source")
    add("--nfe", type=int, default=1, help="evaluations per chunk (%(default)s, the paper's)")
    add("--chunk", type=int, default=8, help="chunk length H (%(default)s)")
    measurement.add_options(parser, observations=500)
    return parser


def make_priors(args: argparse.Namespace) -> list[Prior]:
    names = list(dict.fromkeys(args.prior))
    fixed = [name for name in names if not Prior.find(name).takes("sigma")]
    if fixed:
        raise ValueError(f"--prior {' '.join(fixed)}: sigma has no effect there; name warm priors")
    cold = args.cold_probability
    return [
        Prior.make(experiment.COMPARED[0], args.chunk),
        *(
            Prior.make(name, args.chunk, sigma=sigma, cold_probability=cold)
            for name in names
            for sigma in sorted(set(args.sigmas), reverse=True)
        ),
    ]


def observe(args: argparse.Namespace, comparison: Comparison) -> tuple[SharedObservations, str]:
    """The held-out observations of all policies, and what they are in words."""
    policies = comparison.policies
    return measurement.observe(
        args,
        comparison.results.meta,
        policies.normalizer,
        chunk_length=args.chunk,
        observation_steps=policies.preset.observation_steps,
    )


def measure(
    args: argparse.Namespace, comparison: Comparison, observations: SharedObservations
) -> list[dict[str, Any]]:
    """Curvature and bound of all policies on the same observations."""
    policies = comparison.policies
    actors = {
        prior.describe(): [policies.policy(prior, seed) for seed in comparison.seeds]
        for prior in comparison.priors
    }
    return straightness(
        actors, observations, n_steps=args.steps, draws=args.draws, description="curvature"
    )


def make_table(
    rows: Sequence[Row], curvatures: Sequence[dict[str, Any]], priors: Sequence[Prior], top_k: int
) -> str:
    seeds = {row["seed"] for row in curvatures}
    pooled = None if None in seeds else 0
    head = ["source", "sigma", "success (%)", "curvature, training mean", "deployed mean"]
    head += ["per squared mean velocity", "bound, training mean", "deployed mean"]
    lines = []
    for prior in priors:
        cell = [row for row in rows if (row.prior, row.sigma) == (prior.name, prior.sigma)]
        summary = summarize_cell(cell, top_k)
        spread = f" ± {100 * summary.std:.1f}" if summary.seeds > 1 else ""
        mine = {
            row["mean"]: row
            for row in curvatures
            if (row["policy"], row["seed"]) == (prior.describe(), pooled)
        }
        trained, deployed = mine["training"], mine.get("deployed", mine["training"])
        values = [
            f"{100 * summary.mean:.1f}{spread}",
            f"{trained['ratio_executed']:.3f}",
            f"{deployed['ratio_executed']:.3f}",
            f"{trained['ratio_relative']:.3f}",
            f"{trained['bound']:.2f}",
            f"{deployed['bound']:.2f}",
        ]
        lines.append([prior.label, f"{prior.sigma:g}", *values])
    note = (
        "- Curvature (relative to the Gaussian source) and bound (in squared normalised action units) are "
        "those of the executed positions. nan: the policy predicts no motion."
    )
    return markdown_table(head, lines, [note])


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "sigma-")
        preset, priors = experiment.make_preset(args), make_priors(args)
        measurement.check(args)
        comparison = experiment.start_comparison(args, preset, priors, [args.nfe])
        # Before the hours of training: what cannot be measured on is better known now.
        observations, source = observe(args, comparison)
        comparison.results.meta["curvature_observations"] = source
        results = comparison.run()
        curvatures = measure(args, comparison, observations)
        results.extra["curvature"] = curvatures
        results.save()
        table = make_table(results.rows, curvatures, priors, preset.top_k)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        task, data = results.meta["task"], results.meta["style"]
        plot_sigma(
            results.rows,
            curvatures,
            args.out / "sigma.png",
            top_k=preset.top_k,
            title=f"{task} {data} ({results.meta['data_source']} data), H = {args.chunk}, NFE {args.nfe}, "
            f"{preset.seeds} seed(s)",
            paper=(task, data, args.chunk, args.nfe) == ("square", "mh", 8, 1),
        )
    except experiment.ERRORS as error:
        print(f"sigma.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and picture: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
