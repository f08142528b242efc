"""Train, evaluate and publish policies: python -m warmprior evaluate FOLDER --episodes 50 --nfe 1."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase

from warmprior.checks import check_whole_numbers
from warmprior.io.script import run_script
from warmprior.keys import FRAME
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.ode import DEFAULT_NFE
from warmprior.modules.option_text import make
from warmprior.modules.prior import Prior
from warmprior.training import NetworkOptions, Task, TrainingConfig, train_policy
from warmprior.training.behaviour_cloning import policy_path
from warmprior.transforms.window import window_transforms


def _policy(args: argparse.Namespace) -> WarmPriorActor:
    from warmprior.training.saved import load_policy

    for module in args.modules:
        importlib.import_module(module)
    return load_policy(args.folder, revision=args.revision)


def info(args: argparse.Namespace) -> None:
    """Print a summary of a saved policy."""
    from warmprior.deploy.observation import observation_shapes
    from warmprior.envs.description import environment_name
    from warmprior.training.saved import policy_config, policy_file

    actor = _policy(args)
    config, count = policy_config(actor), sum(p.numel() for p in actor.parameters())
    shapes = observation_shapes(actor)
    written = policy_file(args.folder, revision=args.revision).get("warmprior", "of an unknown version")
    for name, value in {
        "prior": actor.prior,
        "start": actor.start or "the source",
        "network": f"{config['network']} ({count:,} parameters)",
        "sampler": config["actor"],
        "normaliser": "kept" if actor.normalizer is not None else "none",
        "environment": environment_name(actor) or "not kept",
        "observation": "unknown" if shapes is None else ", ".join(f"{k} {v}" for k, v in shapes.items()),
        "written by": f"warmprior {written}, format {config['format']}",
    }.items():
        print(f"{name:12} {value}")


def evaluate(args: argparse.Namespace) -> None:
    """Play episodes with a saved policy, without a dataset."""
    from warmprior.diagnostics.statistics import success_posterior
    from warmprior.envs.description import environment_of
    from warmprior.training.evaluation import evaluate as play
    from warmprior.training.video import check_video, record_filmstrip

    check_whole_numbers(**{"--episodes": args.episodes})
    actor = _policy(args)
    nfes = [actor.sampling.evaluations(nfe) for nfe in args.nfe or [None]]
    if args.grid is not None:
        actor = actor.replace(grid=args.grid)
    if args.video is not None:  # before the episodes are played
        check_video(args.video, actor)
    options = {"terminate_on_success": not args.play_on}
    env = environment_of(actor, **options)
    try:
        for nfe in nfes:
            episodes = play(
                actor,
                env,
                episodes=args.episodes,
                first_seed=args.first_seed,
                nfe=nfe,
                policy_seed=args.policy_seed,
                description=f"NFE {nfe}",
            )
            wins = sum(episode.success for episode in episodes)
            low, high = success_posterior(wins, len(episodes)).interval(0.95)
            steps = sum(episode.steps for episode in episodes) / len(episodes)
            print(
                f"NFE {nfe}: {wins} of {len(episodes)} episodes solved ({100 * wins / len(episodes):.1f}%; "
                f"95% of the posterior between {100 * low:.1f}% and {100 * high:.1f}%), {steps:.0f} control "
                "steps on average"
            )
    finally:
        env.close()
    if args.video is not None:
        video = record_filmstrip(
            actor,
            seed=args.first_seed,
            nfe=nfes[-1],
            policy_seed=args.policy_seed,
            frames=1,
            size=256,
            video=args.video,
            **options,
        )
        print(f"{args.video}: episode {args.first_seed}, {'' if video.success else 'not '}solved")


def push(args: argparse.Namespace) -> None:
    """Upload a saved policy to the Hugging Face hub, with a model card."""
    from warmprior.training.card import model_card
    from warmprior.training.saved import check_repository, push_policy

    check_repository(args.repository)
    branch, args.revision = args.revision, None  # the revision is the repository's, not the folder's
    if not Path(args.folder).is_dir():
        raise FileNotFoundError(f"no policy at {args.folder}: there is no such folder")
    actor = _policy(args)
    card = (
        args.card.read_text()
        if args.card
        else model_card(actor, repository=args.repository, licence=args.licence)
    )
    if args.dry_run:
        print(card)
        return
    private = args.private or None
    commit = push_policy(actor, args.repository, card=card, private=private, revision=branch)
    print(f"{args.repository}: commit {commit}")


@dataclass(frozen=True)
class Data:
    """The options of :meth:`Task.open`.

    Attributes:
        observation_keys: observations of the policy, in this order (default: the task's)
        joint_key: observation of the joint positions that absolute actions target, such as
            observation.state
        image_keys: images of the policy, in addition to the robot's state, such as agentview_image
        fast_rendering: render robosuite's images without reflections, shadows and smooth edges
        actions: actions of the policy: as recorded, or the absolute poses that robosuite's deltas target
        mask: mask of the file, such as train, whose demonstrations to use (default: all)
        demonstrations: number of demonstrations, from the first on (default: all)
        task: task of robosuite, for a LeRobotDataset that does not describe its environment
        style: style of the demonstrations, which decides robosuite's time limit (default: ph, and human
            outside robosuite)
        horizon: control steps per episode (default: the environment's own, or robosuite's for the style)
    """

    observation_keys: tuple[str, ...] | None = None
    joint_key: str | None = None
    image_keys: tuple[str, ...] = ()
    fast_rendering: bool = False
    actions: Literal["delta", "absolute"] = "delta"
    mask: str | None = None
    demonstrations: int | None = None
    task: str | None = None
    style: str | None = None
    horizon: int | None = None


@dataclass(frozen=True)
class Train:
    """Train a policy on demonstrations: python -m warmprior train PLACE [OPTIONS].

    PLACE is a robomimic HDF5 file, lerobot:FOLDER or lerobot:USER/NAME of a LeRobotDataset, or minari:NAME.

    Attributes:
        network: options of the velocity network
        training: options of the recipe
        data: options of the demonstrations
        prior: source (gaussian, past, preview, or package.module:Class of your own), with options as in
            past,sigma=0.3
        chunk: chunk length H
        nfe: network evaluations per chunk, saved with the policy
        held_out: number of last demonstrations to leave out for measuring the error of actions (default: a
            tenth if no environment is known, else none)
        out: folder of training runs, in which an interrupted one continues (default: policies)
        device: device of the network, such as cuda
    """

    network: NetworkOptions
    training: TrainingConfig
    data: Data
    prior: str = "past,correlation=0.5"
    chunk: int = 8
    nfe: int = DEFAULT_NFE
    held_out: int | None = None
    out: Path | None = None
    device: str = "cpu"


def train(args: argparse.Namespace) -> None:
    """Train a policy on demonstrations, without playing episodes."""
    import tyro

    from warmprior.envs.description import is_registered

    place, *rest = args.options or [""]
    if not place or place.startswith("-"):
        place, rest = "", args.options
    options = tyro.cli(
        tyro.conf.OmitArgPrefixes[Train],
        prog="python -m warmprior train PLACE",
        args=rest,
        default=Train(NetworkOptions(), TrainingConfig(), Data()),
    )
    prior = make(Prior, options.prior, options.chunk)
    if not place:
        raise ValueError(
            "name the demonstrations first: train FILE.hdf5, lerobot:FOLDER, lerobot:USER/NAME or minari:NAME"
        )
    chosen, steps = asdict(options.data), options.network.observation_steps
    whole = Task.open(place, observation_steps=steps, demos=chosen.pop("demonstrations"), **chosen)
    recorded: Any = whole.environment
    playable = recorded is not None
    if is_registered(recorded) and recorded["gymnasium"]["success"] is None:
        print("its environment does not say when the task is solved, so the policy is only trained")
        playable = False
    elif playable:
        try:
            whole.check_environment()  # an error is better raised before the training
        except ImportError as missing:
            print(f"no episodes can be played here, so the policy is only trained: {missing}")
    count = whole.facts["demonstrations"]
    tenth = count // 10 if whole.environment is None else 0
    task, left_out = whole.split(tenth if options.held_out is None else options.held_out)
    source = ",".join([prior.name, *options.prior.split(",")[1:]])
    name = f"{task.name}-{task.style}-{source}-seed{options.training.seed}"
    folder = (options.out or Path("policies")) / name
    actor = train_policy(
        task,
        prior,
        folder,
        nfe=options.nfe,
        network=options.network,
        training=options.training,
        device=options.device,
        description=name,
    )
    saved = policy_path(folder, options.training.iterations)
    if left_out is not None:
        spread = float(left_out["action"].var(0, correction=0).mean())
        number = count - task.facts["demonstrations"]
        print(
            f"mean squared error of normalised actions (from -1 to 1) on held-out demonstrations ({number}); "
            f"the mean action has {spread:.4f}:"
        )
        for nfe, error in errors_of(actor, left_out, steps, (1, 3, 9, options.nfe)).items():
            print(f"  NFE {nfe}: {error:.4f}")
    if playable:
        print(f"to play it: python -m warmprior evaluate {saved} --nfe 9 3 1")
    print(saved)


def errors_of(
    actor: WarmPriorActor, data: TensorDictBase, observation_steps: int, nfes: Sequence[int]
) -> dict[int, float]:
    """Return the errors of actions on up to 4,096 windows of held-out normalised steps, by NFE."""
    from warmprior.diagnostics import action_error, encoded_windows

    windows = window_transforms(data, actor.prior, observation_steps=observation_steps)
    frames = torch.linspace(0, len(data) - 1, min(len(data), 4096)).round().long()
    batch = encoded_windows(actor, windows(TensorDict({FRAME: frames}, [len(frames)])))
    return action_error(actor, batch, nfes=nfes)


def convert(args: argparse.Namespace) -> None:
    """Write a robomimic HDF5 file as a LeRobotDataset v3."""
    from warmprior.data import convert_robomimic

    chosen = {"demos": args.demonstrations, "observation_keys": args.observation_keys}
    print(convert_robomimic(args.file, args.folder, images=args.images, **chosen))


def observe(args: argparse.Namespace) -> None:
    """Replay raw recordings of robosuite, and write a robomimic file with observations."""
    from warmprior.data import observe_recordings

    print(observe_recordings(args.file, args.out, demos=args.demonstrations))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the commands and their options."""
    parser = argparse.ArgumentParser(prog="python -m warmprior", description=__doc__)
    written = f"warmprior {version('warmprior')}"
    parser.add_argument("--version", action="version", version=written, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(run: Callable[[argparse.Namespace], None]) -> Callable[..., Any]:
        added = commands.add_parser(run.__name__, help=run.__doc__, description=run.__doc__)
        added.set_defaults(run=run)
        return added.add_argument

    for run in (info, push, evaluate):
        add = command(run)
        place = "" if run is push else ", or user/name of a repository at the Hugging Face hub"
        add("folder", help=f"folder of the saved policy, such as .../policy_010000{place}")
        if run is push:
            add("repository", help="user/name of the repository, created if needed")
            add(
                "--card",
                type=Path,
                help="file with the model card, as benchmarks/card.py writes it (default: generated)",
            )
            add("--private", action="store_true", help="make the repository private if it is created")
            add("--licence", help="licence of the policy in the hub's spelling, such as mit")
            add("--dry-run", action="store_true", help="print the card and upload nothing")
        add("--revision", help="branch, tag or commit of the repository (default: main)")
        add(
            "--import",
            dest="modules",
            action="append",
            default=[],
            metavar="MODULE",
            help="module that defines your own prior, start point or network; may be repeated",
        )
    from warmprior.envs.tasks import EVALUATION_SEED

    add("--episodes", type=int, default=50, help="number of episodes (default: %(default)s)")
    add(
        "--nfe",
        type=int,
        nargs="+",
        help="network evaluations per chunk, one or several values (default: the policy's)",
    )
    add("--grid", help="times of the steps: uniform, dense-jump or dense-jump:TIME (default: the policy's)")
    add(
        "--first-seed",
        type=int,
        default=EVALUATION_SEED,
        help="simulator seed of the first episode (default: %(default)s)",
    )
    add("--policy-seed", type=int, default=0, help="seed of the source samples (default: %(default)s)")
    add("--play-on", action="store_true", help="play on after success, up to the time limit")
    add("--video", type=Path, help="MP4 file to write of the first episode; needs EGL or OSMesa, and PyAV")

    # tyro parses the options of train, --help included.
    added = commands.add_parser("train", help=train.__doc__, add_help=False, prefix_chars="\0")
    added.set_defaults(run=train)
    added.add_argument("options", nargs=argparse.REMAINDER)

    add = command(convert)
    add("file", type=Path, help="robomimic HDF5 file")
    add("folder", type=Path, help="folder to write, which must not exist")
    kept = {"action": "store_const", "dest": "images"}
    add("--images", **kept, const="image", help="include the file's images as lossless pictures")
    add(
        "--video",
        **kept,
        const="video",
        help="include the file's images as lossy, smaller videos",
    )
    add("--observation-keys", nargs="+", help="observations to write (default: the task's)")
    add("--demonstrations", type=int, help="number of demonstrations, from the first on (default: all)")

    add = command(observe)
    add("file", type=Path, help="recording, such as demo.hdf5 of robosuite's collect_human_demonstrations")
    add("out", type=Path, help="robomimic HDF5 file to write, which must not exist")
    add("--demonstrations", type=int, help="number of demonstrations, from the first on (default: all)")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run command-line arguments, and return the exit code. User errors are reported in one line."""
    args = make_parser().parse_args(argv)
    return run_script(lambda: args.run(args), "warmprior")


if __name__ == "__main__":
    sys.exit(main())
