"""The options that all benchmarks share: a dataclass per concern, and how a command line becomes one.

Every option is declared once: here, in `DataOptions` (lab/tasks.py), or in the library's `NetworkOptions` and
`TrainingConfig`.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import asdict, dataclass, field, fields, replace
from glob import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from pydantic import TypeAdapter, ValidationError

from lab.files import ERRORS
from lab.machine import check_device, facts_of_machine
from lab.methods import Method
from lab.tasks import (
    DataOptions,
    check_counts,
    check_network,
    check_place,
    is_simulated,
    resolved_place,
)
from warmprior.data.opening import name_of_place
from warmprior.io.distributed import check_batch, from_leader, launched, rank
from warmprior.io.files import check_writable, exclusive, read_json, write_atomic
from warmprior.io.script import run_script
from warmprior.modules import imagenet_weights
from warmprior.modules.ode import Sampling, check_grid
from warmprior.training import NetworkOptions, TrainingConfig
from warmprior.training.options import PAPER, PRETRAINED

Flat = tyro.conf.OmitArgPrefixes  # --episodes, not --evaluation.episodes


def check_given(options: Any, *names: str) -> None:
    """Refuse an option that takes several values and has none."""
    for name in names:
        if not getattr(options, name):
            raise ValueError(f"--{name} needs at least one value")


@dataclass(frozen=True)
class Sources:
    """The methods to compare."""

    # By name (gaussian, past, preview, forecast, history, regression, ot, bridge, reflow, step, cvae, a2a,
    # leap) or, your own, as package.module:Class, which Python has to find (PYTHONPATH); options follow as
    # in preview,correlation=0.5. Gains are over the first.
    prior: tuple[str, ...] = ("gaussian", "past", "preview")
    chunk: tuple[int, ...] = (8,)  # chunk lengths H
    sigma: tuple[float, ...] = ()  # noise of the warm priors, a policy each (default: past 0.5, preview 1.0)

    def __post_init__(self) -> None:
        check_counts(self, "chunk")
        check_given(self, "prior", "chunk")

    def methods(self) -> list[Method]:
        """All of them, chunk length by chunk length, each once."""
        found = [
            Method(text, chunk, sigma)
            for chunk in sorted(set(self.chunk))
            for text in self.prior
            for sigma in self.sigma or (None,)
        ]
        return list(dict.fromkeys(found))


@dataclass(frozen=True)
class Evaluation:
    """How policies are played."""

    seeds: int = 1  # number of training seeds, from --seed on
    episodes: int = 25  # evaluation episodes per cell
    nfe: tuple[int, ...] = (9, 3, 1)  # network evaluations per chunk
    temperature: tuple[float, ...] = (1.0,)  # factors of the source's noise at decisions: a row each
    top_k: int = 1  # best checkpoints averaged per seed
    play_on: bool = False  # go on after success, up to the time limit; success at any step counts
    grid: str = "uniform"  # uniform, or dense-jump (one last step from half way; dense-jump:0.7 from there)

    def __post_init__(self) -> None:
        check_counts(self, "seeds", "episodes", "nfe", "top_k")
        check_given(self, "nfe", "temperature")
        for temperature in self.temperature:
            Sampling(temperature=temperature)
        check_grid(self.grid)

    @property
    def environment(self) -> dict[str, Any]:
        return {"terminate_on_success": False} if self.play_on else {}


@dataclass(frozen=True)
class Run:
    """Where and how to compute."""

    # What the other options start from: quick, cpu, paper, or much-ado (the paper's with the details of the
    # public code that it may stand on); navigation1d.py has quick and paper, prior_space_rl.py quick, unit
    # and paper.
    preset: str = "quick"
    out: Path | None = None  # output folder (default: a numbered one under runs/)
    resume: bool = False  # continue in --out, or in the latest default folder, with the options stored there
    envs: int | None = None  # worker processes, with the same results (default: one per core)
    device: str = "cpu"  # of networks and data, such as cuda; under torchrun each process takes its own
    videos: bool = True  # save a video and a filmstrip of one episode per method, which takes time
    compile: bool = False  # torch.compile the network in training
    logger: Literal["csv", "tensorboard", "wandb", "none"] = "csv"  # of the training curves
    engine: Literal["local", "ray"] = "local"  # where jobs run: processes of this machine, or a Ray cluster
    ray_address: str | None = None  # HOST:PORT of its head (default: $RAY_ADDRESS, or this machine alone)

    def __post_init__(self) -> None:
        check_counts(self, "envs")
        if self.ray_address is not None and self.engine != "ray":
            raise ValueError("--ray-address belongs to --engine ray")
        if self.engine == "ray" and launched():
            raise ValueError("--engine ray distributes the work itself: start it without torchrun")
        if self.engine == "ray" and ":" in self.device:
            raise ValueError(f"--device {self.device}: with --engine ray, Ray chooses the GPU: use cuda")

    @property
    def folder(self) -> Path:
        """The output folder, which `parse` has chosen where none was given."""
        assert self.out is not None
        return self.out

    @property
    def policies(self) -> Path:
        """Where policies lie: beside the run, so that others share them."""
        return self.folder.absolute().parent / "policies"


@dataclass(frozen=True)
class Options:
    """Everything that determines a comparison of sources."""

    data: Annotated[DataOptions, Flat] = field(default_factory=DataOptions)
    network: Annotated[NetworkOptions, Flat] = field(default_factory=NetworkOptions)
    training: Annotated[TrainingConfig, Flat] = field(default_factory=TrainingConfig)
    sources: Annotated[Sources, Flat] = field(default_factory=Sources)
    evaluation: Annotated[Evaluation, Flat] = field(default_factory=Evaluation)
    run: Annotated[Run, Flat] = field(default_factory=Run)

    @property
    def name(self) -> str:
        """Of the tasks, in names of folders."""
        file = self.data.dataset
        tasks = self.data.task or ("square" if file is None else name_of_place(file),)
        space = [] if self.data.actions == "delta" else [self.data.actions]
        seen = [] if self.data.obs == "state" else [self.data.obs]
        own = [task.replace(":", "-") for task in tasks]
        return "-".join([*own, *self.data.data, *space, *seen])

    @property
    def seeds(self) -> range:
        return range(self.training.seed, self.training.seed + self.evaluation.seeds)

    def trainings(self) -> list[TrainingConfig]:
        return [self.training]

    def check(self) -> None:
        self.data.check()
        check_network(self.network, self.data)
        check_batch(self.training.batch_size)
        try:
            with torch.device("meta"):  # nothing is computed
                self.network.without_images().make(1, 1, 2)
        except ValueError as error:
            raise ValueError(f"--hidden-dim {self.network.hidden_dim}: {error}") from error
        if self.data.actions != "delta" and any(":" in task for task in self.data.task):
            raise ValueError(
                "--actions absolute belongs to robosuite's tasks, and a task of your own has its own: add "
                "--actions delta"
            )
        if self.evaluation.play_on and not all(map(is_simulated, self.data.task)):
            raise ValueError("--play-on belongs to robosuite's tasks: leave it out")
        if self.training.weighting == "standardised" and not self.network.precondition:
            raise ValueError("--no-precondition needs --weighting velocity")
        for method in self.sources.methods():
            if self.training.times == "start" and not method.is_regression:
                raise ValueError(f"--times start trains no flow: leave out {method.name}, or take regression")
            l1, distilled = self.training.objective == "l1", self.training.self_distillation > 0
            if distilled and not method.is_flow:
                raise ValueError(f"--self-distillation needs a flow: leave out {method.name}")
            if (l1 or distilled) and not method.is_straight:
                asked = "--objective l1" if l1 else "--self-distillation"
                raise ValueError(f"{asked} needs a straight path: leave out {method.name}")
            if self.data.obs == "image" and method.needs_vector:
                raise ValueError(
                    f"{method.name} reads observations that are one vector: leave it out with --obs image"
                )
            try:
                method.recipe(self.training)
            except ValueError as error:
                raise ValueError(f"leave out {method.name}, which is no flow: {error}") from error
            if method.pairs_in_batch and self.training.batch_size < 2:
                raise ValueError(f"{method.name} pairs within a batch: --batch-size must be at least 2")


# A finished run, whose policies to take instead of training them.
FinishedRun = Annotated[Path | None, tyro.conf.arg(name="run")]


@dataclass(frozen=True)
class MeasuredOptions(Options):
    """A comparison with measures on observations that no policy was trained on."""

    validation: Path | None = None  # demonstrations to measure on, given as for --dataset (default: new ones)
    observations: int = 500  # how many to measure on; the paper's curvature has 2000

    def check(self) -> None:
        super().check()
        check_single(self, "task", "data", "chunk")
        check_counts(self, "observations")
        if self.validation is not None:
            check_place(self.validation, "--validation")


def check_single(options: Options, *names: str) -> None:
    """Refuse several of what a study has one of, such as `task` or `chunk`."""
    parts = (options.data, options.sources, options.evaluation)
    for name in names:
        values = next(getattr(part, name) for part in parts if hasattr(part, name))
        if len(values) > 1:
            raise ValueError(f"this study has one --{name}, got {' '.join(map(str, values))}")


def with_parts[O](options: O, **parts: Any) -> O:
    """Options with some leaves replaced: by part, or where they are no part's."""
    made: Any = {
        part: replace(getattr(options, part), **values) if isinstance(values, Mapping) else values
        for part, values in parts.items()
    }
    return replace(options, **made)  # type: ignore[type-var]


PRESETS: dict[str, Options] = {
    # One seed, a small network and half of the training that the tables have: a first table.
    "quick": Options(data=DataOptions(demonstrations=(100,)), training=TrainingConfig(iterations=5_000)),
    # Twice the training and the episodes, three seeds.
    "cpu": Options(data=DataOptions(demonstrations=(150, 300)), evaluation=Evaluation(seeds=3, episodes=50)),
    # The paper's: 20M parameters, 200k iterations.
    "paper": Options(
        data=DataOptions(demonstrations=(200, 300)),
        network=NetworkOptions(network="chi_transformer", precondition=False),
        training=PAPER,
        evaluation=Evaluation(seeds=3, episodes=200, top_k=3),
    ),
}
# The same with the answers of the public code that the paper may stand on, Much Ado About Noising, where it
# has others (docs/notes/paper_readings.md). It clips a tenth of the loss's gradient to a norm of 10.
PRESETS["much-ado"] = with_parts(
    PRESETS["paper"],
    data={"actions": "absolute"},
    network={"observation_layers": 2, "time_frequency": 1e-4},
    training={"warmup_ratio": 0.0, "max_grad_norm": 100.0, "count_padding": True},
    evaluation={"temperature": (0.0,)},
)

# What a preset does differently where policies see images. Small images and networks, and a task that is
# solved from them: 15 minutes on two cores.
SMALL_IMAGES: dict[str, dict[str, Any]] = {
    "data": {"image_size": 48, "fast_rendering": True},
    "network": {"hidden_dim": 256, "encoder": "small", "crop_size": 42},
    "training": {"iterations": 3_000, "batch_size": 64},
}
IMAGES: dict[str, dict[str, dict[str, Any]]] = {
    "quick": {**SMALL_IMAGES, "evaluation": {"nfe": (3, 1)}},
    "cpu": SMALL_IMAGES,
    "paper": {"training": {"batch_size": 256}},
    "much-ado": {
        "data": {"actions": "delta"},  # images go with no others
        "network": {"encoder": "resnet18"},
        "training": {"batch_size": 256},
    },
}


def adapted[O: Options](preset: O, asked: Options) -> O:
    """A preset for what policies are to see.

    Where ImageNet's weights cannot be had, an encoder that would start from them starts from random ones.
    """
    if "image" not in (asked.data.obs, preset.data.obs):
        return preset
    if preset.data.obs == "state":
        changed = {part: dict(values) for part, values in IMAGES[asked.run.preset].items()}
        changed["data"] = {**changed.get("data", {}), "obs": "image"}
        if asked.run.preset == "quick" and not preset.data.task:
            changed["data"] |= {"task": ("lift",), "demonstrations": (100,)}
        preset = with_parts(preset, **changed)
    if preset.network.encoder == asked.network.encoder == PRETRAINED:
        try:
            imagenet_weights()
        except (OSError, ImportError) as error:
            print(f"{error}. The encoder starts from random weights.", flush=True)
            return with_parts(preset, network={"encoder": "resnet18"})
    return preset


def study[O: Options](kind: type[O], preset: Options, **parts: Any) -> O:
    """A preset of a study: that of the comparison, with further parts or others."""
    return kind(**vars(preset) | parts)


def parse[O: Options](
    presets: Mapping[str, O],
    argv: Sequence[str] | None,
    study: str,
    description: str | None,
    adapt: Callable[[O, O], O] = adapted,
) -> O:
    """The options of a command line, checked, with their output folder.

    They start from those of --preset, or with --resume from those stored in the folder, which the command
    line may then only repeat.
    """
    argv = sys.argv[1:] if argv is None else list(map(str, argv))
    asked = read(next(iter(presets.values())), argv, description)
    if asked.run.preset not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {asked.run.preset!r}")
    base = presets[asked.run.preset]
    known = (*argv, *base.sources.prior, *base.data.task)  # no name of a file's
    base = adapt(base, asked)
    if not asked.data.generated:  # the demonstrations of presets are numbers to generate
        base = with_parts(base, data={"demonstrations": ()})
    finished: Path | None = getattr(asked, "policies", None)
    if finished is not None:
        theirs = stored_options(Options, finished, None)
        base = with_parts(
            base,
            **{part: getattr(theirs, part) for part in ("data", "network", "training", "sources")},
            evaluation={"seeds": theirs.evaluation.seeds},
            run={"compile": theirs.run.compile},
        )
    options = read(base, argv, description)
    out = from_leader(lambda: output_folder(options, study))
    if options.run.resume:
        stored = stored_options(type(base), out, study)
        options = read(stored, argv, description)
        check_same(stored, options, f"{out} was started with other values of", "choose another --out")
    if options.run.resume or finished is not None:
        check_typed(options, finished or out, known)
    if finished is not None:
        of_run(options, finished)
    check_device(options.run.device)
    name = options.run.logger
    if name in ("tensorboard", "wandb") and find_spec(name) is None:
        raise ImportError(f"--logger {name} needs the package {name}: pip install it")
    if options.run.engine == "ray":
        from lab.ray_cluster import check_ray

        check_ray(options.run.ray_address)
    options.check()
    place = options.data.dataset
    if place is not None:  # workers on other machines have other working directories
        options = with_parts(options, data={"dataset": Path(resolved_place(place))})
    return with_parts(options, run={"out": out})


def read[O](default: O, argv: Sequence[str], description: str | None) -> O:
    """A command line, on top of defaults."""
    written = io.StringIO()
    # A line that begins with a sign stays a line of its own.
    description = re.sub(r"^(?=python |torchrun )", "$ ", description or "", flags=re.M)
    try:
        with redirect_stderr(written):
            kind: Any = type(default)
            return tyro.cli(kind, default=default, args=argv, description=description)
    except SystemExit as stop:
        # What a dataclass refuses is reported like all that we refuse; what no option is, by tyro.
        refused: Any = stop.__context__
        if isinstance(getattr(refused, "arg", None), str):
            raise ValueError(str(refused.message)) from None
        sys.stderr.write(written.getvalue())
        raise


def output_folder(options: Options, study: str) -> Path:
    """The folder to write to; never one that holds a run, unless it is to be continued."""
    out, resume = options.run.out, options.run.resume
    if out is None:
        prefix = [] if study == "robomimic" else [study]
        name = "-".join([*prefix, options.name, options.run.preset])
        taken = sorted(
            int(folder.name[len(name) + 1 :] or 1)
            for folder in Path("runs").glob(f"{escape(name)}*")
            if folder.name == name or folder.name[len(name) + 1 :].isdigit()
        )
        number = (taken or [0])[-1] + (0 if resume and taken else 1)
        out = Path("runs") / (name if number == 1 else f"{name}-{number}")
    if (out / "options.json").exists() and not resume:
        raise ValueError(f"{out} holds a run: add --resume to continue it, or choose another --out")
    return out


OF_A_START = ("out", "resume", "envs", "videos", "logger", "engine", "ray_address")
"""Options of a run that may differ each time it is started: they change no result."""


def recorded(options: Options) -> dict[str, Any]:
    """Options as JSON holds them, without those of a start."""
    # A path is that of the same file from another working directory.
    tree: dict[str, Any] = json.loads(json.dumps(asdict(options), default=resolved_place))
    for name in OF_A_START:
        del tree["run"][name]
    del tree["data"]["force_download"]
    return tree


_ABSENT = object()  # no option is this


def differences(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> Iterator[str]:
    """The options in which two records differ."""
    for name in mine.keys() | theirs.keys():
        one, two = mine.get(name, _ABSENT), theirs.get(name, _ABSENT)
        if isinstance(one, dict) and isinstance(two, dict):
            yield from differences(one, two)
        elif one != two:
            yield "--run" if name == "policies" else "--" + name.replace("_", "-")


def check_same(one: Options, two: Options, said: str, otherwise: str) -> None:
    """Refuse options that differ where a run has its own."""
    if changed := sorted(set(differences(recorded(one), recorded(two)))):
        raise ValueError(f"{said} {', '.join(changed)}: leave these out, or {otherwise}")


def of_run(options: Options, run: Path) -> Options:
    """The options of a finished run, with those of its tasks, styles, chunks and methods that are asked for.

    Whatever else determines its policies has to be as in the run.
    """
    stored = stored_options(Options, run, None)
    some: dict[str, dict[str, Any]] = {"data": {}, "sources": {"prior": options.sources.prior}}
    for part, name in (("data", "task"), ("data", "data"), ("sources", "chunk")):
        asked = getattr(getattr(options, part), name)
        if {*asked} <= {*getattr(getattr(stored, part), name)}:
            some[part][name] = asked
    stored = with_parts(stored, **some)
    theirs: Any = {part: getattr(stored, part) for part in ("data", "network", "training", "sources")}
    same = with_parts(options, **theirs, run={"compile": stored.run.compile})
    check_same(same, options, f"--run {run} has its own", "leave out --run")
    return with_parts(stored, run={"out": run})


def stored_options[O: Options](kind: type[O], out: Path, study: str | None) -> O:
    """The options of the run in a folder: of one study, or what any study shares."""
    path = out / "options.json"
    if not path.is_file():
        raise ValueError(f"there is no run in {out}: name its folder")
    stored = read_json(path)
    if not isinstance(stored, dict):
        raise ValueError(f"{path} is damaged: it is no JSON object")
    theirs = stored.get("study")
    if study not in (None, theirs):
        raise ValueError(
            f"{path} holds a run of {theirs}: continue it with that script, or choose another --out"
        )
    tree: Any = stored.get("options")
    if study is None and isinstance(tree, dict):
        tree = {part: value for part, value in tree.items() if part in {f.name for f in fields(kind)}}
    try:
        options = from_record(kind, tree)
        if changed := sorted(set(differences(recorded(options), tree))):
            raise ValueError(f"it differs in {', '.join(changed)}")
    except ValueError as error:
        reason = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            place = ".".join(map(str, ("options", *first["loc"])))
            reason = f"{place}: {first['msg'].removeprefix('Value error, ')}"
        raise ValueError(f"{path} is damaged, or of another version: {reason}") from error
    return options


def from_record[O: Options](kind: type[O], tree: Any) -> O:
    """The inverse of :func:`recorded`; a value of another type is refused."""
    return TypeAdapter(kind).validate_json(json.dumps(tree), strict=True)


def check_typed(stored: Options, out: Path, known: Sequence[str]) -> None:
    """What a file says is not imported: only what was typed, or what the script itself takes."""
    for name in (*stored.sources.prior, *stored.data.task):
        if ":" in name and name not in known:
            raise ValueError(f"{out} uses {name}: name it again, with --prior or --task as before")


def script(
    name: str, together: bool = False, hint: str = "--resume continues"
) -> Callable[[Callable[..., object]], Callable[..., int]]:
    """Make a function of a command line the `main` of a script, with errors as lines and an exit code."""
    return lambda work: (
        lambda argv=None: run_script(lambda: work(argv), name, errors=ERRORS, together=together, hint=hint)
    )


@contextmanager
def started(options: Options, study: str) -> Iterator[Path]:
    """The output folder, with the options in it, and without another process."""
    out = options.run.folder
    if rank():  # the first process is in it, for all
        yield out
        return
    check_writable(out)
    with exclusive(out):
        facts = facts_of_machine(workers=options.run.envs, device=options.run.device)
        record = {"study": study, **facts, "options": recorded(options)}
        text = json.dumps(record, indent=1) + "\n"
        write_atomic(out / "options.json", lambda path: path.write_text(text))
        print(f"Output folder: {out}", flush=True)
        try:
            yield out
        except Exception:
            if not options.run.resume and len(list(out.iterdir())) == 1:  # nothing was begun
                (out / "options.json").unlink()
            raise
