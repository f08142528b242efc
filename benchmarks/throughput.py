"""Speed of the library as ratios to the code that it is built on, both measured in the same run.

python benchmarks/throughput.py                                  # everything, a few minutes
python benchmarks/throughput.py --only windows_over_torch actor_over_network
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lab.options.command_line import script
from warmprior.io.script import read_command_line

FIGURES: dict[str, dict[str, str]] = {
    "windows": {
        "windows_over_torch": ">= 0.6",
        "windows_over_ranges": ">= 0.45",
        "lerobot_windows_over_getitem": ">= 500",
    },
    "training": {
        "train_step_over_network": "<= 1.10",
        "cuda_train_step_over_network": "<= 1.05",
        "cuda_steps_per_second": "",
        "preconditioning_over_network": "<= 1.02",
        "ddp_efficiency": "",
        "default_step_over_network": "<= 1.25",
        "matrix_peak": "",
    },
    "decisions": {
        "actor_over_network": "<= 1.10",
        "default_actor_over_network": "<= 1.5",
        "exported_over_passes": "<= 0.35",
    },
    "learning": {"learning_over_environments": ">= 0.4"},
    "environments": {
        "env_over_robosuite": ">= 2",
        "chunk_step_overhead": "<= 0.12 with all",
        "batched_chunk_step": "<= 1.15",
    },
}
"""By file of ``lab/speed``: its figures, which are functions of a clock, with their targets."""


@script("throughput.py", hint="")
def main(argv: list[str] | None) -> None:
    """Measure the figures and write them to `throughput.json`."""
    files = {name: file for file, figures in FIGURES.items() for name in figures}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    out = Path("runs/throughput")
    names = ", ".join(files)
    add("--only", nargs="+", choices=files, metavar="NAME", help=f"figures of {names} (default: all)")
    add("--out", type=Path, default=out, help="folder of throughput.json (default: %(default)s)")
    add("--repeats", type=int, default=11, help="rounds per figure (default: %(default)s)")
    options = read_command_line(lambda: parser.parse_args(argv))
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")

    import torch

    from lab.io.machine import facts_of_machine
    from lab.speed.timing import Clock

    path = options.out / "throughput.json"
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = dict.fromkeys(files)
    with tqdm(options.only or list(files), unit="figure", dynamic_ncols=True) as bar:
        for name in bar:
            bar.set_description(name)
            target = FIGURES[files[name]][name]
            measure = getattr(importlib.import_module(f"lab.speed.{files[name]}"), name)
            results[name] = value = measure(Clock(options.repeats, bar))
            shown = f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
            tqdm.write(f"{name:32} {shown} {f'(target {target})' if target else ''}")
    date = datetime.now(UTC).isoformat(timespec="seconds")
    results["meta"] = facts_of_machine(torch_threads=torch.get_num_threads(), date=date)
    path.write_text(json.dumps(results, indent=2) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    sys.exit(main())
