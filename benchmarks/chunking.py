"""The paper's H = 1 study (Fig. 6), extended to more chunk lengths: success, and jumps at chunk boundaries.

python benchmarks/chunking.py                             # square ph, one seed, over an hour on two cores
python benchmarks/chunking.py --chunk 1 8 --nfe 1 --task square transport --style ph mh   # the paper's figure
python benchmarks/chunking.py --resume                    # after an interruption

Policies that robomimic.py trained with the same options are reused.
"""

from __future__ import annotations

import sys

from lab.options.command_line import parse, script, started
from lab.options.options import check_single, with_parts
from lab.options.presets import PRESETS

JUMPS = ("boundary_jump", "inner_jump")


@script("chunking.py")
def main(argv: list[str] | None) -> None:
    """Train and play a policy per source and chunk length."""
    chunks = {"sources": {"chunk": (1, 2, 4, 8, 16)}}
    presets = {name: with_parts(preset, **chunks) for name, preset in PRESETS.items()}
    options = parse(presets, argv, "chunking", __doc__)
    from lab.reporting.paper import PAPER_CHUNK
    from lab.reporting.plots import plot_bars, plot_lines, plot_success
    from lab.reporting.report import at_fewest, counted, labelled, per_seed, table, write_report
    from lab.running.comparison import compare
    from lab.running.policies import policies_of, slug

    check_single(options, "sigma", "temperature")
    with started(options, "chunking") as out:
        policies = policies_of(options)
        rows, failures = compare(options, policies)
        seeds = per_seed(labelled(rows, "chunk"), options.evaluation.top_k)
        seeds = seeds.sort_values(["chunk", "nfe"], ascending=[True, False], kind="stable")
        lines = {"success": "success rate", JUMPS: "jump at boundaries (dotted: inside)"}
        settings = dict(list(seeds.groupby("setting", sort=False)))
        for name, seeds_of_setting in settings.items():
            end = f"_{slug(name)}" if len(settings) > 1 else ""
            plot_lines(seeds_of_setting, out / f"chunk_lengths{end}.png", name, "chunk", lines)
        # All tasks side by side, at the fewest network evaluations.
        fewest, shortest = at_fewest(seeds), min(seeds.chunk)
        title = f"NFE {min(seeds.nfe)}, {counted(options.evaluation.seeds, 'seed')}"
        pair = fewest[fewest.chunk.isin((shortest, PAPER_CHUNK))]
        bars = {"success": "success rate"}
        plot_bars(pair.assign(chunk="H = " + pair.chunk.astype(str)), out / "bars.png", title, "chunk", bars)
        short = fewest[fewest.chunk == shortest]
        plot_success(short, out / "violins.png", f"{title}, H = {shortest}", group="setting")
        text = table(seeds, ["setting", "chunk", "nfe", "method"], ["success", *JUMPS])
        write_report(out, text, text, rows, failures)


if __name__ == "__main__":
    sys.exit(main())
