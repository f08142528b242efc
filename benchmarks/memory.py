"""Plot the gain in success over the first method against memory gain, from finished runs.

python benchmarks/memory.py runs/square-ph-cpu runs/square-mh-cpu --out memory.png

It trains and plays nothing: it reads `results.jsonl` of runs of robomimic.py or pusht.py.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lab.options.command_line import script
from lab.options.options import Options
from lab.options.stored_options import stored_options
from warmprior.io.script import read_command_line


@script("memory.py", hint="")
def main(argv: list[str] | None) -> None:
    """Read the runs, print a table and draw a point per task, method and NFE."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of finished runs")
    out = Path("memory.png")
    parser.add_argument("--out", type=Path, default=out, help="picture to write (default: %(default)s)")
    args = read_command_line(lambda: parser.parse_args(argv))
    import pandas as pd

    from lab.reporting.plots import colors_of, new_figure, save
    from lab.reporting.report import baseline, summary, table
    from lab.reporting.rows import PLAYED, RESULTS, read_rows

    # A row per setting, method and NFE.
    whose = "robomimic.py or pusht.py: name a run of these"
    summaries = []
    for run in args.runs:
        rows = pd.DataFrame(read_rows(run / RESULTS, PLAYED, whose))
        if "memory_gain" not in rows:
            raise ValueError(f"{run} measured no memory_gain: name a run of robomimic.py or pusht.py")
        top_k = stored_options(Options, run, None).evaluation.top_k  # as in the run's report
        for iterations, part in rows.groupby("iterations"):
            summaries.append(summary(part, top_k).assign(run=str(run), iterations=iterations))
    gains = pd.concat(summaries)
    gains = gains[gains.memory_gain.notna() & gains.gain.notna()]
    if gains.empty:
        raise ValueError("no method of these runs has both a memory gain and a gain in success: add a run")

    figure, (axis,) = new_figure(4.0, 3.0)
    colors = colors_of(gains)
    for method, group in gains.groupby("method", sort=False):
        axis.scatter(group.memory_gain, 100 * group.gain, 40, color=colors[method], label=method)
    axis.axhline(0, color="0.6", lw=0.8)
    axis.locator_params(axis="x", nbins=5)
    axis.set_xlabel("memory gain (0: past ignored, 1: past copied)")
    axis.set_ylabel("gain in success (points)")
    firsts = dict.fromkeys(map(baseline, summaries))
    save(figure, args.out, f"Gain over {' or '.join(firsts)}", 12)

    apart = [name for name in ("run", "chunk", "iterations") if gains[name].nunique() > 1]
    text = table(gains, ["setting", *apart, "nfe", "temperature", "method"], ["memory_gain", "gain"])
    print(text, f"\nPicture: {args.out}", sep="")


if __name__ == "__main__":
    sys.exit(main())
