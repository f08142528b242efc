"""The paper's H = 1 study (Fig. 6), and all chunk lengths: success and jumps at chunk boundaries.

python benchmarks/chunking.py                             # square ph, one seed, over an hour on two cores
python benchmarks/chunking.py --chunk 1 8 --nfe 1         # the paper's figure alone
python benchmarks/chunking.py --resume                    # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import sys

from common import policies_of
from options import PRESETS, check_single, parse, script, started, with_parts
from plots import plot_bars, plot_chunk_lengths, plot_success
from report import chunk_table, last_checkpoints, write_report
from robomimic import compare


@script("chunking.py")
def main(argv: list[str] | None) -> None:
    """Train and play a policy per source and chunk length."""
    chunks = {"sources": {"chunk": (1, 2, 4, 8, 16)}}
    presets = {name: with_parts(preset, **chunks) for name, preset in PRESETS.items()}
    options = parse(presets, argv, "chunking", __doc__)
    check_single(options, "task", "data", "sigma")
    with started(options, "chunking") as out:
        policies = policies_of(options, options.sources.methods())
        rows, failures = compare(options, policies)
        top_k, shortest = options.evaluation.top_k, min(options.sources.chunk)
        title = f"{policies[0].task().title}, {options.evaluation.seeds} seed(s)"
        plot_chunk_lengths(rows, out / "chunk_lengths.png", top_k=top_k, title=title)
        fewest = rows[rows.nfe == min(rows.nfe)]
        plot_bars(fewest[fewest.chunk.isin((shortest, 8))], out / "bars.png", top_k=top_k, title=title)
        short = last_checkpoints(rows[rows.chunk == shortest])
        plot_success(short, out / "violins.png", title=f"{title}, H = {shortest}")
        table = chunk_table(rows, top_k)
        write_report(out, table, table, rows, failures)


if __name__ == "__main__":
    sys.exit(main())
