"""Options of the demonstrations that policies are trained on, and their checks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from warmprior.checks import check_whole_numbers
from warmprior.io.extras import require
from warmprior.options.data import PLACES, Actions, Resizing
from warmprior.options.training import OF_IMAGES, PRETRAINED, NetworkOptions

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
                if isinstance(count, int) and count > MOST:
                    raise ValueError(f"{option} must be at most {MOST:,}, got {count}")
                check_whole_numbers(**{option: count})


@contextmanager
def naming(option: str, value: Any) -> Iterator[None]:
    """Let a ValueError of the library, which knows no options of scripts, name the option and its value."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{option} {value}: {error}") from error


def check_place(place: str | Path, option: str) -> None:
    """Check that a place may hold demonstrations; nothing is read or downloaded.

    Raises:
        FileNotFoundError: if there is no such file or folder; it names the option.
        ImportError: if the package that reads it is not installed.

    Examples:
        >>> from lab.demonstrations.data_options import check_place
        >>> check_place("lerobot:user/square", "--dataset")
        >>> check_place("lerobot:./square", "--dataset")
        Traceback (most recent call last):
            ...
        FileNotFoundError: --dataset lerobot:./square: no such folder, and no repository user/name of the hub
    """
    from warmprior.data import open_demonstrations

    try:
        open_demonstrations(place).check()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{option} {error}") from error


def resolved_place(place: Path) -> str:
    """Return a place with an absolute path, so that it holds in any working directory."""
    from warmprior.data import open_demonstrations

    return open_demonstrations(place).resolved()


@dataclass(frozen=True)
class DataOptions(Resizing):
    """Options of the demonstrations that policies are trained on.

    Attributes:
        task: tasks of robosuite, or package.module:function of your own, which takes these options and
            returns a Task (default: can in the quick preset, otherwise square, or the dataset's)
        style: styles of the demonstrations: ph (one operator) or mh (six operators), in MimicGen's files
            source (human) or core (generated from source)
        dataset: demonstrations in place of generated ones: {PLACES}
        download: download the official demonstrations, in place of generated ones
        force_download: download the official demonstrations again, in place of a broken local copy
        mask: mask of the file, such as train, whose demonstrations to use (default: all)
        horizon: time limit in control steps (default: the environment's own, or robosuite's for the style)
        demonstrations: number of demonstrations to generate, or to take from a file, which is taken whole if
            none is given; two numbers for ph and mh
        actions: actions of the policies: deltas as recorded, or the absolute poses that they target
        obs: observations of the policies: state of robot and objects, or state of the robot and images, those
            of the task's two cameras (four with two arms) if --images names no others
        observations: observations of the policies, in this order, of --dataset (default: the task's)
        joints: observation of the joint positions that absolute actions of --dataset target; "" for none
            (default: as python -m warmprior train recognises it)
        images: images for the policies to see, such as agentview_image
        fast_rendering: render without reflections, shadows and smooth edges, three to five times faster

    Examples:
        >>> from lab.demonstrations.data_options import DataOptions
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
    observations: tuple[str, ...] | None = None
    joints: str | None = None
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
        from lab.demonstrations.scripted.experts import EXPERTS
        from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
        from warmprior.envs.rendering import require_rendering
        from warmprior.envs.robosuite_tasks import get_task

        if self.force_download and not self.download:
            raise ValueError("--force-download belongs to --download")
        if self.mask is not None and self.generated:
            raise ValueError("--mask is that of a file: add --download, or --dataset FILE")
        if self.dataset is None and (self.observations is not None or self.joints is not None):
            raise ValueError("--observations and --joints choose among those of --dataset: name one")
        if self.sees_images:
            try:
                require_rendering()
            except ImportError as error:
                raise ValueError(f"policies that see images need the simulator's: {error}") from error
            if self.actions == "absolute":
                raise ValueError("images go with --actions delta, as in the paper")
            if len(set(self.images)) < len(self.images):
                raise ValueError(f"--images names one twice: {' '.join(self.images)}")
        elif self.fast_rendering:
            raise ValueError("--fast-rendering is that of images: add --images NAME or --obs image")
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
            with naming("--task", task):
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
    def sees_images(self) -> bool:
        """Return True if the policies see images: those that are named, or the task's."""
        return bool(self.images) or self.obs == "image"

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


DataOptions.__doc__ = str(DataOptions.__doc__).format(PLACES=PLACES)


def without_images(network: NetworkOptions) -> NetworkOptions:
    """Return options with defaults for those that have no effect without images."""
    return replace(network, **{name: getattr(NetworkOptions, name) for name in OF_IMAGES})


def check_encoder(network: NetworkOptions, data: DataOptions) -> None:
    """Raise an error for options of images that do not fit, and for pretrained weights that are missing."""
    from warmprior.modules.encoder import imagenet_weights

    if not data.sees_images:
        usual = without_images(network) == network or network.encoder == "resnet18"
        if not usual or (data.image_size, data.resize) != (None, "squeeze"):
            names = "--image-size, --resize, --crop-size, --share-encoder and --encoder"
            raise ValueError(f"{names} are those of images: add --images NAME or --obs image")
        return
    if data.image_size and network.crop_size and not 8 <= network.crop_size <= data.image_size:
        raise ValueError(
            f"--crop-size {network.crop_size} must be at least 8 and at most --image-size {data.image_size}"
        )
    if network.encoder == PRETRAINED:
        imagenet_weights()
    elif network.encoder != "small":
        require("torchvision", "vision")
