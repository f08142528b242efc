"""The paper's Table 1: Gaussian source, WP-Past and WP-Preview on Robomimic tasks from state.

python benchmarks/robomimic.py                                   # a first table within 15 minutes
python benchmarks/robomimic.py --task can --data mh --preset cpu
python benchmarks/robomimic.py --download --preset paper --device cuda --out runs/paper
python benchmarks/robomimic.py --resume --out runs/paper         # after an interruption
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

# Before torch: on a busy machine, threads that spin while they wait slow small networks thirtyfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from warmprior import (
    GaussianPrior,
    HistoryPrior,
    PastPrior,
    PreviewPrior,
    Prior,
    RegressionPrior,
)
from warmprior._files import check_writable, write_atomic
from warmprior.data import TASKS, download_robomimic, generate_demonstrations, get_task
from warmprior.data.tasks import EVALUATION_SEED
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.diagnostics.results import PRIOR_LABELS, success_table
from warmprior.envs import rendering_backend
from warmprior.training.comparison import Comparison, Demonstrations
from warmprior.training.filmstrip import record_filmstrip
from warmprior.training.presets import PRESETS, Preset

COMPARED = (GaussianPrior, PastPrior, PreviewPrior)
BASELINES = (RegressionPrior, HistoryPrior)
PRIORS: dict[str, type[Prior]] = {prior.name: prior for prior in COMPARED + BASELINES}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--task", choices=TASKS, help="manipulation task (default: square, or the file's)")
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--dataset", type=Path, help="a robomimic HDF5 file, instead of generated data")
    add("--download", action="store_true", help="fetch the official file from the hub instead")
    add(
        "--prior",
        nargs="+",
        default=[prior.name for prior in COMPARED],
        choices=PRIORS,
        help="sources and baselines; the first in this order is the base (default: the first three)",
    )
    add("--sigma", type=float, help="noise of the warm priors (default: past 0.5, preview 1.0)")
    add(
        "--cold-probability",
        type=float,
        default=0.0,
        help="share of training samples without a mean (%(default)s, the paper's)",
    )
    add("--nfe", nargs="+", type=int, default=[9, 3, 1], help="evaluations per chunk (%(default)s)")
    add("--chunk", type=int, default=8, help="chunk length H (%(default)s)")
    add("--preset", default="quick", choices=PRESETS, help=f"{_describe_presets()} (%(default)s)")
    add("--seeds", type=int, help="number of training seeds (default: the preset's)")
    add("--episodes", type=int, help="evaluation episodes per cell (default: the preset's)")
    add("--envs", type=int, help="parallel environments (default: the preset's, or one per core)")
    add("--iterations", type=int, help="gradient steps (default: the preset's)")
    add("--demonstrations", type=int, help="scripted demonstrations (default: the preset's)")
    add("--out", type=Path, help="output folder (default: runs/TASK-DATA-PRESET, numbered)")
    add(
        "--resume",
        action="store_true",
        help="continue in --out, or in the latest default folder, with the options stored there",
    )
    add("--device", default="cpu", help="device of networks and data, such as cuda (%(default)s)")
    add("--compile", action="store_true", help="torch.compile the network in training")
    add(
        "--logger",
        default="csv",
        choices=("csv", "tensorboard", "wandb", "none"),
        help="TorchRL logger of the training curves (%(default)s)",
    )
    return parser


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """The options; those of the run to continue, where --resume is given."""
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.dataset is None and args.task is None:
        args.task = None if args.resume else "square"
    args.out = output_folder(args)
    stored = args.out / "options.json"
    if args.resume and stored.exists():
        options = json.loads(stored.read_text())
        for key in ("dataset",):
            options[key] = None if options[key] is None else Path(options[key])
        out, parser = args.out, make_parser()
        parser.set_defaults(**options)
        args = parser.parse_args(argv)
        args.out = out
        changed = [key for key in options if getattr(args, key) != options[key]]
        if changed:
            told = ", ".join(f"--{key.replace('_', '-')} {options[key]}" for key in changed)
            raise ValueError(
                f"{out} was started with {told}: leave these out, or choose another --out"
            )
    args.task = args.task or (None if args.dataset else "square")
    return args


def store_options(args: argparse.Namespace) -> dict[str, object]:
    """Write the options to the output folder before any work, and return them."""
    options = {key: value for key, value in vars(args).items() if key not in ("out", "resume")}
    options["dataset"] = None if args.dataset is None else str(args.dataset.resolve())
    text = json.dumps(options, indent=1) + "\n"
    write_atomic(args.out / "options.json", lambda path: path.write_text(text))
    return options


def _describe_presets() -> str:
    return "; ".join(f"{name}: {preset.summary}" for name, preset in PRESETS.items())


def make_priors(args: argparse.Namespace) -> list[Prior]:
    priors = []
    for name in sorted(set(args.prior), key=list(PRIORS).index):
        options = {"cold_probability": args.cold_probability}
        if name in ("past", "preview"):
            options["sigma"] = args.sigma
        priors.append(PRIORS[name](args.chunk, **options))
    return priors


def make_preset(args: argparse.Namespace) -> Preset:
    preset = PRESETS[args.preset]
    if args.iterations is not None:
        kept = min(preset.training.checkpoints, args.iterations)
        preset = replace(
            preset,
            training=replace(preset.training, iterations=args.iterations, checkpoints=kept),
        )
    for option in ("seeds", "episodes", "envs"):
        value = getattr(args, option)
        if value is not None:
            if value < 1:
                raise ValueError(f"--{option} must be at least 1, got {value}")
            preset = replace(preset, **{option: value})
    return preset


def output_folder(args: argparse.Namespace) -> Path:
    if args.out is not None:
        if (args.out / "results.json").exists() and not args.resume:
            raise ValueError(
                f"{args.out} holds a run: add --resume to continue it, or choose another --out"
            )
        return args.out
    task = args.task or (args.dataset.stem if args.dataset else "square")
    name = f"{task}-{args.data}-{args.preset}"

    def number(folder: Path) -> int:
        return int(folder.name[len(name) + 1 :] or 1)

    taken = [
        d
        for d in Path("runs").glob(f"{name}*")
        if d.name == name or d.name[len(name) + 1 :].isdigit()
    ]
    if not taken:
        return Path("runs") / name
    latest = max(taken, key=number)
    return latest if args.resume else latest.with_name(f"{name}-{number(latest) + 1}")


def check(args: argparse.Namespace) -> None:
    """Refuse options that cannot work, before anything is generated or downloaded."""
    if min(args.nfe) < 1:
        raise ValueError(f"--nfe must be at least 1, got {min(args.nfe)}")
    try:
        torch.empty(0, device=args.device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {args.device} does not work here: {error}") from error
    if args.dataset is not None and (args.download or args.demonstrations is not None):
        raise ValueError("--dataset reads a file: leave out --download and --demonstrations")
    if args.dataset is not None and not args.dataset.is_file():
        raise FileNotFoundError(f"--dataset {args.dataset}: no such file")
    if args.demonstrations is not None and args.demonstrations < 1:
        raise ValueError(f"--demonstrations must be at least 1, got {args.demonstrations}")
    if args.sigma is not None and not {"past", "preview"} & set(args.prior):
        raise ValueError("--sigma belongs to the warm priors past and preview; none is compared")
    if args.logger in ("tensorboard", "wandb") and importlib.util.find_spec(args.logger) is None:
        raise ImportError(f"--logger {args.logger} needs the package {args.logger}: pip install it")


def find_demonstrations(args: argparse.Namespace, preset: Preset) -> Demonstrations:
    if args.dataset is not None:
        return Demonstrations(args.dataset, "file", args.data)
    if args.download:
        return Demonstrations(download_robomimic(args.task, args.data), "official", args.data)
    if not get_task(args.task).scripted:
        raise ValueError(
            f"there is no scripted expert for {args.task}: add --download for the official data, or "
            "--dataset FILE"
        )
    n = args.demonstrations or preset.demonstrations[args.data]
    print(
        f"Data: {n} scripted demonstrations. They stand in for the official human data (--download); "
        "success rates on them are not comparable with the paper's.",
        flush=True,
    )
    return Demonstrations(generate_demonstrations(args.task, args.data, n), "scripted", args.data)


def draw(comparison: Comparison) -> None:
    results, out = comparison.results, comparison.directory
    priors = [prior.name for prior in comparison.priors]
    first = results.rows[0]
    title = f"{first.task} {first.data} ({results.meta['data_source']} data), H = {first.chunk}"
    plot_success(
        results.rows, out / "success.png", priors=priors, nfes=comparison.nfes, title=title
    )
    plot_learning_curves(
        comparison.losses,
        results.rows,
        out / "learning_curves.png",
        nfe=min(comparison.nfes),
        title=title,
    )
    if rendering_backend() is None:
        print(
            "No filmstrips: neither EGL nor OSMesa works here. On Debian or Ubuntu: "
            "apt-get install libegl1 libegl-mesa0 (or libosmesa6)."
        )
        return
    for prior in comparison.priors:
        if prior.max_nfe is not None and prior.max_nfe < min(comparison.nfes):
            continue
        checkpoint = comparison.preset.training.iterations
        strip = record_filmstrip(
            comparison.policy(prior, comparison.seeds[0], checkpoint),
            comparison.make_env,
            comparison.transforms(prior),
            seed=EVALUATION_SEED,
            nfe=min(comparison.nfes),
        )
        outcome = "solved" if strip.success else "not solved"
        plot_filmstrip(
            strip.frames,
            [f"step {step}" for step in strip.steps],
            out / f"filmstrip_{prior.name}.png",
            title=f"{PRIOR_LABELS[prior.name]}, NFE {min(comparison.nfes)}, episode "
            f"{EVALUATION_SEED}: {outcome}",
        )


def main(argv: list[str] | None = None) -> int:
    try:
        args = parse(argv)
        preset, priors = make_preset(args), make_priors(args)
        check(args)
        check_writable(args.out)
        options = store_options(args)
        print(f"Output folder: {args.out}", flush=True)
        comparison = Comparison(
            demonstrations=find_demonstrations(args, preset),
            preset=preset,
            priors=priors,
            nfes=sorted(set(args.nfe), reverse=True),
            directory=args.out,
            seeds=range(preset.seeds),
            device=args.device,
            compile=args.compile,
            logger=args.logger,
            resume=args.resume,
            options=options,
        )
        if args.task not in (None, comparison.task):
            raise ValueError(
                f"{args.dataset} holds demonstrations of {comparison.task}, not of {args.task}: leave "
                "--task out or correct it"
            )
        results = comparison.run()
        table = success_table(
            results, priors=[p.name for p in priors], nfes=comparison.nfes, top_k=preset.top_k
        )
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        draw(comparison)
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        print(f"robomimic.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    torch.set_float32_matmul_precision("high")
    sys.exit(main())
