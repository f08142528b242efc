"""The paper's comparison with Real-Time Chunking, in simulation: chunks that take effect late.

python benchmarks/real_time_chunking.py                     # square and the toy, one seed
python benchmarks/real_time_chunking.py --toy alone         # minutes
python benchmarks/real_time_chunking.py --task can stack --toy no --preset cpu
python benchmarks/real_time_chunking.py --resume            # after an interruption

While a chunk is computed, the one before is executed. Base, WP-Past and WP-Preview are played as they
are, and guided by Real-Time Chunking, with the same decisions per second at every delay. The policies
of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial

from warmprior.experiments import (
    PRESETS,
    Comparison,
    DelayedRecipe,
    Recipe,
    Row,
    Store,
    comparison_preset,
    grouped,
    guided_labels,
    mean_cell,
    parse,
    plot_delays,
    started,
    success_cell,
    table,
    write_report,
)
from warmprior.experiments.tables import last_checkpoints
from warmprior.io.script import run_script

STUDY = "real-time-chunking"


def study(preset: Recipe) -> DelayedRecipe:
    """A preset at nine network evaluations per chunk: guidance corrects step by step."""
    parts = {f.name: getattr(preset, f.name) for f in fields(preset)}
    return DelayedRecipe(**parts | {"evaluation": replace(preset.evaluation, nfe=(9,))})


def make_table(rows: Sequence[Row], recipe: DelayedRecipe) -> str:
    jump, label = mean_cell("boundary_jump", ".3f"), guided_labels(rows)
    inner, top_k = mean_cell("inner_jump", ".3f"), recipe.evaluation.top_k
    told = ", ".join(
        f"{f.name.replace('_', ' ')} {value}"
        for f in fields(recipe.rtc)
        if (value := getattr(recipe.rtc, f.name)) is not None
    )
    return table(
        sorted(rows, key=lambda row: (row["task"], row["data"], -row["nfe"], row["delay"])),
        lambda row: f"{row['task']} {row['data']}, NFE {row['nfe']}, delay {row['delay']}",
        label,
        {
            "success (%)": success_cell(top_k),
            "jump": lambda rows: jump(last_checkpoints(rows)),
            "step inside": lambda rows: inner(last_checkpoints(rows)),
        },
        notes=[
            f"- H = {rows[0]['chunk']}; {rows[0]['execute']} actions per decision at every delay, which "
            f"is told in control steps; {recipe.evaluation.seeds} seed(s), {rows[0]['episodes']} episodes "
            "per cell.",
            "- Jump: mean distance between consecutive actions where a chunk takes effect; step inside: "
            "elsewhere. In normalised action units, of the last checkpoints.",
            f"- RTC: {told}; the weight is that of the source's own width where sigma is not told.",
        ],
    )


def run(argv: Sequence[str] | None) -> None:
    presets = {name: study(preset) for name, preset in PRESETS.items()}
    seen = partial(comparison_preset, presets=presets)
    recipe = parse(presets, argv, study=STUDY, description=__doc__, preset=seen)
    with started(recipe, STUDY) as out:
        stores = [Store.of(recipe, problem) for problem in recipe.problems()]
        comparison = Comparison(recipe, STUDY, stores=stores)
        comparison.run()
        rows = comparison.rows
        for nfe, mine in grouped(rows, lambda row: row["nfe"]).items():
            end = f"_nfe{nfe}.png" if len(comparison.nfes) > 1 else ".png"
            plot_delays(
                mine,
                out / f"real_time_chunking{end}",
                label=guided_labels(mine),
                top_k=recipe.evaluation.top_k,
                title=f"{mine[0]['execute']} actions per decision, {recipe.evaluation.seeds} seed(s)",
            )
        write_report(out, make_table(rows, recipe), comparison.failures)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "real_time_chunking.py")


if __name__ == "__main__":
    sys.exit(main())
