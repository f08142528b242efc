"""Options, folders and data that the benchmarks on manipulation tasks share."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

# Before torch: on a busy machine, threads that spin while they wait slow small networks thirtyfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from warmprior import Prior, WarmPriorActor
from warmprior.data import download_robomimic, generate_demonstrations
from warmprior.envs import TASKS, get_task
from warmprior.io.files import check_writable, write_atomic
from warmprior.training import PRESETS, Preset
from warmprior.training.comparison import Comparison
from warmprior.training.demonstrations import Demonstrations
from warmprior.training.policies import Policies
from warmprior.training.workers import WorkerError

COMPARED = ("gaussian", "past", "preview")
"""What is compared by default: the paper's sources, the base of the gains first."""

ERRORS = (ValueError, KeyError, OSError, ImportError, FloatingPointError, WorkerError)
"""What a user can mend: reported without a traceback."""


def add_options(parser: argparse.ArgumentParser) -> Callable[..., argparse.Action]:
    """Add the shared options and return ``parser.add_argument``."""
    add = parser.add_argument
    add("--task", choices=TASKS, help="manipulation task (default: square, or the file's)")
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--dataset", type=Path, help="a robomimic HDF5 file, instead of generated data")
    add("--download", action="store_true", help="fetch the official file from the hub instead")
    add(
        "--cold-probability",
        type=float,
        default=0.0,
        help="share of training samples without a mean (%(default)s, the paper's)",
    )
    presets = "; ".join(f"{name}: {preset.summary}" for name, preset in PRESETS.items())
    add("--preset", default="quick", choices=PRESETS, help=f"{presets} (%(default)s)")
    add("--seeds", type=int, help="number of training seeds (default: the preset's)")
    add("--episodes", type=int, help="evaluation episodes per cell (default: the preset's)")
    add(
        "--envs",
        type=int,
        help="worker processes that train and play, with the same results (default: the preset's, or "
        "one per core)",
    )
    add("--iterations", type=int, help="gradient steps (default: the preset's)")
    add("--demonstrations", type=int, help="scripted demonstrations (default: the preset's)")
    add(
        "--precondition",
        action=argparse.BooleanOptionalAction,
        help="by the second moments of source and data (default: the preset's)",
    )
    add("--out", type=Path, help="output folder (default: a numbered one under runs/)")
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
    return add


def add_prior(parser: argparse.ArgumentParser, default: Sequence[str], what: str) -> None:
    """Add ``--prior``."""
    parser.add_argument(
        "--prior",
        nargs="+",
        default=list(default),
        metavar="NAME",
        help=f"{what}: of {', '.join(Prior.registered())}, or your own as package.module:Class (default: "
        f"{' '.join(default)})",
    )


def launch(main: Callable[[], int]) -> None:
    """Run a script. Policies are shared between scripts, so all of them compute alike."""
    torch.set_float32_matmul_precision("high")
    sys.exit(main())


def parse(
    make_parser: Callable[[], argparse.ArgumentParser],
    argv: list[str] | None,
    prefix: str = "",
    default_task: Callable[[argparse.Namespace], str] = lambda args: "square",
    changeable: Sequence[str] = ("envs",),
) -> argparse.Namespace:
    """The options; those of the run to continue, but for the changeable ones, with --resume."""
    parser = make_parser()
    study = prefix.rstrip("-") or "robomimic"
    parser.set_defaults(study=study)
    args = parser.parse_args(argv)
    if args.dataset is None and args.task is None and not args.resume:
        args.task = default_task(args)
    args.out = output_folder(args, prefix, default_task(args))
    stored = args.out / "options.json"
    if args.resume and stored.exists():
        options = json.loads(stored.read_text())
        if options.setdefault("study", study) != study:
            raise ValueError(
                f"{args.out} holds a run of another study ({options['study']}): continue it with that "
                "script, or choose another --out"
            )
        parser = make_parser()
        types = {action.dest: action.type for action in parser._actions}
        for key, value in options.items():  # JSON knows no paths
            if types.get(key) is Path and value is not None:
                options[key] = Path(value)
        out = args.out
        parser.set_defaults(**options)
        args = parser.parse_args(argv)
        args.out = out
        changed = [
            key
            for key in options
            if key not in changeable and _plain(getattr(args, key)) != _plain(options[key])
        ]
        if changed:
            told = ", ".join(_as_option(key, options[key]) for key in changed)
            raise ValueError(
                f"{out} was started with {told}: leave these out, or choose another --out"
            )
    args.task = args.task or (None if args.dataset else default_task(args))
    return args


def _as_option(key: str, value: Any) -> str:
    """An option as it is, or is not, on the command line."""
    name = "--" + key.replace("_", "-")
    if value is None or value is False:
        return f"no {name}"
    return name if value is True else f"{name} {value}"


def _plain(value: Any) -> Any:
    return str(value.resolve()) if isinstance(value, Path) else value


def store_options(args: argparse.Namespace) -> dict[str, object]:
    """Write the options to the output folder before any work, and return them."""
    options = {
        key: _plain(value) for key, value in vars(args).items() if key not in ("out", "resume")
    }
    text = json.dumps(options, indent=1) + "\n"
    write_atomic(args.out / "options.json", lambda path: path.write_text(text))
    return options


def make_preset(args: argparse.Namespace) -> Preset:
    """The chosen preset with the options that replace parts of it."""
    preset = PRESETS[args.preset]
    if args.iterations is not None:
        preset = replace(preset, training=preset.training.with_iterations(args.iterations))
    if args.precondition is not None:
        preset = replace(preset, precondition=args.precondition)
    return with_counts(preset, args, ("seeds", "episodes", "envs"))


def with_counts(budget: Any, args: argparse.Namespace, names: Sequence[str]) -> Any:
    """Replace the named parts of a budget by the options of the same name that were given."""
    for name in names:
        value = getattr(args, name)
        if value is not None:
            if value < 1:
                raise ValueError(f"--{name} must be at least 1, got {value}")
            budget = replace(budget, **{name: value})
    return budget


def output_folder(args: argparse.Namespace, prefix: str = "", default_task: str = "square") -> Path:
    """The folder to write to; never one that holds results, unless they are to be continued."""
    if args.out is not None:
        if (args.out / "results.json").exists() and not args.resume:
            raise ValueError(
                f"{args.out} holds a run: add --resume to continue it, or choose another --out"
            )
        return args.out
    task = args.task or (args.dataset.stem if args.dataset else default_task)
    run = getattr(args, "run", None)
    style = args.data if run is None else run_facts(run)["style"]
    name = f"{prefix}{task}-{style}-{args.preset}"
    folder = numbered_folder(Path("runs"), name, latest=args.resume)
    if args.resume and not folder.is_dir():
        raise ValueError(f"--resume: there is no run in {folder}; name its folder with --out")
    return folder


def numbered_folder(parent: Path, name: str, *, latest: bool = False) -> Path:
    """The first free one of ``name``, ``name-2``, ``name-3``, ...; or the latest one taken."""

    def number(folder: Path) -> int:
        return int(folder.name[len(name) + 1 :] or 1)

    taken = [
        d for d in parent.glob(f"{name}*") if d.name == name or d.name[len(name) + 1 :].isdigit()
    ]
    if not taken:
        return parent / name
    last = max(taken, key=number)
    return last if latest else parent / f"{name}-{number(last) + 1}"


def check_nfes(nfes: Sequence[int]) -> list[int]:
    """The numbers of network evaluations to compare, the largest first."""
    if min(nfes) < 1:
        raise ValueError(f"--nfe must be at least 1, got {min(nfes)}")
    return sorted(set(nfes), reverse=True)


def check(args: argparse.Namespace) -> None:
    """Refuse options that cannot work, before anything is generated or downloaded."""
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
    if args.logger in ("tensorboard", "wandb") and importlib.util.find_spec(args.logger) is None:
        raise ImportError(f"--logger {args.logger} needs the package {args.logger}: pip install it")


def find_demonstrations(args: argparse.Namespace, preset: Preset) -> Demonstrations:
    """Read, download or generate the training data."""
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


def find_policies(args: argparse.Namespace, preset: Preset) -> Policies:
    """The policies of these options, trained or not; they lie beside the output folder."""
    policies = Policies(
        find_demonstrations(args, preset),
        preset,
        args.out.parent / "policies",
        args.out / "logs",
        device=args.device,
        compile=args.compile,
        logger=args.logger,
    )
    if args.task not in (None, policies.task):
        raise ValueError(
            f"{args.dataset} holds demonstrations of {policies.task}, not of {args.task}: leave "
            "--task out or correct it"
        )
    return policies


def start_comparison(
    args: argparse.Namespace, preset: Preset, priors: Sequence[Prior], nfes: Sequence[int]
) -> Comparison:
    """Check the options, store them, and get the data: everything before the first training."""
    nfes = check_nfes(nfes)
    check(args)
    check_writable(args.out)
    options = store_options(args)
    print(f"Output folder: {args.out}", flush=True)
    return Comparison(
        find_policies(args, preset),
        priors,
        nfes=nfes,
        directory=args.out,
        seeds=range(preset.seeds),
        resume=args.resume,
        options=options,
    )


def run_facts(run: Path) -> dict[str, Any]:
    """What the results of a finished run of robomimic.py tell about it."""
    path = run / "results.json"
    if not path.is_file():
        raise FileNotFoundError(f"--run {run}: it has no results.json; name a run of robomimic.py")
    meta = json.loads(path.read_text())["meta"]
    if not {"policies", "task"} <= meta.keys():
        raise ValueError(f"{path} does not say where its policies lie: run robomimic.py again")
    return meta


def finished_run(run: Path, device: str) -> tuple[dict[str, Any], dict[str, list[WarmPriorActor]]]:
    """The facts of a run of robomimic.py and its last policies, by prior one per seed."""
    meta = run_facts(run)
    entries = [(Prior.from_config(entry["prior"]), entry["folder"]) for entry in meta["policies"]]
    described = {prior.describe(): prior.name for prior, _ in entries}
    if len(set(described.values())) < len(described):
        raise ValueError(
            f"--run {run} compares {'; '.join(described)}: name a run of robomimic.py, with one sigma "
            "and one chunk length"
        )
    last = meta["training"]["iterations"]
    actors: dict[str, list[WarmPriorActor]] = {}
    for prior, name in entries:
        folder = run.resolve().parent / "policies" / name / f"policy_{last:06d}"
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{folder} is missing: finish the run with robomimic.py --resume --out {run}"
            )
        actor = WarmPriorActor.from_pretrained(folder, prior=prior, device=device)
        actors.setdefault(prior.name, []).append(actor)
    return meta, actors
