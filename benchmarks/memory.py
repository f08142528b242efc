"""Does memory help? Memory gain against success over the Gaussian source, from finished runs.

python benchmarks/memory.py runs/square-ph-cpu runs/square-mh-cpu --out memory.png

It trains and plays nothing: it reads `results.jsonl` of runs of robomimic.py (docs/benchmarks.md).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pandas as pd

from lab.command_line import script
from lab.plots import colors_of, new_figure, save
from lab.report import summary, table
from lab.rows import PLAYED, read_rows


@script("memory.py", hint="")
def main(argv: list[str] | None) -> None:
    """Read the runs, print a table and draw a point per task, method and NFE."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of finished runs")
    parser.add_argument("--out", type=Path, default=Path("memory.png"), help="the picture")
    args = parser.parse_args(argv)

    # A record per task, method and NFE, with everything that is known of it as a column.
    whose = "robomimic.py or pusht.py: name a run of these"
    tables = [pd.DataFrame(read_rows(run / "results.jsonl", PLAYED, whose)) for run in args.runs]
    for run, rows in zip(args.runs, tables, strict=True):
        if "memory_gain" not in rows:
            raise ValueError(f"{run}: its rows have no memory_gain; name a run of robomimic.py or pusht.py")
    found = pd.concat([summary(rows, top_k=1) for rows in tables])
    found = found[found.memory_gain.notna() & found.gain.notna()]
    if found.empty:
        raise ValueError("these runs have no method beside their first one that was measured")

    figure, (axis,) = new_figure(6.0, 4.0)
    colors = colors_of(found)
    for method, group in found.groupby("method", sort=False):
        axis.scatter(group.memory_gain, 100 * group.gain, 18, color=colors[method], label=method)
    axis.axhline(0, color="0.6", lw=0.8)
    axis.set_xlabel("memory gain (0: ignores what it did, 1: repeats it)")
    axis.set_ylabel("success over the first method (points)")
    save(figure, args.out, f"{len(found)} cells of {len(args.runs)} runs")

    text = table(found, ["setting", "nfe", "method"], ["memory_gain", "gain"])
    print(text, f"\nPicture: {args.out}", sep="")


if __name__ == "__main__":
    sys.exit(main())
