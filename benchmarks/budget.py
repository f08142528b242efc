"""How much training the sources need: success and held-out error against iterations.

python benchmarks/budget.py                                          # square ph, four budgets, one seed
python benchmarks/budget.py --task can --budgets 2500 10000 --nfe 1
python benchmarks/budget.py --resume                                 # after an interruption

Every budget is a training of its own, with its own learning-rate schedule. The policies of robomimic.py
with the same options are used, not trained again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import _experiment as experiment
import _measurement as measurement
import robomimic
import torch

from warmprior.diagnostics import (
    SharedObservations,
    action_error,
    markdown_table,
    plot_budget,
    prior_label,
    summarize_cell,
)
from warmprior.diagnostics.results import Row, write_results
from warmprior.io.files import check_writable, write_atomic
from warmprior.training.comparison import Comparison

Errors = dict[tuple[str, int, int], list[float]]
"""By prior, iterations and NFE, one error per seed."""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = robomimic.add_options(parser)
    add(
        "--budgets",
        nargs="+",
        type=int,
        default=[2_500, 5_000, 10_000, 20_000],
        help="iterations to train for, instead of --iterations (%(default)s)",
    )
    measurement.add_observation_options(parser, observations=1000)
    return parser


def make_comparisons(
    args: argparse.Namespace, nfes: list[int], options: dict[str, Any]
) -> list[Comparison]:
    """One comparison of all sources per budget, the smallest first."""
    preset, comparisons = experiment.make_preset(args), []
    for iterations in sorted(set(args.budgets)):
        training = replace(preset.training.with_iterations(iterations), checkpoints=1)
        comparisons.append(
            Comparison(
                experiment.find_policies(args, replace(preset, training=training)),
                robomimic.make_priors(args),
                nfes=nfes,
                directory=args.out / f"iterations-{iterations}",
                seeds=range(preset.seeds),
                resume=args.resume,
                options=options,
            )
        )
    return comparisons


def observe(args: argparse.Namespace, comparison: Comparison) -> SharedObservations:
    """The held-out observations, the same for all policies."""
    policies = comparison.policies
    observations, _ = measurement.observe(
        args,
        comparison.results.meta,
        policies.normalizer,
        chunk_length=args.chunk,
        observation_steps=policies.preset.observation_steps,
    )
    return observations


def held_out_errors(comparison: Comparison, observations: SharedObservations) -> Errors:
    """Of the last policies, on demonstrations that no policy was trained on."""
    iterations, errors = comparison.policies.preset.training.iterations, Errors()
    for prior in comparison.priors:
        windows = observations.windows(prior)
        for seed in comparison.seeds:
            policy = comparison.policies.policy(prior, seed)
            for nfe, error in action_error(policy, windows, nfes=comparison.nfes).items():
                errors.setdefault((prior.name, iterations, nfe), []).append(error)
    return errors


def make_table(rows: Sequence[Row], errors: Errors, top_k: int) -> str:
    budgets = sorted({row.checkpoint for row in rows})
    columns = list(dict.fromkeys((row.nfe, row.prior) for row in rows))
    columns.sort(key=lambda column: -column[0])
    lines = []
    for iterations in budgets:
        cells = []
        for nfe, prior in columns:
            cell = [
                row
                for row in rows
                if (row.checkpoint, row.nfe, row.prior) == (iterations, nfe, prior)
            ]
            error = torch.tensor(errors[prior, iterations, nfe]).mean().item()
            cells.append(f"{100 * summarize_cell(cell, top_k).mean:.1f} ({error:.4f})")
        lines.append([str(iterations), *cells])
    note = (
        "Success in percent; in parentheses the mean squared error of the executed actions on held-out "
        "demonstrations, given the mean of the training, in squared normalised action units. The error "
        "prefers the average of what could be done, and grows with NFE where the data leave a choice."
    )
    head = ["iterations", *(f"NFE {nfe}: {prior_label(prior)}" for nfe, prior in columns)]
    return markdown_table(head, lines, [note])


def rows_of(errors: Mapping[tuple[str, int, int], list[float]]) -> list[dict[str, Any]]:
    return [
        {"prior": prior, "iterations": n, "nfe": nfe, "seed": seed, "action_error": error}
        for (prior, n, nfe), per_seed in errors.items()
        for seed, error in enumerate(per_seed)
    ]


def report(args: argparse.Namespace, comparisons: Sequence[Comparison], errors: Errors) -> str:
    """Write what is known so far: results, table and picture."""
    rows = [row for comparison in comparisons for row in comparison.results.rows]
    meta, top_k = comparisons[0].results.meta, comparisons[0].policies.preset.top_k
    budgets = [
        {"iterations": c.policies.preset.training.iterations, "folder": c.directory.name}
        for c in comparisons
    ]
    records = (row.record() for row in rows)
    facts = {key: meta[key] for key in ("versions", "task", "style", "data", "options", "priors")}
    path = args.out / "results.json"
    write_results(path, facts | {"budgets": budgets}, records, held_out=rows_of(errors))
    if not rows:
        return ""
    table = make_table(rows, errors, top_k)
    write_atomic(args.out / "table.md", lambda path: path.write_text(table))
    title = f"{meta['task']} {meta['style']} ({meta['data_source']} data)"
    plot_budget(rows, errors, args.out / "budget.png", top_k=top_k, title=title)
    return table


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "budget-")
        if args.iterations is not None:
            raise ValueError("--iterations is one budget: name it with --budgets")
        if min(args.budgets) < 1:
            raise ValueError(f"--budgets must be at least 1, got {min(args.budgets)}")
        robomimic.make_priors(args)
        nfes = experiment.check_nfes(args.nfe)
        experiment.check(args)
        measurement.check(args)
        check_writable(args.out)
        options = experiment.store_options(args)
        print(f"Output folder: {args.out}", flush=True)
        comparisons = make_comparisons(args, nfes, options)
        # Before the hours of training: what cannot be measured on is better known now.
        observations = observe(args, comparisons[0])
        errors: Errors = {}
        finished: list[Comparison] = []
        if not (args.out / "results.json").exists():  # from now on the folder holds a run
            report(args, comparisons, errors)
        for comparison in comparisons:
            print(
                f"\nBudget: {comparison.policies.preset.training.iterations} iterations", flush=True
            )
            comparison.run()
            finished.append(comparison)
            errors |= held_out_errors(comparison, observations)
            table = report(args, finished, errors)
    except experiment.ERRORS as error:
        print(f"budget.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and picture: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
