"""Tasks of the benchmarks, and where their demonstrations come from."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tensordict import TensorDictBase

from lab.downloads import OFFICIAL, download_robomimic
from lab.render import render_demonstrations
from lab.scripted.generate import generate_demonstrations
from lab.scripted.tasks import EXPERTS
from warmprior.checks import check_whole_numbers
from warmprior.data.images import renderer_versions
from warmprior.data.lerobot_index import is_remote
from warmprior.data.opening import LEROBOT, MINARI, dataset_name
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.navigation1d import OCTAVES, NavigationEnv, navigation_demonstrations
from warmprior.envs.rendering import require_rendering
from warmprior.envs.tasks import TASKS, get_task
from warmprior.io.extras import require
from warmprior.io.files import digest_of
from warmprior.keys import EPISODE
from warmprior.modules.encoder import imagenet_weights
from warmprior.training import NetworkOptions, Task
from warmprior.training.files import image_names, opened, read_steps, task_name
from warmprior.training.options import PRETRAINED

GENERATED = 150
"""Scripted demonstrations, where no other number is asked for."""


MOST = 10_000_000
"""No count may be larger: more could neither be listed nor done."""


def is_simulated(task: str) -> bool:
    """Whether a task is one of robosuite: not the toy, and not one of a user's own."""
    return task != "navigation" and ":" not in task


def check_counts(options: Any, *names: str) -> None:
    """Refuse options of a dataclass that are no whole numbers from 1 to MOST; ``None`` is fine."""
    for name in names:
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        for count in value if isinstance(value, tuple) else (value,):
            if count is not None:
                check_whole_numbers(**{option: count})
                if count > MOST:
                    raise ValueError(f"{option} must be at most {MOST:,}, got {count}")


def check_place(place: str | Path, option: str) -> None:
    """Refuse a place where there can be no demonstrations; nothing is read or fetched.

    A place is an HDF5 file, ``lerobot:`` and a folder or repository, or ``minari:`` and a name; errors name
    it by the option.

    Examples:
        >>> from lab.tasks import check_place
        >>> check_place("lerobot:user/square", "--dataset")
        >>> check_place("lerobot:./square", "--dataset")
        Traceback (most recent call last):
            ...
        FileNotFoundError: --dataset lerobot:./square: no such folder, and no repository user/name of the hub
    """
    if dataset_name(place, MINARI) is not None:
        require("minari", "minari")
        return
    dataset = dataset_name(place, LEROBOT)
    if dataset is None:
        if not Path(place).is_file():
            folder = (Path(place) / "meta" / "info.json").is_file()
            hint = f"; for a LeRobotDataset write {LEROBOT}{place}" if folder else ""
            raise FileNotFoundError(f"{option} {place}: no such file{hint}")
        return
    require("lerobot.datasets", "lerobot")
    if not is_remote(dataset) and not Path(dataset).expanduser().is_dir():
        raise FileNotFoundError(f"{option} {place}: no such folder, and no repository user/name of the hub")


def resolved_place(place: Path) -> str:
    """The same place as seen from any working directory."""
    if dataset_name(place, MINARI) is not None:
        return str(place)
    dataset = dataset_name(place, LEROBOT)
    if dataset is None:
        return str(place.resolve())
    return str(place) if is_remote(dataset) else f"{LEROBOT}{Path(dataset).expanduser().resolve()}"


@dataclass(frozen=True)
class DataOptions:
    """What policies are trained on.

    Attributes:
        task: manipulation tasks (default: square, or the dataset's); or one of your own, as
            package.module:function, which is given these options and returns a Task.
        data: ph (one operator) or mh (six operators); of MimicGen's files source (human) or core (made of
            the source).
        dataset: a robomimic HDF5 file, a LeRobotDataset (lerobot:FOLDER, or lerobot:USER/NAME of the hub), or
            a Minari dataset (minari:NAME). Instead of generated data.
        download: fetch the official files from the hub instead.
        force_download: fetch them again, in place of a broken local copy.
        mask: name of a mask in the file, such as train; only its demonstrations are used.
        time_limit: control steps per episode (default: the environment's own, or robosuite's for ph or mh).
        demonstrations: how many to generate, or to take of a file from its first on (default: all of it); two
            numbers for ph and mh.
        actions: what policies predict: pose deltas as recorded, or the absolute poses that they ask for.
        obs: what policies see: the state of robot and objects, or that of the robot and images.
        cameras: of the images; by default the task's two, or four with two arms.
        image_size: side of the images in pixels.
        fast_rendering: render without reflections, shadows and smooth edges, three to five times faster.

    Examples:
        >>> from lab.tasks import DataOptions
        >>> options = DataOptions(data=("ph", "mh"), demonstrations=(20, 60))
        >>> options.count("ph"), options.count("mh"), options.generated
        (20, 60, True)
    """

    task: tuple[str, ...] = ()
    data: tuple[Literal["ph", "mh", "source", "core"], ...] = ("ph",)
    dataset: Path | None = None
    download: bool = False
    force_download: bool = False
    mask: str | None = None
    time_limit: int | None = None
    demonstrations: tuple[int, ...] = ()
    actions: Literal["delta", "absolute"] = "delta"
    obs: Literal["state", "image"] = "state"
    cameras: tuple[str, ...] = ()
    image_size: int = 84
    fast_rendering: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "demonstrations", "image_size", "time_limit")
        if len(self.demonstrations) > 2:
            raise ValueError(
                f"--demonstrations takes one number, or one for ph and one for mh, got {self.demonstrations}"
            )

    def check(self) -> None:
        """Refuse options that cannot work, naming them, before anything is generated or downloaded.

        Raises:
            ValueError: for options that contradict each other.
            FileNotFoundError: if the file does not exist.
            ImportError: if MimicGen's data are to be fetched without its package, which plays its tasks.
        """
        if self.force_download and not self.download:
            raise ValueError("--force-download belongs to --download")
        if self.mask is not None and self.generated:
            raise ValueError("--mask is that of a file: add --download, or --dataset FILE")
        if self.obs == "image":
            try:
                require_rendering()
            except RuntimeError as error:
                raise ValueError(f"--obs image needs the simulator's images: {error}") from error
            if self.actions == "absolute":
                raise ValueError("--obs image goes with --actions delta, as in the paper")
            if len(set(self.cameras)) < len(self.cameras):
                raise ValueError(f"--cameras names one twice: {' '.join(self.cameras)}")
        elif self.cameras or self.fast_rendering:
            raise ValueError("--cameras and --fast-rendering belong to --obs image")
        if self.dataset is not None:
            if self.download:
                raise ValueError("--dataset reads a file: leave out --download")
            if len(self.task) > 1 or len(self.data) > 1:
                raise ValueError("--dataset is of one task and style: name at most one --task and --data")
            if len(self.demonstrations) > 1:
                raise ValueError(
                    f"--demonstrations takes one number with --dataset, got {self.demonstrations}"
                )
            check_place(self.dataset, "--dataset")
        for task in filter(is_simulated, self.task):
            get_task(task)
            if self.generated and task not in EXPERTS:
                raise ValueError(
                    f"there is no scripted expert for {task}: add --download for the official data, or "
                    "--dataset FILE"
                )
            if self.download and is_mimicgen(get_task(task).env_name):
                find_mimicgen()
        for style in self.data if self.generated else ():
            if style not in ("ph", "mh"):
                raise ValueError(
                    f"--data {style} is that of MimicGen's files: add --download, or --dataset FILE"
                )

    @property
    def generated(self) -> bool:
        """Whether scripted experts make the data."""
        return self.dataset is None and not self.download

    def first(self, style: str) -> int | None:
        """Demonstrations to take of a file of a style; ``None`` for all of it."""
        return self.demonstrations[-1 if style == "mh" else 0] if self.demonstrations else None

    def count(self, style: str) -> int:
        """Scripted demonstrations of a style."""
        return self.first(style) or GENERATED


def check_network(network: NetworkOptions, data: DataOptions) -> None:
    """Refuse options of images that cannot work, or have no effect, and weights that cannot be had."""
    if data.obs == "state":
        usual = network.without_images() == network or network.encoder == "resnet18"
        if not usual or data.image_size != DataOptions().image_size:
            raise ValueError("--image-size, --crop-size, --share-encoder and --encoder belong to --obs image")
        return
    if not 8 <= network.crop_size <= data.image_size:
        raise ValueError(
            f"--crop-size {network.crop_size} must be at least 8 and at most --image-size {data.image_size}"
        )
    if network.encoder == PRETRAINED:
        imagenet_weights()
    elif network.encoder != "small":
        require("torchvision", "vision")


def robosuite_task(
    path: Path | str, style: str, *, source: str, observation_steps: int, options: DataOptions
) -> Task:
    """The task of a file of demonstrations, made as ``source`` says: scripted, official or file."""
    # A generated file has as many as were asked for, and what is no file given is of the task asked for.
    demos = None if source == "scripted" else options.first(style)
    named = next(iter(options.task), None) if source == "file" else None
    seen: dict[str, Any] = {}
    place = path
    if options.obs == "image":
        index = opened(path, named, options.mask).index(demos=demos)
        cameras = options.cameras or (index.task.cameras if index.task else index.cameras)
        if not cameras:
            raise ValueError(f"{path} has no images, and its task is unknown: name --cameras")
        size, fast = options.image_size, options.fast_rendering
        place = with_images(path, named, cameras, size, fast, demos=demos, mask=options.mask)
        seen = {"image_keys": image_names(cameras), "fast_rendering": fast}
    task = Task.open(
        place,
        task=named,
        style=style,
        observation_steps=observation_steps,
        actions=options.actions,
        mask=options.mask,
        demos=demos,
        horizon=options.time_limit,
        **seen,
    )
    if task.environment is None:
        raise ValueError(
            f"{path} does not say which environment it was recorded in: name a robosuite task with --task, "
            "train without an environment (python -m warmprior train), or describe a task of your own "
            "(docs/benchmarks.md)"
        )
    if "gymnasium" in task.environment:
        return task
    facts, digest = task.facts | {"source": source}, task.digest
    if place != path:  # of what it was rendered from
        original = opened(path)
        facts |= {"file": original.name, "sha256": original.digest()}
        digest = digest_of(facts["sha256"], demos, space_of(task), facts["images"], renderer_versions())
    return replace(task, facts=facts, digest=digest)


def with_images(
    place: Path | str,
    task: str | None,
    cameras: Sequence[str],
    size: int,
    fast: bool,
    *,
    demos: int | None = None,
    mask: str | None = None,
) -> Path | str:
    """A place whose demonstrations have images of some cameras: this one, or a file rendered from it."""
    found = opened(place, task, mask)
    index = found.index(demos=demos)
    if set(cameras) <= set(index.cameras):
        there = found.index(image_keys=image_names(cameras), demos=demos).image_size
        if there != size:
            raise ValueError(
                f"{index.path} has images of {there} pixels: add --image-size {there} (and a --crop-size "
                "below), or render it anew"
            )
        return place
    if str(place).startswith(LEROBOT):
        return place  # whoever reads it says what is missing
    if mask is not None:
        raise ValueError(
            f"{place} has no images of {', '.join(cameras)}, and files are rendered whole: render it first "
            "(python benchmarks/demonstrations.py render), or leave the mask out"
        )
    return render_demonstrations(place, cameras, size, demos=demos, fast=fast)


def read_like(
    place: Path | str, name: str, facts: Mapping[str, Any], mask: str | None = None
) -> tuple[TensorDictBase, str]:
    """Further demonstrations of a task in robosuite, in raw units, as policies of these facts see them.

    Also what the place is called in results. A ``ValueError`` if they are of another task.
    """
    found = opened(place, name, mask)
    if (theirs := task_name(found.index())) != name:  # before images are rendered
        raise ValueError(f"{place} holds demonstrations of {theirs}, but these policies are for {name}")
    images, called = facts.get("images"), found.name
    seen: dict[str, Any] = {"absolute_actions": facts.get("actions") == "absolute"}
    if images is not None:
        place = with_images(
            place, name, images["cameras"], images["size"], images["fast_rendering"], mask=mask
        )
        found = opened(place, name, mask)
        seen |= {"cameras": images["cameras"], "fast_rendering": images["fast_rendering"]}
    return read_steps(found, **seen)[0].data.exclude("next"), called


def navigation_task(style: Literal["toy", "position"] = "toy") -> Task:
    """The one-dimensional navigation toy (Fig. 5): :class:`~warmprior.envs.NavigationEnv` and its data.

    In the style ``"position"`` policies see the position alone, as in the paper.

    Examples:
        >>> from lab.tasks import navigation_task
        >>> task = navigation_task()
        >>> task.name, task.make_env(batch_size=[8]).batch_size
        ('navigation', torch.Size([8]))
    """
    if style not in ("toy", "position"):
        raise ValueError(f"the style of the toy is 'toy' or 'position', got {style!r}")
    octaves = 0 if style == "position" else OCTAVES
    make_env = partial(NavigationEnv, octaves=octaves)
    return Task("navigation", style, navigation_demonstrations(octaves), make_env)


def load_task(options: DataOptions, name: str | None, style: str = "ph", observation_steps: int = 2) -> Task:
    """Read, download or generate the demonstrations of one task.

    Args:
        options: where they come from, and what policies are to see of them.
        name: of a robosuite task, ``"navigation"`` for the toy, or ``"package.module:function"`` of your own,
            which may take the options; ``None`` for that of ``options.dataset``.
        style: of the demonstrations.
        observation_steps: ``To`` of the policies.

    Raises:
        ValueError: if there is no such task, or a file is of another one.

    Examples:
        >>> from lab.tasks import DataOptions, load_task
        >>> load_task(DataOptions(), "navigation").style
        'toy'
    """
    if name == "navigation":
        return navigation_task("position" if style == "position" else "toy")
    if name is not None and ":" in name:
        module, _, function = name.partition(":")
        try:
            make = getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"--task {name}: {error}") from error
        task = make(options) if inspect.signature(make).parameters else make()
        if not isinstance(task, Task):
            raise ValueError(f"--task {name} returns {type(task).__name__}, not a Task")
        return task
    path, source = demonstrations_of(options, name, style)
    return robosuite_task(path, style, source=source, observation_steps=observation_steps, options=options)


def demonstrations_of(options: DataOptions, name: str | None, style: str) -> tuple[Path, str]:
    """The file or dataset of a robosuite task, downloaded or generated if needed, and what made it."""
    if options.dataset is not None:
        return options.dataset, "file"
    if options.download:
        return download_robomimic(str(name), style, force=options.force_download), "official"
    return generate_demonstrations(str(name), style, options.count(style)), "scripted"


def task_places(options: DataOptions) -> list[tuple[str | None, str]]:
    """The tasks that options name, checked: for each what :func:`load_task` takes, a name and a style."""
    options.check()
    names: Sequence[str | None] = options.task or (None if options.dataset else "square",)
    if options.generated and any(name in TASKS for name in names):
        counts = ", ".join(f"{options.count(style)} {style}" for style in options.data)
        print(
            f"Data: {counts} scripted demonstrations per task. They stand in for the official human data "
            "(--download); success rates on them are not comparable with the paper's.",
            flush=True,
        )
    found: dict[tuple[str | None, str], None] = {}
    for name in names:
        one_style = name is not None and not is_simulated(name)
        styles = options.data[: 1 if one_style else None]
        if options.download and name in TASKS:
            there = tuple(style for style in styles if style in OFFICIAL.get(name, ()))
            if there and there != styles:
                left_out = ", ".join(style for style in styles if style not in there)
                print(f"Data: there are no official {left_out} demonstrations of {name}.", flush=True)
                styles = there
        found |= dict.fromkeys((name, style) for style in styles)
    return list(found)


def space_of(task: Task) -> dict[str, str]:
    """Return the spaces of actions and observations, where they are not the recorded one and the state."""
    return {key: task.facts[key] for key in ("actions", "obs") if key in task.facts}


def title_of(task: Task) -> str:
    """Return task, style and what is unusual, for figures.

    >>> title_of(load_task(DataOptions(), "navigation"))
    'navigation toy'
    """
    source = task.facts.get("source")
    words = {"actions": "actions", "obs": "observations"}
    parts = [f"{task.name} {task.style}" + (f" ({source} data)" if source else "")]
    parts += [f"{value} {words[key]}" for key, value in space_of(task).items()]
    if (task.facts.get("images") or {}).get("fast_rendering"):
        parts.append("rendered fast")
    return ", ".join(parts)


def longest_of(task: Task) -> int:
    """Return the number of steps of the longest demonstration."""
    return int(task.data[EPISODE].flatten().bincount().max())
