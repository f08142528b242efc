"""Train, evaluate and publish policies: python -m warmprior evaluate FOLDER --episodes 50 --nfe 1."""

from __future__ import annotations

import importlib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from warmprior.checks import check_device, check_whole_numbers, given
from warmprior.io.option_help import deferred, registry
from warmprior.io.script import read_command_line, run_script
from warmprior.options.agent import IMPROVE, NUM_ENVS, Algorithm
from warmprior.options.data import PLACES
from warmprior.options.defaults import EVALUATION_SEED
from warmprior.options.source import DEFAULT_PRIOR, PRIOR_OF_TARGETS, SourceOptions
from warmprior.options.train_command import Data, Evaluation, Run
from warmprior.options.training import NetworkOptions, TrainingConfig

if TYPE_CHECKING:  # commands import what they need: PyTorch takes seconds, and help does without
    from warmprior.modules.actor import WarmPriorActor

Imported = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE")]
]
"""Modules that define a policy's own parts, each after its own ``--import``."""

Policy = Annotated[str, tyro.conf.arg(metavar="FOLDER")]


def _policy(folder: str, revision: str | None, modules: Sequence[str]) -> WarmPriorActor:
    from warmprior.saving import load_policy

    for module in modules:
        importlib.import_module(module)
    return load_policy(folder, revision=revision)


def _wanted(name: str, shape: Sequence[int]) -> str:
    """Return in words what a robot has to give a policy under a name."""
    if len(shape) == 3:
        return f"{name} (any size, resized to {shape[1]} x {shape[2]})"
    return f"{name} {tuple(shape)}"


def info(folder: Policy, /, *, revision: str | None = None, modules: Imported = ()) -> None:
    """Print what a saved policy needs, does and was trained on.

    Args:
        folder: folder of the policy, such as .../policy_010000, or user/name of a repository at the
            Hugging Face hub
        revision: branch, tag or commit of the repository; by default main
        modules: module that defines your own prior, start point or network; may be repeated
    """
    from warmprior.deploy.observation import observation_shapes
    from warmprior.envs.description import environment_name
    from warmprior.modules.network import VelocityNetwork
    from warmprior.saving.policies import policy_file

    actor = _policy(folder, revision, modules)
    count, recording = sum(p.numel() for p in actor.parameters()), actor.recording
    shapes, sampling, guidance = observation_shapes(actor), actor.sampling, actor.ode.guidance
    networks = [type(part).__name__ for part in actor.network.modules() if isinstance(part, VelocityNetwork)]
    named = {} if recording is None else recording.numbers
    numbers = "; ".join(f"{name}: {', '.join(names)}" for name, names in named.items())
    spans = {} if recording is None else recording.ranges
    ranges = "; ".join(f"{name}: from {low:.4g} to {high:.4g}" for name, (low, high) in spans.items())
    file = policy_file(folder, revision=revision)
    for name, value in {
        "takes": "unknown" if shapes is None else ", ".join(map(_wanted, shapes, shapes.values())),
        **({"observations": "names not kept"} if recording is None else recording.lines("--{}")),
        **({"numbers": numbers} if numbers else {}),
        **({"ranges": ranges} if ranges else {}),
        "source": actor.prior,
        "start": actor.start or "the source",
        "NFE": f"{sampling.evaluations()}, {sampling.solver}, {sampling.grid} grid",
        **given(temperature=sampling.temperature, guidance=guidance),
        "network": f"{', '.join(networks)} ({count:,} parameters)",
        "normaliser": "none" if actor.normalizer is None else "kept: all in the units of the demonstrations",
        "environment": environment_name(actor) or "not kept",
        "written by": f"warmprior {file['warmprior']}, format {file['format']}",
    }.items():
        print(f"{name:13} {value}")


def push(
    folder: Policy,
    repository: Annotated[str, tyro.conf.arg(metavar="USER/NAME")],
    /,
    *,
    card: Path | None = None,
    private: bool = False,
    license: str | None = None,
    dry_run: bool = False,
    revision: str | None = None,
    modules: Imported = (),
) -> None:
    """Upload a saved policy to the Hugging Face hub, with a model card.

    Args:
        folder: folder of the policy, such as .../policy_010000
        repository: user/name of the repository, created if needed
        card: file with the model card, as benchmarks/card.py writes it; by default generated
        private: make the repository private if it is created
        license: licence of the policy in the hub's spelling, such as mit
        dry_run: print the card and upload nothing
        revision: branch of the repository; by default main
        modules: module that defines your own prior, start point or network; may be repeated
    """
    from warmprior.saving import model_card
    from warmprior.saving.policies import check_repository, push_policy

    check_repository(repository)
    if not Path(folder).is_dir():
        raise FileNotFoundError(f"no policy at {folder}: there is no such folder")
    actor = _policy(folder, None, modules)  # the revision is the repository's, not the folder's
    text = card.read_text() if card else model_card(actor, repository=repository, license=license)
    if dry_run:
        print(text)
        return
    commit = push_policy(actor, repository, card=text, private=private or None, revision=revision)
    print(f"{repository}: commit {commit}")


def evaluate(
    folder: Policy,
    /,
    *,
    episodes: int = 50,
    nfe: tuple[int, ...] | None = None,
    temperature: float | None = None,
    grid: str | None = None,
    first_seed: int = EVALUATION_SEED,
    policy_seed: int = 0,
    play_on: bool = False,
    video: Path | None = None,
    revision: str | None = None,
    modules: Imported = (),
) -> None:
    """Play episodes with a saved policy, without a dataset.

    Args:
        folder: folder of the policy, such as .../policy_010000, or user/name of a repository at the
            Hugging Face hub
        episodes: number of episodes
        nfe: network evaluations per chunk, one or several; by default the policy's
        temperature: factor on the noise of the source, from 0 on; by default the policy's, or 1
        grid: times of the steps: uniform, dense-jump or dense-jump:TIME; by default the policy's
        first_seed: simulator seed of the first episode
        policy_seed: seed of the source samples
        play_on: play on after success, up to the time limit
        video: MP4 file to write of the first episode; needs EGL or OSMesa, and PyAV
        revision: branch, tag or commit of the repository; by default main
        modules: module that defines your own prior, start point or network; may be repeated
    """
    from warmprior.diagnostics.statistics import success_posterior
    from warmprior.envs.description import environment_of
    from warmprior.evaluation.episodes import evaluate as play
    from warmprior.evaluation.video import check_video, record_filmstrip

    check_whole_numbers(**{"--episodes": episodes})
    if nfe == ():
        raise ValueError("--nfe needs a number of network evaluations, or several")
    actor = _policy(folder, revision, modules)
    nfes = [actor.sampling.evaluations(n) for n in (nfe or [None])]
    actor = actor.replace(**given(temperature=temperature, grid=grid))
    if video is not None:  # before the episodes are played
        check_video(video, actor)
    options = {"terminate_on_success": not play_on}
    env = environment_of(actor, **options)
    try:
        for n in nfes:
            played = play(
                actor,
                env,
                episodes=episodes,
                first_seed=first_seed,
                nfe=n,
                policy_seed=policy_seed,
                description=f"NFE {n}",
            )
            wins = sum(episode.success for episode in played)
            low, high = success_posterior(wins, len(played)).interval(0.95)
            steps = sum(episode.steps for episode in played) / len(played)
            print(
                f"NFE {n}: {wins} of {len(played)} episodes solved ({wins / len(played):.1%}; 95% of the "
                f"posterior between {low:.1%} and {high:.1%}), {steps:.0f} control steps on average"
            )
    finally:
        env.close()
    if video is not None:
        filmed = record_filmstrip(
            actor,
            seed=first_seed,
            nfe=nfes[-1],
            policy_seed=policy_seed,
            frames=1,
            size=256,
            video=video,
            **options,
        )
        print(f"{video}: episode {first_seed}, {'' if filmed.success else 'not '}solved")


def improve(
    folder: Policy,
    /,
    *,
    steps: int = IMPROVE.environment_steps,
    algorithm: Algorithm = "dsrl-na",
    delta: float | None = None,
    residual_length: int | None = None,
    nfe: int | None = None,
    num_envs: int = NUM_ENVS,
    compile: bool = False,
    episodes: int = 100,
    seed: int = 0,
    out: Path = Path("improved"),
    revision: str | None = None,
    modules: Imported = (),
) -> None:
    """Improve a saved policy by reinforcement learning in its source space; it must solve some episodes.

    Args:
        folder: folder of the policy, such as .../policy_010000, or user/name of a repository at the
            Hugging Face hub
        steps: control steps to learn from
        algorithm: algorithm of the agent
        delta: half the side of the agent's box; by default 0.5 around a warm mean, and 1.5 around zero
        residual_length: residuals per chunk, each held for several actions; by default one per action
        nfe: network evaluations per chunk; by default the policy's
        num_envs: simulators in worker processes
        compile: compile the agent's updates, for twice the speed; needs a C++ compiler
        episodes: episodes that compare the policies before and after
        seed: seed of all random draws
        out: folder of trainings, in which an interrupted one continues
        revision: branch, tag or commit of the repository; by default main
        modules: module that defines your own prior, start point or network; may be repeated
    """
    from warmprior.rl.agent import delta_of
    from warmprior.rl.improve import improve_policy
    from warmprior.saving.policies import save_policy

    actor = _policy(folder, revision, modules)
    warmup = min(IMPROVE.warmup_steps, steps)
    config = replace(
        IMPROVE,
        algorithm=algorithm,
        environment_steps=steps,
        warmup_steps=warmup,
        evaluate_every=max(1, steps // 10),
        nfe=actor.sampling.evaluations(nfe),
        delta=delta,
        residual_length=residual_length,
        seed=seed,
    )
    print(
        f"{algorithm} around a box of +-{delta_of(config, actor):g}: {steps:,} control steps, the first "
        f"{warmup:,} without an agent; {config.updates} updates per step of {num_envs} simulators, discount "
        f"{config.gamma:g} per chunk, NFE {config.nfe}",
        flush=True,
    )
    whole = Path(folder).resolve()
    place = out / f"{whole.parent.name}-{whole.name}-{algorithm}-seed{seed}"
    options: Any = {"num_envs": num_envs, "config": config, "compile": compile, "episodes": episodes}
    result = improve_policy(actor, place, **options)
    save_policy(result.policy, place / "policy")
    words = (
        "no agent was better, so the policy is as it was; residuals move its actions, which are between -1 "
        f"and 1, by {result.reach:.2f}"
    )
    if result.improved:
        words = f"solved of {episodes} other episodes: {result.before} before, {result.after} after"
    print(f"{words}\nto evaluate it: {command_of('evaluate', place / 'policy')}")


def command_of(command: str, folder: Path) -> str:
    """Return the line of a shell that runs a command on a policy."""
    return f"python -m warmprior {command} {shlex.quote(str(folder))}"


def train(
    place: Annotated[str, tyro.conf.arg(metavar="PLACE")],
    /,
    *,
    data: Data,
    source: SourceOptions,
    training: TrainingConfig,
    evaluation: Evaluation,
    run: Run,
    network: NetworkOptions,
) -> None:
    """Train a policy on demonstrations, without playing episodes.

    $ python -m warmprior train square.hdf5 --iterations 20000
    $ python -m warmprior train lerobot:USER/NAME --images observation.images.front

    Args:
        place: {PLACES}
        data: options of the demonstrations
        source: options of the source
        training: options of the recipe
        evaluation: options of the evaluation
        run: options of the computation, and of what it writes
        network: options of the velocity network
    """
    from warmprior.data import open_demonstrations
    from warmprior.diagnostics.held_out import held_out_errors
    from warmprior.envs.description import is_registered
    from warmprior.modules.prior import Prior
    from warmprior.modules.sampling import Sampling
    from warmprior.tasks import Play, Task
    from warmprior.training import train_policy
    from warmprior.training.cloning import policy_path
    from warmprior.training.networks import check_network
    from warmprior.training.option_text import make

    check_device(run.device)  # before the demonstrations are read
    check_network(network)
    make(Prior, source.prior or DEFAULT_PRIOR, source.chunk)
    sampling = Sampling(nfe=evaluation.nfe, max_nfe=1 if training.times == "start" else None)
    demonstrations = open_demonstrations(
        place,
        demos=data.demonstrations,
        mask=data.mask,
        style=data.style,
        task=data.task,
        image_size=data.image_size,
        resize=data.resize,
    )
    whole = Task(
        demonstrations,
        observations=data.observations,
        images=data.images,
        joints=data.joints,
        actions=data.actions,
        play=Play(horizon=data.horizon, fast_rendering=data.fast_rendering),
    )
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
    held_out = evaluation.held_out
    if held_out is None:
        held_out = min(count - 1, max(1, count // 10)) if whole.environment is None else 0
    task, left_out = whole.split(held_out)
    text = source.prior or (DEFAULT_PRIOR if task.rest is None else PRIOR_OF_TARGETS)
    prior, options = make(Prior, text, source.chunk), text.split(",")[1:]
    print(f"{task.recording.text('--{}')}\n{'source':13} {text} (--prior)", flush=True)
    name = f"{task.name}-{task.style}-{','.join([prior.name, *options])}-seed{training.seed}"
    actor = train_policy(
        task,
        prior,
        run.out / name,
        nfe=sampling.evaluations(),
        max_nfe=sampling.max_nfe,
        network=network,
        training=training,
        device=run.device,
        compile=run.compile,
        description=name,
    )
    saved = policy_path(run.out / name, training.iterations)
    nfes = (1, 3, 9) if sampling.max_nfe is None else (1,)
    if left_out is not None:
        number = count - task.facts["demonstrations"]
        print(
            f"mean squared error of normalised actions (from -1 to 1) on held-out demonstrations ({number}, "
            f"{len(left_out):,} steps):"
        )
        mean = task.data["action"].mean(0)
        errors, others = held_out_errors(actor, left_out, (*nfes, sampling.evaluations()), mean, task.rest)
        for name, error in {**{f"NFE {n}": error for n, error in errors.items()}, **others}.items():
            print(f"  {name}: {error:.4f}")
        if min(errors.values()) >= (least := min(others.values())):
            print(f"no error is below {least:.4f}: train for longer (--iterations), or check the data")
    elif whole.environment is None:
        print("no demonstration is held out, so no error is measured")
    if playable:
        print(f"to evaluate it: {command_of('evaluate', saved)} --nfe {' '.join(map(str, nfes[::-1]))}")
    else:
        print(f"what a robot has to give it: {command_of('info', saved)}; its loop: docs/your_robot.md")
    print(saved)


train.__doc__ = str(train.__doc__).format(PLACES=PLACES)


def export(
    folder: Policy,
    file: Path,
    /,
    *,
    nfe: int | None = None,
    revision: str | None = None,
    modules: Imported = (),
) -> None:
    """Compile a saved policy's whole decision for this machine, for a control loop on a small computer.

    Args:
        folder: folder of the policy, such as .../policy_010000, or user/name of a repository at the
            Hugging Face hub
        file: file to write, such as policy.pt2, with a JSON file beside it
        nfe: network evaluations per chunk; by default the policy's own
        revision: branch, tag or commit of the repository; by default main
        modules: module that defines your own prior or network; may be repeated
    """
    from warmprior.deploy import export_policy

    path = export_policy(_policy(folder, revision, modules), file, nfe=nfe)
    print(f"{path}: on this machine, AsyncExecutor(load_exported({str(path)!r})) runs it")


def convert(
    file: Path,
    folder: Path,
    /,
    *,
    images: Literal["image", "video"] | None = None,
    observations: tuple[str, ...] | None = None,
    demonstrations: int | None = None,
) -> None:
    """Write a robomimic HDF5 file as a LeRobotDataset v3.

    Args:
        file: robomimic HDF5 file
        folder: folder to write, which must not exist
        images: include the file's images as lossless pictures (image), or as lossy, smaller videos (video)
        observations: observations to write; by default the task's
        demonstrations: number of demonstrations, from the first on; by default all
    """
    from warmprior.data import convert_robomimic

    print(convert_robomimic(file, folder, images=images, observations=observations, demos=demonstrations))


def observe(file: Path, out: Path, /, *, demonstrations: int | None = None) -> None:
    """Replay raw recordings of robosuite, and write a robomimic file with observations.

    Args:
        file: recording, such as demo.hdf5 of robosuite's collect_human_demonstrations
        out: robomimic HDF5 file to write, which must not exist
        demonstrations: number of demonstrations, from the first on; by default all
    """
    from warmprior.data import observe_recordings

    print(observe_recordings(file, out, demos=demonstrations))


COMMANDS = (train, evaluate, info, improve, export, push, convert, observe)


def main(argv: Sequence[str] | None = None) -> int:
    """Run command-line arguments, and return the exit code. User errors are reported in one line."""
    argv = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if argv[0] == "--version":
        print(f"warmprior {version('warmprior')}")
        return 0

    def run() -> None:
        parsed: Any = read_command_line(
            partial(
                tyro.extras.subcommand_cli_from_dict,
                {command.__name__: deferred(command) for command in COMMANDS},
                prog="python -m warmprior",
                description=f"{__doc__}\n\nOptions of a command: COMMAND --help. The version: --version.",
                args=argv,
                registry=registry,
                config=(tyro.conf.OmitArgPrefixes,),  # --iterations, not --training.iterations
            )
        )
        from warmprior.saving.training_state import AnotherRunError

        try:
            parsed()
        except AnotherRunError as error:
            raise ValueError(f"{error} (--out)") from error

    return run_script(run, "warmprior")


if __name__ == "__main__":
    sys.exit(main())
