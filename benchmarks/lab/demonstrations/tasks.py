"""Tasks of the benchmarks, and the sources of their demonstrations."""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tensordict import TensorDictBase

from lab.demonstrations.downloads import OFFICIAL, download_robomimic
from lab.demonstrations.render import render_demonstrations
from lab.demonstrations.scripted.generate import generate_demonstrations
from lab.demonstrations.scripted.tasks import EXPERTS
from warmprior.checks import check_whole_numbers
from warmprior.data import Demonstrations, demonstrations_of, open_demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.images import check_images, renderer_versions
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.navigation1d import OCTAVES, NavigationEnv, navigation_demonstrations
from warmprior.envs.rendering import require_rendering
from warmprior.envs.tasks import TASKS, get_task
from warmprior.io.extras import require
from warmprior.io.files import digest_of
from warmprior.keys import EPISODE
from warmprior.modules.encoder import imagenet_weights
from warmprior.options.data import IMAGE_SIZE, Actions, Resizing
from warmprior.options.training import OF_IMAGES, PRETRAINED
from warmprior.tasks import Play, Task
from warmprior.training import NetworkOptions

GENERATED = 150
"""Default number of scripted demonstrations."""


MOST = 10_000_000
"""Upper limit of every count, which catches typing errors before memory is full."""


def is_simulated(task: str) -> bool:
    """Return True for robosuite's tasks, which are neither the toy nor a user's own."""
    return task != "navigation" and ":" not in task


def check_counts(options: Any, *names: str) -> None:
    """Raise ValueError for options that are neither ``None`` nor whole numbers from 1 to MOST."""
    for name in names:
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        for count in value if isinstance(value, tuple) else (value,):
            if count is not None:
                check_whole_numbers(**{option: count})
                if count > MOST:
                    raise ValueError(f"{option} must be at most {MOST:,}, got {count}")


def check_place(place: str | Path, option: str) -> None:
    """Check that a place may hold demonstrations; nothing is read or downloaded.

    Raises:
        FileNotFoundError: if there is no such file or folder; it names the option.
        ImportError: if the package that reads it is not installed.

    Examples:
        >>> from lab.demonstrations.tasks import check_place
        >>> check_place("lerobot:user/square", "--dataset")
        >>> check_place("lerobot:./square", "--dataset")
        Traceback (most recent call last):
            ...
        FileNotFoundError: --dataset lerobot:./square: no such folder, and no repository user/name of the hub
    """
    try:
        open_demonstrations(place).check()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{option} {error}") from error


def resolved_place(place: Path) -> str:
    """Return a place with an absolute path, so that it holds in any working directory."""
    return open_demonstrations(place).resolved()


@dataclass(frozen=True)
class DataOptions(Resizing):
    """Options of the demonstrations that policies are trained on.

    Attributes:
        task: tasks of robosuite (default: can in the quick preset, otherwise square, or the dataset's), or
            package.module:function of your own, which takes these options and returns a Task
        style: styles of the demonstrations: ph (one operator) or mh (six operators), in MimicGen's files
            source (human) or core (generated from source)
        dataset: demonstrations in place of generated ones: a robomimic HDF5 file, lerobot:FOLDER or
            lerobot:USER/NAME of a LeRobotDataset, or minari:NAME
        download: download the official demonstrations, in place of generated ones
        force_download: download the official demonstrations again, in place of a broken local copy
        mask: mask of the file, such as train, whose demonstrations to use (default: all)
        horizon: control steps per episode (default: the environment's own, or robosuite's for the style)
        demonstrations: number of demonstrations to generate, or to take from a file (default: all of it); two
            numbers for ph and mh
        actions: actions of the policies: deltas as recorded, or the absolute poses that they target
        obs: observations of the policies: state of robot and objects, or state of the robot and images
        images: images, such as agentview_image (default: those of the task's two cameras, or four with two
            arms)
        fast_rendering: render without reflections, shadows and smooth edges, three to five times faster

    Examples:
        >>> from lab.demonstrations.tasks import DataOptions
        >>> options = DataOptions(style=("ph", "mh"), demonstrations=(20, 60))
        >>> options.count("ph"), options.count("mh"), options.generated
        (20, 60, True)
    """

    task: tuple[str, ...] = ()
    style: tuple[Literal["ph", "mh", "source", "core"], ...] = ("ph",)
    dataset: Path | None = None
    download: bool = False
    force_download: bool = False
    mask: str | None = None
    horizon: int | None = None
    demonstrations: tuple[int, ...] = ()
    actions: Actions = "delta"
    obs: Literal["state", "image"] = "state"
    images: tuple[str, ...] = ()
    fast_rendering: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "demonstrations", "image_size", "horizon")
        if len(self.demonstrations) > 2:
            raise ValueError(
                f"--demonstrations takes one number, or one for ph and one for mh, got {self.demonstrations}"
            )

    def check(self) -> None:
        """Check the options before anything is generated or downloaded.

        Raises:
            ValueError: for options that contradict each other.
            FileNotFoundError: if the file does not exist.
            ImportError: if MimicGen's data are to be downloaded, but its package is not installed.
        """
        if self.force_download and not self.download:
            raise ValueError("--force-download belongs to --download")
        if self.mask is not None and self.generated:
            raise ValueError("--mask is that of a file: add --download, or --dataset FILE")
        if self.obs == "image":
            try:
                require_rendering()
            except ImportError as error:
                raise ValueError(f"--obs image needs the simulator's images: {error}") from error
            if self.actions == "absolute":
                raise ValueError("--obs image goes with --actions delta, as in the paper")
            if len(set(self.images)) < len(self.images):
                raise ValueError(f"--images names one twice: {' '.join(self.images)}")
        elif self.images or self.fast_rendering:
            raise ValueError("--images and --fast-rendering belong to --obs image")
        if self.dataset is not None:
            if self.download:
                raise ValueError("--dataset reads a file: leave out --download")
            if len(self.task) > 1 or len(self.style) > 1:
                raise ValueError("--dataset is of one task and style: name at most one --task and --style")
            if len(self.demonstrations) > 1:
                raise ValueError(
                    f"--demonstrations takes one number with --dataset, got {self.demonstrations}"
                )
            check_place(self.dataset, "--dataset")
        if len(self.style) > 1 and self.task and not any(map(is_simulated, self.task)):
            raise ValueError(
                f"a task of your own has one style: name one --style, got {' '.join(self.style)}"
            )
        for task in filter(is_simulated, self.task):
            get_task(task)
            if self.generated and task not in EXPERTS:
                raise ValueError(
                    f"there is no scripted expert for {task}: add --download for the official data, or "
                    "--dataset FILE"
                )
            if self.download and is_mimicgen(get_task(task).env_name):
                find_mimicgen()
        for style in self.style if self.generated else ():
            if style not in ("ph", "mh"):
                raise ValueError(
                    f"--style {style} is that of MimicGen's files: add --download, or --dataset FILE"
                )

    def check_only(self, *names: str) -> None:
        """Raise ValueError if the task would pass over an option: it reads only those with these names."""
        usual = DataOptions()
        others = {f.name for f in fields(self) if getattr(self, f.name) != getattr(usual, f.name)} - {*names}
        if others:
            words = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(others))
            raise ValueError(f"this task has demonstrations of its own: leave out {words}")
        if "style" not in names and len(self.demonstrations) > 1:
            raise ValueError(f"this task takes one number of --demonstrations, got {self.demonstrations}")

    @property
    def generated(self) -> bool:
        """Return True if scripted experts generate the data."""
        return self.dataset is None and not self.download

    def first(self, style: str) -> int | None:
        """Return the number of demonstrations to take from a file of a style; ``None`` for all."""
        return self.demonstrations[-1 if style == "mh" else 0] if self.demonstrations else None

    def count(self, style: str) -> int:
        """Return the number of scripted demonstrations of a style."""
        return self.first(style) or GENERATED


def without_images(network: NetworkOptions) -> NetworkOptions:
    """Return options with defaults for those that have no effect without images."""
    return replace(network, **{name: getattr(NetworkOptions, name) for name in OF_IMAGES})


def check_network(network: NetworkOptions, data: DataOptions) -> None:
    """Raise an error for options of images that do not fit, and for pretrained weights that are missing."""
    if data.obs == "state":
        usual = without_images(network) == network or network.encoder == "resnet18"
        if not usual or (data.image_size, data.resize) != (None, "squeeze"):
            names = "--image-size, --resize, --crop-size, --share-encoder and --encoder"
            raise ValueError(f"{names} belong to --obs image")
        return
    if data.image_size and network.crop_size and not 8 <= network.crop_size <= data.image_size:
        raise ValueError(
            f"--crop-size {network.crop_size} must be at least 8 and at most --image-size {data.image_size}"
        )
    if network.encoder == PRETRAINED:
        imagenet_weights()
    elif network.encoder != "small":
        require("torchvision", "vision")


def robosuite_task(path: Path | str, style: str, *, source: str, options: DataOptions) -> Task:
    """Return the task of a file of demonstrations; ``source`` is scripted, official or file."""
    demonstrations = open_demonstrations(
        path,
        # Only a file of the user's may have too many demonstrations, or be of an unknown task.
        demos=None if source == "scripted" else options.first(style),
        mask=options.mask,
        style=style,
        task=next(iter(options.task), None) if source == "file" else None,
        image_size=options.image_size,
        resize=options.resize,
    )
    images: Sequence[str] = ()
    pictured = demonstrations
    if options.obs == "image":
        index = demonstrations.index()
        images = options.images or images_of(index.task.cameras if index.task else index.cameras)
        if not images:
            raise ValueError(f"{path} has no images, and its task is unknown: name --images")
        pictured = with_images(demonstrations, images, options.fast_rendering)
    play = Play(horizon=options.horizon, fast_rendering=bool(images) and options.fast_rendering)
    task = Task(pictured, images=images, actions=options.actions, play=play)
    if task.environment is None:
        raise ValueError(
            f"{path} does not say which environment it was recorded in: name a robosuite task with --task, "
            "train without an environment (python -m warmprior train), or describe a task of your own "
            "(docs/benchmarks.md)"
        )
    if "gymnasium" in task.environment:
        return task
    task.facts["source"] = source
    if pictured is not demonstrations:  # the facts are those of the original file
        task.facts |= {"file": demonstrations.name, "sha256": demonstrations.digest(index)}
        seen = space_of(task), task.facts["images"]
        task.digest = digest_of(task.facts["sha256"], demonstrations.demos, *seen, renderer_versions())
    return task


def images_of(cameras: Sequence[str]) -> list[str]:
    """Return the names of cameras' images in files."""
    return [f"{camera}_image" for camera in cameras]


def with_images(demonstrations: Demonstrations, images: Sequence[str], fast: bool) -> Demonstrations:
    """Return demonstrations with images: the given ones, or those of a file rendered from them."""
    index = demonstrations.index()
    if set(images) <= set(index.available_keys) or not isinstance(demonstrations, RobomimicDemonstrations):
        return demonstrations  # a reader names missing images
    if demonstrations.mask is not None:
        raise ValueError(
            f"{demonstrations} has no images {', '.join(images)}, and files are rendered whole: render "
            "it first (python benchmarks/demonstrations.py render), or leave the mask out"
        )
    rendered = copy.copy(demonstrations)
    rendered.place = render_demonstrations(
        demonstrations.path,
        [image.removesuffix("_image") for image in images],
        demonstrations.image_size or IMAGE_SIZE,
        demos=demonstrations.demos,
        fast=fast,
    )
    return rendered


def read_like(
    place: Path | str, name: str, facts: Mapping[str, Any], mask: str | None = None
) -> tuple[TensorDictBase, str]:
    """Return more demonstrations of a robosuite task in raw units, and the name of their place in results.

    Their observations and actions are those of the policies with these facts.

    Raises:
        ValueError: if the demonstrations are of another task.
    """
    images = facts.get("images")
    sized = {} if images is None else {"image_size": images["size"], "resize": images["resize"]}
    demonstrations = open_demonstrations(place, mask=mask, task=name, **sized)
    if (stored := demonstrations.index().task_name) != name:  # before images are rendered
        raise ValueError(f"{place} has demonstrations of {stored}, but the policies are for {name}")
    called, observations, pictures = demonstrations.name, facts.get("observation_keys"), []
    if images is not None:
        fast = images["fast_rendering"]
        pictures = images_of(images["cameras"])
        demonstrations = with_images(demonstrations, pictures, fast)
        observations = images["low_dim_keys"]
        check_images(demonstrations, demonstrations.index(observations, pictures), fast)
    steps = demonstrations.steps(
        observations,
        pictures,
        actions=facts.get("actions", "delta"),
        storage="memmap" if pictures else "memory",
    )
    return steps.exclude("next"), called


def navigation_task(style: Literal["toy", "position"] = "toy") -> Task:
    """Return the task of the navigation toy (Fig. 5): :class:`~warmprior.envs.NavigationEnv` and its data.

    In the style ``"position"`` policies see the position alone, as in the paper.

    Examples:
        >>> from lab.demonstrations.tasks import navigation_task
        >>> task = navigation_task()
        >>> task.name, task.make_env(batch_size=[8]).batch_size
        ('navigation', torch.Size([8]))
    """
    if style not in ("toy", "position"):
        raise ValueError(f"the style of the toy is 'toy' or 'position', got {style!r}")
    octaves = 0 if style == "position" else OCTAVES
    make_env = partial(NavigationEnv, octaves=octaves)
    steps = navigation_demonstrations(octaves)
    demonstrations = demonstrations_of(steps, "navigation", style=style, normalised=True)
    return Task(demonstrations, play=Play(make_env))


def load_task(options: DataOptions, name: str | None, style: str = "ph") -> Task:
    """Read, download or generate the demonstrations of one task.

    Args:
        options: the source of the demonstrations, and the observations of the policies.
        name: a robosuite task, ``"navigation"`` for the toy, or ``"package.module:function"`` of your own,
            which may take the options; ``None`` for the task of ``options.dataset``.
        style: style of the demonstrations.

    Raises:
        ValueError: if there is no such task, or a file is of another one.

    Examples:
        >>> from lab.demonstrations.tasks import DataOptions, load_task
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
    path, source = place_of(options, name, style)
    return robosuite_task(path, style, source=source, options=options)


def place_of(options: DataOptions, name: str | None, style: str) -> tuple[Path, str]:
    """Return the file or dataset of a robosuite task, and its source; download or generate it if needed."""
    if options.dataset is not None:
        return options.dataset, "file"
    if options.download:
        return download_robomimic(str(name), style, force=options.force_download), "official"
    return generate_demonstrations(str(name), style, options.count(style)), "scripted"


def task_places(options: DataOptions) -> list[tuple[str | None, str]]:
    """Check the options, and return name and style of each task, for :func:`load_task`."""
    options.check()
    names: Sequence[str | None] = options.task or (None if options.dataset else "square",)
    if options.generated and any(name in TASKS for name in names):
        counts = ", ".join(f"{options.count(style)} {style}" for style in options.style)
        print(
            f"Data: {counts} scripted demonstrations per task, in place of the official human ones "
            "(--download). Success rates on them are not comparable with the paper's.",
            flush=True,
        )
    places: dict[tuple[str | None, str], None] = {}
    for name in names:
        one_style = name is not None and not is_simulated(name)
        styles = options.style[: 1 if one_style else None]
        if options.download and name in TASKS:
            published = tuple(style for style in styles if style in OFFICIAL.get(name, ()))
            if published and published != styles:
                left_out = ", ".join(style for style in styles if style not in published)
                print(f"Data: there are no official {left_out} demonstrations of {name}.", flush=True)
                styles = published
        places |= dict.fromkeys((name, style) for style in styles)
    return list(places)


def space_of(task: Task) -> dict[str, str]:
    """Return the spaces of actions and observations, if they are not recorded deltas and the state."""
    return {key: task.facts[key] for key in ("actions", "obs") if key in task.facts}


def title_of(task: Task) -> str:
    """Return task, style and unusual spaces, for titles of figures.

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
