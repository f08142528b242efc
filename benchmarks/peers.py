"""Speed of training and inference compared with LeRobot and TorchRL, on the same windows at equal size.

python benchmarks/peers.py                                   # minutes on two cores
python benchmarks/peers.py --device cuda --batch-size 1024

Peers run as their packages ship them, in one process and on one thread (on a CPU), with the same
optimiser. Every training step takes a batch from the same replay buffer of windows, so the cost of a peer's
own data loader is left out. Peers that are not installed are skipped.

Equal parameters are not equal work. Of the 18.5 M parameters of multi_task_dit, 7.4 M multiply a constant and
10.9 M are used once per sample. So the table also has GFLOP/s, counted in the loss, or in the network alone
where the operations of a loss cannot be counted. Every network keeps its own dropout.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from warmprior.io.files import check_writable
from warmprior.io.script import read_command_line, run_script

if TYPE_CHECKING:
    import pandas as pd

PEERS: dict[str, tuple[int, tuple[str, ...]]] = {
    "warmprior_transformer": (384, ()),
    "warmprior_adaln": (360, ()),
    "warmprior_mlp": (1984, ()),
    "torchrl": (2208, ()),
    "lerobot_diffusion": (144, ("lerobot", "diffusers")),
    "lerobot_multi_task_dit": (320, ("lerobot", "diffusers", "transformers")),
}
"""By name of a function of ``lab/speed/peers.py``: the width for 20M parameters, and needed packages."""


def draw(path: Path, rows: pd.DataFrame) -> None:
    from matplotlib.figure import Figure

    from lab.speed.timing import NFES

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    speed, latency = figure.subplots(1, 2)
    colors = ["#1f77b4", "#6baed6", "#d95f02", "#2ca02c", "#7570b3", "#e7298a"][: len(rows)]
    speed.barh(rows.index.str.replace(": ", ":\n"), rows.samples_per_second, color=colors)
    speed.set(xlabel="training, samples/s")
    speed.invert_yaxis()
    for (_, row), color in zip(rows.iterrows(), colors, strict=True):  # the bars are the legend
        latency.plot(NFES, row[[f"latency_nfe_{nfe}" for nfe in NFES]], "o-", color=color)
    latency.set(xlabel="network evaluations per chunk", ylabel="latency of a chunk, ms")
    latency.set(yscale="log", xticks=NFES)
    figure.savefig(path, dpi=150)


def run(argv: Sequence[str] | None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--peers", nargs="+", default=list(PEERS), choices=PEERS, help="policies to measure (default: all)")
    add("--batch-size", type=int, default=256, help="windows per batch (default: %(default)s)")
    add("--repeats", type=int, default=5, help="number of rounds (default: %(default)s)")
    add("--device", default="cpu", help="device, such as cuda (default: %(default)s)")
    add("--out", type=Path, default=Path("runs/peers"), help="output folder (default: %(default)s)")
    options = read_command_line(lambda: parser.parse_args(argv))
    if options.repeats < 1 or options.batch_size < 1:
        parser.error("--repeats and --batch-size must be at least 1")
    import pandas as pd
    import torch

    from lab.io.machine import check_device, facts_of_machine
    from lab.speed import peers as kinds
    from lab.speed.timing import Clock

    check_device(options.device)
    torch.manual_seed(0)
    peers = []
    for name in options.peers:
        width, packages = PEERS[name]
        if missing := [package for package in packages if not find_spec(package)]:
            print(f"{name}: skipped, because it needs {' and '.join(missing)}: pip install 'warmprior[vla]'")
        else:
            peers.append(getattr(kinds, name)(width, options.device))
    if not peers:
        raise ValueError("none of these peers is installed: pip install 'warmprior[vla]'")
    check_writable(options.out)
    with tqdm(desc="rounds", dynamic_ncols=True) as bar:
        rows = kinds.measure(peers, options.device, options.batch_size, Clock(options.repeats, bar))
    meta = facts_of_machine(
        device=options.device, torch_threads=torch.get_num_threads(), batch_size=options.batch_size
    )
    text = json.dumps({"meta": meta, "rows": rows}, indent=2)
    (options.out / "peers.json").write_text(text + "\n")
    table = pd.DataFrame(rows).set_index("policy")
    draw(options.out / "peers.png", table)
    print(table.T.to_string(float_format="{:,.2f}".format))
    print(f"written to {options.out}")


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "peers.py")


if __name__ == "__main__":
    sys.exit(main())
