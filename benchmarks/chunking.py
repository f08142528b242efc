"""The paper's H = 1 study, and all chunk lengths: success and jumps at chunk boundaries.

python benchmarks/chunking.py                             # square ph, one seed, over an hour on two cores
python benchmarks/chunking.py --chunks 1 8 --nfe 1        # the paper's figure alone
python benchmarks/chunking.py --resume                    # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import _experiment as experiment

from warmprior import Prior
from warmprior.diagnostics import (
    Row,
    markdown_table,
    plot_chunk_lengths,
    plot_success,
    plot_success_bars,
    prior_label,
    summarize_cell,
)
from warmprior.io.files import write_atomic


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = experiment.add_options(parser)
    experiment.add_prior(parser, experiment.COMPARED, "what to compare")
    add("--chunks", nargs="+", type=int, default=[1, 2, 4, 8, 16], help="values of H (%(default)s)")
    add("--nfe", nargs="+", type=int, default=[9, 3, 1], help="evaluations per chunk (%(default)s)")
    return parser


def make_priors(args: argparse.Namespace) -> list[Prior]:
    options = {"cold_probability": args.cold_probability}
    return [
        Prior.make(name, chunk, **options)
        for chunk in sorted(set(args.chunks))
        for name in dict.fromkeys(args.prior)
    ]


def make_table(rows: Sequence[Row], chunks: Sequence[int], nfes: Sequence[int], top_k: int) -> str:
    columns = list(dict.fromkeys((row.nfe, row.prior) for row in rows))
    columns.sort(key=lambda column: list(nfes).index(column[0]))
    head = [f"NFE {nfe}: {prior_label(name)}" for nfe, name in columns]
    last = max(row.checkpoint for row in rows)
    successes: list[list[str]] = []
    jumps: list[list[str]] = []
    for chunk in chunks:
        success, jump = [], []
        for nfe, name in columns:
            cell = [row for row in rows if (row.chunk, row.nfe, row.prior) == (chunk, nfe, name)]
            summary = summarize_cell(cell, top_k)
            spread = f" ± {100 * summary.std:.1f}" if summary.seeds > 1 else ""
            success.append(f"{100 * summary.mean:.1f}{spread}")
            known = [row.boundary_jump for row in cell if row.checkpoint == last]
            known = [value for value in known if value is not None]
            jump.append(f"{sum(known) / len(known):.3f}" if known else "-")
        successes.append([f"H = {chunk}", *success])
        jumps.append([f"H = {chunk}", *jump])
    note = (
        "Jump: mean distance between the last action of a chunk and the first of the next, in "
        "normalised action units, of the last checkpoints."
    )
    first = markdown_table(["success (%)", *head], successes)
    return f"{first}\n{markdown_table(['jump at boundaries', *head], jumps, [note])}"


def main(argv: list[str] | None = None) -> int:
    try:
        args = experiment.parse(make_parser, argv, "chunking-")
        preset, priors = experiment.make_preset(args), make_priors(args)
        comparison = experiment.start_comparison(args, preset, priors, args.nfe)
        results = comparison.run()
        rows, nfes = results.rows, comparison.nfes
        chunks = sorted(set(args.chunks))
        table = make_table(rows, chunks, nfes, preset.top_k)
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        meta = results.meta
        task = (
            f"{meta['task']} {meta['style']} ({meta['data_source']} data), {preset.seeds} seed(s)"
        )
        plot_chunk_lengths(
            rows, args.out / "chunk_lengths.png", nfes=nfes, top_k=preset.top_k, title=task
        )
        groups = [chunk for chunk in (chunks[0], 8) if chunk in chunks]
        plot_success_bars(
            rows,
            args.out / "bars.png",
            groups=list(dict.fromkeys(groups)),
            nfe=min(nfes),
            top_k=preset.top_k,
            title=task,
        )
        shortest = [row for row in rows if row.chunk == chunks[0]]
        plot_success(
            shortest,
            args.out / "violins.png",
            priors=list(dict.fromkeys(row.prior for row in shortest)),
            nfes=nfes,
            title=f"{task}, H = {chunks[0]}",
        )
    except experiment.ERRORS as error:
        print(f"chunking.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
