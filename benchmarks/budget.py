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

from warmprior._files import check_writable, write_atomic
from warmprior.diagnostics import action_error, plot_budget, summarize_cell
from warmprior.diagnostics.results import PRIOR_LABELS, Row, write_results
from warmprior.training import Preset
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
    measurement.add_options(parser, observations=1000)
    return parser


def compare(args: argparse.Namespace, preset: Preset, options: dict[str, Any]) -> Comparison:
    """Train and evaluate all sources at one budget."""
    iterations = preset.training.iterations
    comparison = Comparison(
        experiment.find_policies(args, preset),
        robomimic.make_priors(args),
        nfes=sorted(set(args.nfe), reverse=True),
        directory=args.out / f"iterations-{iterations}",
        seeds=range(preset.seeds),
        resume=args.resume,
        options=options,
    )
    print(f"\nBudget: {iterations} iterations", flush=True)
    comparison.run()
    return comparison


def held_out_errors(args: argparse.Namespace, comparison: Comparison) -> Errors:
    """Of the last policies, on demonstrations that no policy was trained on."""
    policies, errors = comparison.policies, Errors()
    for prior in comparison.priors:
        observations, _ = measurement.observe(
            args,
            comparison.results.meta,
            policies.normalizer,
            chunk_length=prior.chunk_length,
            observation_steps=policies.preset.observation_steps,
        )
        windows = observations.windows(prior)
        for seed in comparison.seeds:
            found = action_error(policies.policy(prior, seed), windows, nfes=comparison.nfes)
            for nfe, error in found.items():
                key = (prior.name, policies.preset.training.iterations, nfe)
                errors.setdefault(key, []).append(error)
    return errors


def make_table(rows: Sequence[Row], errors: Errors, top_k: int) -> str:
    budgets = sorted({row.checkpoint for row in rows})
    columns = list(dict.fromkeys((row.nfe, row.prior) for row in rows))
    columns.sort(key=lambda column: -column[0])
    head = "".join(f" NFE {nfe}: {PRIOR_LABELS[prior]} |" for nfe, prior in columns)
    lines = [f"| iterations |{head}", "|" + "---|" * (1 + len(columns))]
    for iterations in budgets:
        cells = []
        for nfe, prior in columns:
            cell = [
                row
                for row in rows
                if (row.checkpoint, row.nfe, row.prior) == (iterations, nfe, prior)
            ]
            error = torch.tensor(errors[prior, iterations, nfe]).mean().item()
            cells.append(f" {100 * summarize_cell(cell, top_k).mean:.1f} ({error:.4f}) |")
        lines.append(f"| {iterations} |" + "".join(cells))
    note = (
        "Success in percent; in parentheses the mean squared error of the executed actions on held-out "
        "demonstrations, given the mean of the training, in squared normalised action units. The error "
        "prefers the average of what could be done, and grows with NFE where the data leave a choice."
    )
    return "\n".join([*lines, "", note]) + "\n"


def rows_of(errors: Mapping[tuple[str, int, int], list[float]]) -> list[dict[str, Any]]:
    return [
        {"prior": prior, "iterations": n, "nfe": nfe, "seed": seed, "action_error": error}
        for (prior, n, nfe), per_seed in errors.items()
        for seed, error in enumerate(per_seed)
    ]


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "budget-")
        budgets = sorted(set(args.budgets))
        if args.iterations is not None:
            raise ValueError("--iterations is one budget: name it with --budgets")
        preset = experiment.make_preset(args)
        presets = [replace(preset, training=preset.training.with_iterations(n)) for n in budgets]
        presets = [replace(p, training=replace(p.training, checkpoints=1)) for p in presets]
        robomimic.make_priors(args)
        experiment.check(args)
        measurement.check(args)
        check_writable(args.out)
        options = experiment.store_options(args)
        print(f"Output folder: {args.out}", flush=True)
        rows: list[Row] = []
        errors: Errors = {}
        for each in presets:
            comparison = compare(args, each, options)
            rows += comparison.results.rows
            errors |= held_out_errors(args, comparison)
            table = make_table(rows, errors, preset.top_k)
            meta = comparison.results.meta
            path = args.out / "results.json"
            write_results(path, meta, map(vars, rows), held_out=rows_of(errors))
            write_atomic(args.out / "table.md", lambda path, table=table: path.write_text(table))
            title = f"{meta['task']} {meta['style']} ({meta['data_source']} data)"
            plot_budget(rows, errors, args.out / "budget.png", top_k=preset.top_k, title=title)
    except experiment.ERRORS as error:
        print(f"budget.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and picture: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
