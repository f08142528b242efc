"""Options, folders and data that the benchmarks on manipulation tasks share."""

from __future__ import annotations

import argparse
import copy
import importlib.util
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

# Before torch: on a busy machine, threads that spin while they wait slow small networks thirtyfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from warmprior import Prior, WarmPriorActor
from warmprior._files import check_writable, write_atomic
from warmprior.data import (
    TASKS,
    RobomimicExperienceReplay,
    download_robomimic,
    generate_demonstrations,
    get_task,
)
from warmprior.diagnostics import SharedObservations
from warmprior.training import PRESETS, Preset
from warmprior.training.comparison import Comparison
from warmprior.training.demonstrations import Demonstrations
from warmprior.training.policies import Policies

ERRORS = (ValueError, KeyError, OSError, ImportError, FloatingPointError)
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
    add("--envs", type=int, help="parallel environments (default: the preset's, or one per core)")
    add("--iterations", type=int, help="gradient steps (default: the preset's)")
    add("--demonstrations", type=int, help="scripted demonstrations (default: the preset's)")
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


def add_curvature_options(parser: argparse.ArgumentParser, *, observations: int) -> None:
    """Add the options of measurements on held-out observations."""
    add = parser.add_argument
    add(
        "--validation",
        type=Path,
        help="robomimic HDF5 file of held-out demonstrations (default: newly generated ones)",
    )
    add(
        "--observations",
        type=int,
        default=observations,
        help="observations to measure curvature on (%(default)s; the paper: 2000)",
    )
    add("--steps", type=int, default=100, help="Euler steps (%(default)s, the paper's)")
    add("--draws", type=int, default=1, help="source samples per observation (%(default)s)")


def parse(
    make_parser: Callable[[], argparse.ArgumentParser], argv: list[str] | None, prefix: str = ""
) -> argparse.Namespace:
    """The options; those of the run to continue, where --resume is given."""
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.dataset is None and args.task is None:
        args.task = None if args.resume else "square"
    args.out = output_folder(args, prefix)
    stored = args.out / "options.json"
    if args.resume and stored.exists():
        options = json.loads(stored.read_text())
        parser = make_parser()
        types = {action.dest: action.type for action in parser._actions}
        for key, value in options.items():  # JSON knows no paths
            if types.get(key) is Path and value is not None:
                options[key] = Path(value)
        out = args.out
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
    options = {
        key: str(value.resolve()) if isinstance(value, Path) else value
        for key, value in vars(args).items()
        if key not in ("out", "resume")
    }
    text = json.dumps(options, indent=1) + "\n"
    write_atomic(args.out / "options.json", lambda path: path.write_text(text))
    return options


def make_preset(args: argparse.Namespace) -> Preset:
    """The chosen preset with the options that replace parts of it."""
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


def output_folder(args: argparse.Namespace, prefix: str = "") -> Path:
    """The folder to write to; never one that holds results, unless they are to be continued."""
    if args.out is not None:
        if (args.out / "results.json").exists() and not args.resume:
            raise ValueError(
                f"{args.out} holds a run: add --resume to continue it, or choose another --out"
            )
        return args.out
    task = args.task or (args.dataset.stem if args.dataset else "square")
    name = f"{prefix}{task}-{args.data}-{args.preset}"

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
    if min(nfes) < 1:
        raise ValueError(f"--nfe must be at least 1, got {min(nfes)}")
    check(args)
    check_writable(args.out)
    options = store_options(args)
    print(f"Output folder: {args.out}", flush=True)
    return Comparison(
        find_policies(args, preset),
        priors,
        nfes=sorted(set(nfes), reverse=True),
        directory=args.out,
        seeds=range(preset.seeds),
        resume=args.resume,
        options=options,
    )


def held_out(args: argparse.Namespace, meta: dict[str, Any]) -> tuple[Demonstrations, str]:
    """The demonstrations to measure on, and what they are in words."""
    if args.validation is not None:
        found = Demonstrations(args.validation, "file", meta["style"])
        if found.sha256 == meta["data"]["sha256"]:
            return found, "the TRAINING demonstrations (not held out)"
        return found, f"{args.validation.name}"
    if meta["data_source"] != "scripted":
        raise ValueError(
            "these policies were trained on all demonstrations of "
            f"{meta['data']['file']}: add --validation FILE with others (or with the same file, to "
            "measure on the training data)"
        )
    # About a hundred steps each; enough for any --observations in reason.
    n = max(20, -(-args.observations // 50))
    found = Demonstrations.held_out(meta["task"], meta["style"], n)
    return found, f"{n} newly generated demonstrations"


def observe(args: argparse.Namespace, path: Path, actor: WarmPriorActor) -> SharedObservations:
    """Draw the observations, normalised as the policies were trained."""
    data = RobomimicExperienceReplay(path).data.exclude("next")
    # A copy: the data are normalised on the CPU, the policy may live elsewhere.
    normalizer = copy.deepcopy(actor.normalizer).to("cpu")
    return SharedObservations(
        normalizer.normalize(data).to(args.device),
        actor.prior.chunk_length,
        observation_steps=actor.network.observation_steps,
        count=args.observations,
        generator=torch.Generator().manual_seed(0),
    )
