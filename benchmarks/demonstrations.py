"""Generate, play, download or render the demonstrations of the benchmarks' tasks.

python benchmarks/demonstrations.py generate lift --n 100 --out lift.hdf5     # by a scripted expert
python benchmarks/demonstrations.py play policies/lift --out own.hdf5         # by a saved policy
python benchmarks/demonstrations.py download square mh                        # the official ones
python benchmarks/demonstrations.py render square.hdf5 --cameras agentview    # images from their states
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lab.demonstrations.downloads import OFFICIAL
from lab.demonstrations.scripted.experts import EXPERTS
from lab.options.command_line import script
from warmprior.io.script import read_command_line


@script("demonstrations.py", hint="")
def main(argv: list[str] | None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")

    add = commands.add_parser("generate", help="generate scripted demonstrations").add_argument
    add("task", choices=list(EXPERTS))
    add("--style", default="ph", choices=("ph", "mh"), help="one or six operators (default: %(default)s)")
    add("--n", type=int, default=200, help="number of demonstrations (default: %(default)s)")
    add("--out", type=Path, help="HDF5 file to write (default: in the cache)")
    add("--overwrite", action="store_true", help="replace an existing file")

    add = commands.add_parser("play", help="let a saved policy play, and keep what it solves").add_argument
    add("folder", type=Path, help="folder of the policy, made for an environment of robosuite")
    add("--episodes", type=int, default=200, help="number of episodes to play (default: %(default)s)")
    add("--nfe", type=int, help="network evaluations per chunk (default: the policy's)")
    add(
        "--seed",
        type=int,
        default=1,
        help="starts, 0 (scripted demonstrations') to 99 (default: %(default)s)",
    )
    add("--import", action="append", default=[], dest="modules", help="module of the policy's own classes")
    add("--out", type=Path, required=True, help="HDF5 file to write")
    add("--overwrite", action="store_true", help="replace an existing file")

    add = commands.add_parser("download", help="download the official file of a task").add_argument
    add("task", choices=list(OFFICIAL))
    add("style", nargs="?", help="style, such as ph or mh (default: the first that is published)")
    add("--force", action="store_true", help="download again, even if the file is in the cache")

    add = commands.add_parser(
        "render", help="render states to images, or continue an interrupted rendering"
    ).add_argument
    add("file", type=Path, help="robomimic HDF5 file with states")
    add("--cameras", nargs="+", help="cameras of the simulator (default: the task's)")
    add("--size", type=int, default=84, help="side of the images in pixels (default: %(default)s)")
    add("--fast", action="store_true", help="render without reflections, shadows and smooth edges")
    add("--out", type=Path, help="HDF5 file to write, which may be FILE itself (default: in the cache)")
    add("--workers", type=int, help="number of processes (default: one per core)")

    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    args = read_command_line(lambda: parser.parse_args(argv))
    from lab.demonstrations.downloads import download_robomimic
    from lab.demonstrations.played import play_demonstrations
    from lab.demonstrations.render import render_demonstrations
    from lab.demonstrations.scripted.generate import generate_demonstrations

    if args.command == "generate":
        print(generate_demonstrations(args.task, args.style, args.n, path=args.out, overwrite=args.overwrite))
    elif args.command == "play":
        options = {name: getattr(args, name) for name in ("nfe", "overwrite", "modules")}
        print(play_demonstrations(args.folder, args.episodes, args.seed, path=args.out, **options))
    elif args.command == "download":
        print(download_robomimic(args.task, args.style, force=args.force))
    else:
        rendering = {"fast": args.fast, "out": args.out, "workers": args.workers}
        print(render_demonstrations(args.file, args.cameras, args.size, **rendering))


if __name__ == "__main__":
    sys.exit(main())
