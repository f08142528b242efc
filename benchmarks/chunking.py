"""The paper's H = 1 study, and all chunk lengths: success and jumps at chunk boundaries.

python benchmarks/chunking.py                             # square ph, one seed, over an hour on two cores
python benchmarks/chunking.py --chunk 1 8 --nfe 1         # the paper's figure alone
python benchmarks/chunking.py --resume                    # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from warmprior.experiments import (
    PRESETS,
    Comparison,
    Row,
    comparison_preset,
    mean_cell,
    parse,
    plot_chunk_lengths,
    plot_success,
    plot_success_bars,
    select,
    source_labels,
    started,
    success_cell,
    table,
    write_report,
)
from warmprior.experiments.tables import last_checkpoints
from warmprior.io.script import run_script


def make_table(rows: Sequence[Row], top_k: int) -> str:
    jump, label = mean_cell("boundary_jump", ".3f"), source_labels(rows, chunks=False)
    return table(
        rows,
        lambda row: f"H = {row['chunk']}",
        lambda row: f"NFE {row['nfe']}: {label(row)}",
        {
            "success (%)": success_cell(top_k),
            "jump at boundaries": lambda rows: jump(last_checkpoints(rows)),
        },
        notes=[
            "Jump: mean distance between the last action of a chunk and the first of the next, in "
            "normalised action units, of the last checkpoints."
        ],
    )


def run(argv: Sequence[str] | None) -> None:
    presets = {
        name: replace(preset, sources=replace(preset.sources, chunk=(1, 2, 4, 8, 16)))
        for name, preset in PRESETS.items()
    }
    seen = partial(comparison_preset, presets=presets)
    recipe = parse(presets, argv, study="chunking", description=__doc__, preset=seen)
    recipe.check_single(problem=True, sigma=True)
    with started(recipe, "chunking") as out:
        comparison = Comparison(recipe, "chunking")
        comparison.run()
        rows = sorted(comparison.rows, key=lambda row: (row["chunk"], -row["nfe"]))
        top_k, nfe = recipe.evaluation.top_k, min(comparison.nfes)
        chunks = sorted(set(recipe.sources.chunk))
        title = f"{comparison.title}, {recipe.evaluation.seeds} seed(s)"
        plot_chunk_lengths(rows, out / "chunk_lengths.png", top_k=top_k, title=title)
        bars = [r for r in select(rows, nfe=nfe) if r["chunk"] in (chunks[0], 8)]
        plot_success_bars(bars, out / "bars.png", top_k=top_k, title=title)
        shortest = last_checkpoints(select(rows, chunk=chunks[0]))
        plot_success(shortest, out / "violins.png", title=f"{title}, H = {chunks[0]}")
        write_report(out, make_table(rows, top_k), comparison.failures)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "chunking.py")


if __name__ == "__main__":
    sys.exit(main())
