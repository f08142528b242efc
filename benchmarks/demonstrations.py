"""Demonstrations of the benchmarks' tasks as files.

python benchmarks/demonstrations.py generate lift --n 100 --out lift.hdf5     # by a scripted expert
python benchmarks/demonstrations.py download square mh                        # the official ones
python benchmarks/demonstrations.py render square.hdf5 --cameras agentview    # images from their states
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lab.command_line import script
from lab.downloads import OFFICIAL, download_robomimic
from lab.render import render_demonstrations
from lab.scripted.generate import generate_demonstrations
from lab.scripted.tasks import EXPERTS


@script("demonstrations.py", hint="")
def main(argv: list[str] | None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")

    add = commands.add_parser("generate", help="generate scripted demonstrations").add_argument
    add("task", choices=list(EXPERTS))
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--n", type=int, default=200, help="how many (%(default)s)")
    add("--out", type=Path, help="HDF5 file (default: in the cache)")
    add("--overwrite", action="store_true", help="replace the file if it is there")

    add = commands.add_parser("download", help="download the official file of a task").add_argument
    add("task", choices=list(OFFICIAL))
    add("data", nargs="?", help="style (default: the first there is)")
    add("--force", action="store_true", help="also if it is here")

    add = commands.add_parser(
        "render", help="render states to images; continues where it stopped"
    ).add_argument
    add("file", type=Path, help="robomimic HDF5 file with states")
    add("--cameras", nargs="+", help="of the simulator (default: those of the task)")
    add("--size", type=int, default=84, help="side of the images in pixels (%(default)s)")
    add("--fast", action="store_true", help="no reflections, shadows and smooth edges")
    add("--out", type=Path, help="HDF5 file, also FILE itself (default: in the cache)")
    add("--workers", type=int, help="processes (default: one per core)")

    a = parser.parse_args(argv)
    if a.command == "generate":
        print(generate_demonstrations(a.task, a.data, a.n, path=a.out, overwrite=a.overwrite))
    elif a.command == "download":
        print(download_robomimic(a.task, a.data, force=a.force))
    else:
        print(render_demonstrations(a.file, a.cameras, a.size, fast=a.fast, out=a.out, workers=a.workers))


if __name__ == "__main__":
    sys.exit(main())
