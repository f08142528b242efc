"""Policies from the command line: ``python -m warmprior evaluate FOLDER --episodes 50 --nfe 1``."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from warmprior.data import lerobot_steps
from warmprior.data.opening import LEROBOT, name_of_place
from warmprior.io.script import ERRORS, run_script
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.modules.registry import make
from warmprior.training import DataOptions, NetworkOptions, Task, TrainingConfig, load_task, train_policy
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.task import task_places


def _policy(args: argparse.Namespace) -> WarmPriorActor:
    from warmprior.training.saved import load_policy

    for module in args.modules:
        importlib.import_module(module)
    return load_policy(args.folder, revision=args.revision)


def info(args: argparse.Namespace) -> None:
    """Tell what a saved policy is."""
    from warmprior.envs.description import environment_name
    from warmprior.training.saved import policy_config, policy_file

    actor = _policy(args)
    config, count = policy_config(actor), sum(p.numel() for p in actor.parameters())
    written = policy_file(args.folder, revision=args.revision).get("warmprior", "of an unknown version")
    for name, value in {
        "prior": actor.prior,
        "start": actor.start or "the source",
        "network": f"{config['network']} ({count:,} parameters)",
        "sampler": config["actor"],
        "normaliser": "kept" if actor.normalizer is not None else "none",
        "environment": environment_name(actor) or "not kept",
        "images": (actor.environment or {}).get("images", "none"),
        "written by": f"warmprior {written}, format {config['format']}",
    }.items():
        print(f"{name:12} {value}")


def evaluate(args: argparse.Namespace) -> None:
    """Play episodes with a saved policy; no dataset is needed."""
    from warmprior.diagnostics.statistics import success_posterior
    from warmprior.envs.description import environment_of
    from warmprior.training.evaluation import evaluate as play
    from warmprior.training.film import check_video, record_filmstrip

    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {args.episodes}")
    actor = _policy(args)
    nfe = actor.ode.nfe if args.nfe is None else args.nfe
    actor.ode.check_nfe(nfe)
    if args.grid is not None:
        actor = actor.replace(grid=args.grid)
    if args.video is not None:  # known now rather than after the episodes
        check_video(args.video)
    options = {"terminate_on_success": not args.play_on}
    env = environment_of(actor, **options)
    try:
        episodes = play(
            actor,
            env,
            episodes=args.episodes,
            first_seed=args.first_seed,
            nfe=nfe,
            policy_seed=args.policy_seed,
            description=f"NFE {nfe}",
        )
    finally:
        env.close()
    wins = sum(episode.success for episode in episodes)
    low, high = success_posterior(wins, len(episodes)).interval(0.95)
    steps = sum(episode.steps for episode in episodes) / len(episodes)
    print(
        f"{wins} of {len(episodes)} episodes solved ({100 * wins / len(episodes):.1f}%; 95% of the posterior "
        f"between {100 * low:.1f}% and {100 * high:.1f}%), {steps:.0f} control steps on average"
    )
    if args.video is not None:
        film = record_filmstrip(
            actor,
            seed=args.first_seed,
            nfe=nfe,
            policy_seed=args.policy_seed,
            frames=1,
            size=256,
            video=args.video,
            **options,
        )
        print(f"{args.video}: episode {args.first_seed}, {'' if film.success else 'not '}solved")


def push(args: argparse.Namespace) -> None:
    """Send a saved policy to the Hugging Face hub, with a card that tells what is known of it."""
    from warmprior.training.card import model_card, policy_results
    from warmprior.training.saved import check_repository, push_policy

    check_repository(args.repository)
    branch, args.revision = args.revision, None  # of the repository, not of the folder
    if not Path(args.folder).is_dir():
        raise FileNotFoundError(f"no policy at {args.folder}: there is no such folder")
    actor = _policy(args)
    results = policy_results(args.run_folder, args.folder) if args.run_folder else []
    card = model_card(actor, results, repository=args.repository, licence=args.licence)
    if args.dry_run:
        print(card)
        return
    private = args.private or None
    commit = push_policy(actor, args.repository, card=card, private=private, revision=branch)
    print(f"{args.repository}: commit {commit}")


@dataclass(frozen=True)
class Train:
    """Train a policy on demonstrations, and play nothing.

    Attributes:
        data: what it is trained on.
        network: the velocity network.
        training: the recipe.
        prior: its source (gaussian, past, preview, or package.module:Class of your own); options follow as in
            past,sigma=0.3.
        chunk: chunk length H.
        observation_keys: of a LeRobotDataset of any robot: the features that policies see, in this order.
        out: folder of the trainings (default: policies); an interrupted one continues.
        device: of the network, such as cuda.
    """

    data: DataOptions
    network: NetworkOptions
    training: TrainingConfig
    prior: str = "past"
    chunk: int = 8
    observation_keys: tuple[str, ...] = ()
    out: Path | None = None
    device: str = "cpu"


def _tasks(options: Train) -> list[Task]:
    data, keys = options.data, options.observation_keys
    if not keys:
        steps = options.network.observation_steps
        return [load_task(data, *place, steps) for place in task_places(data)]
    place = str(data.dataset)
    if not place.startswith(LEROBOT):
        raise ValueError("--observation-keys belongs to --dataset lerobot:FOLDER or lerobot:USER/NAME")
    if replace(data, dataset=None, demonstrations=()) != DataOptions():
        raise ValueError("--observation-keys goes with --dataset and --demonstrations alone")
    if "action" in keys or len(set(keys)) < len(keys):
        raise ValueError(f"--observation-keys names each feature once, and not the action: {' '.join(keys)}")
    steps = lerobot_steps(place.removeprefix(LEROBOT), keys)
    if (first := data.first("ph")) is not None:
        if first > (there := len(steps["episode"].unique())):
            raise ValueError(f"--demonstrations {first}: {data.dataset} holds {there}")
        steps = steps[steps["episode"] < first]
    return [Task.of(name_of_place(place), steps)]


def train(args: argparse.Namespace) -> None:
    """Train a policy on demonstrations, and play nothing."""
    import tyro

    options = tyro.cli(
        tyro.conf.OmitArgPrefixes[Train],
        prog="python -m warmprior train",
        description=train.__doc__,
        args=args.options,
        default=Train(DataOptions(), NetworkOptions(), TrainingConfig()),
    )
    options.network.check(options.data)
    prior = make(Prior, options.prior, options.chunk)
    source = ",".join([prior.name, *options.prior.split(",")[1:]])
    for task in _tasks(options):
        name = f"{task.name}-{task.style}-{source}-seed{options.training.seed}"
        folder = (options.out or Path("policies")) / name
        train_policy(
            task,
            prior,
            folder,
            network=options.network,
            training=options.training,
            device=options.device,
            description=name,
        )
        print(policy_path(folder, options.training.iterations))


def demonstrations(args: argparse.Namespace) -> None:
    """Generate scripted demonstrations."""
    from warmprior.data import generate_demonstrations

    options = {"path": args.out, "overwrite": args.overwrite}
    print(generate_demonstrations(args.task, args.data, args.n, **options))


def render(args: argparse.Namespace) -> None:
    """Render the states of demonstrations to images; continues where it was interrupted."""
    from warmprior.data import render_demonstrations

    options = {"fast": args.fast, "out": args.out, "workers": args.workers}
    print(render_demonstrations(args.file, args.cameras, args.size, **options))


def convert(args: argparse.Namespace) -> None:
    """Write a robomimic HDF5 file as a LeRobotDataset v3."""
    from warmprior.data import convert_robomimic

    print(convert_robomimic(args.file, args.folder, images=args.images, demos=args.demonstrations))


def make_parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = argparse.ArgumentParser(prog="python -m warmprior", description=__doc__)
    written = f"warmprior {version('warmprior')}"
    parser.add_argument("--version", action="version", version=written, help="print it, and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(run: Callable[[argparse.Namespace], None]) -> Callable[..., Any]:
        added = commands.add_parser(run.__name__, help=run.__doc__, description=run.__doc__)
        added.set_defaults(run=run)
        return added.add_argument

    for run in (info, push, evaluate):
        add = command(run)
        place = "" if run is push else ", or user/name of a repository at the Hugging Face hub"
        add("folder", help=f"written by save_policy, such as .../policy_010000{place}")
        if run is push:
            add("repository", help="user/name; made if needed")
            add("--run", dest="run_folder", type=Path, help="whose results the card tells")
            add("--private", action="store_true", help="if it is made")
            add("--licence", help="of the policy, as the hub calls it, such as mit")
            add("--dry-run", action="store_true", help="print the card, and send nothing")
        add("--revision", help="branch, tag or commit of the repository (default: main)")
        add(
            "--import",
            dest="modules",
            action="append",
            default=[],
            metavar="MODULE",
            help="where your own prior, start point or network is defined; may be repeated",
        )
    from warmprior.envs.tasks import EVALUATION_SEED, TASKS

    add("--episodes", type=int, default=50, help="how many (%(default)s)")
    add("--nfe", type=int, help="network evaluations per chunk (default: the policy's)")
    add("--grid", help="uniform, dense-jump or dense-jump:TIME (default: the policy's)")
    add("--first-seed", type=int, default=EVALUATION_SEED, help="of the simulator (%(default)s)")
    add("--policy-seed", type=int, default=0, help="of the source samples (%(default)s)")
    add("--play-on", action="store_true", help="up to the time limit, also after success")
    add("--video", type=Path, help="MP4 of the first episode; needs EGL or OSMesa, and PyAV")

    # Its options are those of the recipe, --help included.
    added = commands.add_parser("train", help=train.__doc__, add_help=False, prefix_chars="\0")
    added.set_defaults(run=train)
    added.add_argument("options", nargs=argparse.REMAINDER)

    add = command(demonstrations)
    add("task", choices=[name for name, task in TASKS.items() if task.scripted])
    add("--data", default="ph", choices=("ph", "mh"), help="one or six operators (%(default)s)")
    add("--n", type=int, default=200, help="how many (%(default)s)")
    add("--out", type=Path, help="HDF5 file (default: in the cache)")
    add("--overwrite", action="store_true", help="replace the file if it is there")

    add = command(render)
    add("file", type=Path, help="robomimic HDF5 file with states")
    add("--cameras", nargs="+", help="of the simulator (default: those of the task)")
    add("--size", type=int, default=84, help="side of the images in pixels (%(default)s)")
    add("--fast", action="store_true", help="no reflections, shadows and smooth edges")
    add("--out", type=Path, help="HDF5 file, also FILE itself (default: in the cache)")
    add("--workers", type=int, help="processes (default: one per core)")

    add = command(convert)
    add("file", type=Path, help="robomimic HDF5 file, such as one of scripted demonstrations")
    add("folder", type=Path, help="to write; must not exist")
    kept = {"action": "store_const", "dest": "images"}
    add("--images", **kept, const="image", help="with those of the file, as lossless pictures")
    add("--video", **kept, const="video", help="with those of the file, as videos: lossy, smaller")
    add("--demonstrations", type=int, help="how many, from the first on (default: all)")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run a command line, without the program; the exit code. What a user can mend is said in one line."""
    args = make_parser().parse_args(argv)
    # What cannot be rendered, or generated, here is a RuntimeError.
    return run_script(lambda: args.run(args), "warmprior", errors=(*ERRORS, RuntimeError))


if __name__ == "__main__":
    sys.exit(main())
