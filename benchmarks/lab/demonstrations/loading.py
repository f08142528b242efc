"""Tasks of the benchmarks, and the sources of their demonstrations."""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tensordict import TensorDictBase

from lab.demonstrations.data_options import DataOptions, is_simulated
from lab.demonstrations.downloads import OFFICIAL, download_robomimic
from lab.demonstrations.render import render_demonstrations
from lab.demonstrations.scripted.generate import generate_demonstrations
from warmprior.checks import check_choice
from warmprior.data import Demonstrations, demonstrations_of, open_demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.image_check import check_images, renderer_versions
from warmprior.envs.navigation1d import OCTAVES, NavigationEnv, navigation_demonstrations
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.io.files import digest_of
from warmprior.keys import EPISODE
from warmprior.options.data import IMAGE_SIZE
from warmprior.tasks import Play, Task


def robosuite_task(path: Path | str, style: str, *, source: str, options: DataOptions) -> Task:
    """Return the task of a file of demonstrations; ``source`` is scripted, official or file."""
    demonstrations = open_demonstrations(
        path,
        # Only a file of the user's may have too many demonstrations, or be of an unknown task.
        demos=None if source == "scripted" else options.first(style),
        mask=options.mask,
        style=style,
        task=next(iter(options.task), None) if source == "file" else None,
        # A preset may have a size for the tasks that see images.
        **({"image_size": options.image_size, "resize": options.resize} if options.sees_images else {}),
    )
    recorded = demonstrations.environment(demonstrations.index(options.observations))
    if not recorded:  # before images are read
        raise ValueError(
            f"{path} does not say which environment it was recorded in: name a robosuite task with --task, "
            "train without an environment (python -m warmprior train), or describe a task of your own "
            "(docs/benchmarks.md)"
        )
    if "gymnasium" in recorded and options.sees_images:
        raise ValueError(
            f"{path} was recorded in a Gymnasium environment, which shows policies no images: leave --images "
            "out, or describe a task of your own (docs/benchmarks.md)"
        )
    images: Sequence[str] = ()
    pictured = demonstrations
    if options.sees_images:
        index = demonstrations.index()
        images = options.images or images_of(index.task.cameras if index.task else index.cameras)
        if not images:
            raise ValueError(f"{path} has no images, and its task is unknown: name --images")
        pictured = with_images(demonstrations, images, options.fast_rendering)
    play = Play(horizon=options.horizon, fast_rendering=bool(images) and options.fast_rendering)
    task = Task(
        pictured,
        observations=options.observations,
        images=images,
        joints=options.joints,
        actions=options.actions,
        play=play,
    )
    if "gymnasium" in recorded:
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
        >>> from lab.demonstrations.loading import navigation_task
        >>> task = navigation_task()
        >>> task.name, task.make_env(batch_size=[8]).batch_size
        ('navigation', torch.Size([8]))
    """
    check_choice("style", style, ("toy", "position"))
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
        >>> from lab.demonstrations.data_options import DataOptions
        >>> from lab.demonstrations.loading import load_task
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
