"""What policies are trained for: demonstrations, their units, and the environment that plays episodes."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, Self

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from warmprior.data import download_robomimic, generate_demonstrations
from warmprior.data.opening import Demonstrations
from warmprior.data.render import renderer_versions
from warmprior.data.replay import DatasetIndex, DemonstrationReplay
from warmprior.envs.description import environment_description, robosuite_parts
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.navigation1d import OCTAVES, NavigationEnv, navigation_demonstrations
from warmprior.envs.simulator import task_env_args
from warmprior.envs.tasks import TASKS
from warmprior.io.files import digest_of
from warmprior.keys import ACTION, EPISODE, OBSERVATION, STATE, SUCCESS
from warmprior.modules.normalize import Normalizer
from warmprior.modules.preconditioning import RestingAction
from warmprior.training.checkpoint import data_digest
from warmprior.training.options import DataOptions, is_simulated
from warmprior.transforms.absolute_actions import AbsoluteActions


@dataclass(frozen=True)
class Task:
    """Demonstrations and an environment: what every policy of a comparison is trained for.

    Of your own: :meth:`of` takes raw demonstrations and a function that builds the environment.

    Attributes:
        name: short name, such as ``"square"``.
        style: of the demonstrations, such as ``"ph"``.
        data: contiguous steps in normalised units, see :class:`~warmprior.ActionWindow`.
        make_env: builds the environment, called without arguments to play episodes: a TorchRL environment
            without batch dimensions, in raw units, with ``"observation"`` ``[d_o]`` and ``"action"``
            ``[d_a]``, that starts the same episode after every ``set_seed(seed)``.
        normalizer: between raw and normalised units; ``None`` if they are the same.
        success: the environment's key for whether the task is solved, bool ``[1]``.
        measures: further keys that episodes report, each with how its values are combined: ``"max"``,
            ``"sum"`` or ``"last"``.
        film_rate: control steps per second of films, where the environment has a method ``render`` that gives
            a picture, uint8 ``[h, w, 3]``; ``None`` for no films, but robosuite's.
        facts: what results say about the data, as JSON.
        adapters: transforms next to the environment, as arguments of
            :func:`~warmprior.policy_transforms`.
        rest: for absolute actions, see :class:`~warmprior.PoseTrend`.
        clip: bound of the normalised actions that are executed, or one per dimension; ``None`` for none.
        environment: what a saved policy keeps of the environment, see
            :func:`~warmprior.envs.environment_of`.
        digest: of the data; computed from them by default.

    Raises:
        ValueError: if ``name`` or ``style`` cannot be part of the name of a file, or for a measure that is
            combined in another way.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> from warmprior.training import Task
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> task = Task.of("pendulum", TensorDict(steps, [60]), lambda: GymEnv("Pendulum-v1"))
        >>> task.title, round(task.data["action"].amax().item(), 3), task.facts["demonstrations"]
        ('pendulum human', 1.0, 3)
    """

    name: str
    style: str
    data: TensorDictBase
    make_env: Callable[..., EnvBase]
    normalizer: Normalizer | None = None
    success: NestedKey = SUCCESS
    measures: Mapping[str, Literal["max", "sum", "last"]] = field(default_factory=dict)
    film_rate: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    adapters: Mapping[str, Transform] = field(default_factory=dict)
    rest: RestingAction | None = None
    clip: float | Sequence[float] | None = None
    environment: Mapping[str, Any] | None = None
    digest: str | None = None

    def __post_init__(self) -> None:
        for part in (self.name, self.style):
            if Path(part).name != part:
                raise ValueError(f"name and style become names of files: {part!r} cannot")
        for key, how in self.measures.items():
            if how not in ("max", "sum", "last"):
                raise ValueError(
                    f"measures of {self.name}: {key!r} is combined by 'max', 'sum' or 'last', not {how!r}"
                )

    @classmethod
    def of(
        cls,
        name: str,
        data: TensorDictBase,
        make_env: Callable[..., EnvBase] | None = None,
        *,
        style: str = "human",
        success: NestedKey = SUCCESS,
        measures: Mapping[str, Literal["max", "sum", "last"]] | None = None,
        film_rate: int | None = None,
    ) -> Self:
        """A task of your own, from raw demonstrations; the normaliser is fitted to them.

        Arguments are the attributes, but for the data: contiguous steps ``[N]`` in raw units, with
        ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]`` and ``"episode"``, an integer ``[N]``.
        Without ``make_env`` policies are trained and not played.

        Raises:
            KeyError: naming what the data lack.
            ValueError: if an entry has another shape, or is not finite.
        """
        if data.ndim != 1:
            raise ValueError(
                f"the demonstrations of {name} must be flat steps, TensorDict(steps, [N]), got the batch "
                f"size {tuple(data.shape)}"
            )
        missing = [key for key in (OBSERVATION, ACTION, EPISODE) if key not in list(data.keys())]
        if missing:
            raise KeyError(f"the demonstrations of {name} lack {missing}: they have {list(data.keys())}")
        for key in (OBSERVATION, ACTION):
            if data[key].ndim != 2:
                raise ValueError(f"{key!r} of {name} has shape {tuple(data[key].shape)}, not [N, d]")
        episode = data[EPISODE]
        if episode.ndim != 1 or episode.is_floating_point() or bool((episode < 0).any()):
            raise ValueError(
                f"{EPISODE!r} of {name} must count the demonstrations, integers [N] from 0 on, got "
                f"{episode.dtype} {tuple(episode.shape)}"
            )
        normalizer = Normalizer.fit(data)
        return cls(
            name,
            style,
            normalizer.normalize(data.select(OBSERVATION, ACTION, EPISODE)),
            make_env or _no_environment,
            normalizer,
            success=success,
            measures=measures or {},
            film_rate=film_rate,
            facts={"demonstrations": len(data[EPISODE].unique()), "steps": len(data)},
            clip=1.0,
        )

    @cached_property
    def identity(self) -> str:
        """Digest of the data, part of the identity of every policy that is trained on them."""
        if self.digest:
            return self.digest
        # Data in other units may be equal once they are normalised.
        units = self.normalizer.state_dict() if self.normalizer else {}
        data = data_digest(self.data.select(OBSERVATION, ACTION, EPISODE))
        return digest_of(data, {key: value.tolist() for key, value in units.items()})

    @property
    def title(self) -> str:
        """Task, style and what is unusual, for figures."""
        source = self.facts.get("source")
        words = {"actions": "actions", "obs": "observations"}
        parts = [f"{self.name} {self.style}" + (f" ({source} data)" if source else "")]
        parts += [f"{value} {words[key]}" for key, value in self.space.items()]
        if (self.facts.get("images") or {}).get("fast_rendering"):
            parts.append("rendered fast")
        return ", ".join(parts)

    @property
    def vector(self) -> Tensor:
        """The observation, or its vector if it has images, ``[N, d]``."""
        observation = self.data[OBSERVATION]
        return observation[STATE] if isinstance(observation, TensorDictBase) else observation

    @property
    def images(self) -> dict[str, int]:
        """Names of the observation's images, and their sides in pixels."""
        observation = self.data[OBSERVATION]
        if not isinstance(observation, TensorDictBase):
            return {}
        return {name: int(value.shape[-1]) for name, value in observation.items() if name != STATE}

    @property
    def space(self) -> dict[str, str]:
        """The spaces of actions and observations, where they are not the recorded one and the state."""
        return {key: self.facts[key] for key in ("actions", "obs") if key in self.facts}

    @property
    def longest(self) -> int:
        """Steps of the longest demonstration."""
        return int(self.data[EPISODE].flatten().bincount().max())


def _no_environment() -> EnvBase:
    raise ValueError("these demonstrations have no environment: give Task.of a function that builds one")


def robosuite_task(
    path: Path | str,
    style: str = "ph",
    *,
    source: str = "file",
    observation_steps: int = 2,
    options: DataOptions | None = None,
) -> Task:
    """The task of demonstrations in robosuite, played in the simulator that recorded them.

    A LeRobotDataset that does not describe its environment is of that of ``options.task``. The style decides
    the time limit, and ``source``, ``"scripted"``, ``"official"`` or ``"file"``, says what made the file.
    """
    options = DataOptions() if options is None else options
    # A generated file has as many as were asked for.
    demos = None if source == "scripted" else options.first(style)
    found = _open(path, next(iter(options.task), None), options.mask)
    index = found.index()
    if demos == len(index.demos):
        demos = None  # all of them
    if not index.env_args:
        raise ValueError(
            f"{path} does not say which environment it was recorded in: name a robosuite task with --task, "
            "train without an environment (python -m warmprior train --observation-keys), or describe a task "
            "of your own (docs/benchmarks.md)"
        )
    # Not after hours of rendering, or of training.
    if source == "file" and options.task not in ((), (_name_of(index),)):
        raise ValueError(
            f"{path} holds demonstrations of {_name_of(index)}, not of {options.task[0]}: leave --task out "
            "or correct it"
        )
    if is_mimicgen(index.env_args["env_name"]):
        find_mimicgen()
    dataset, images = _read(found, options, demos)
    description = environment_description(dataset.env_args, style, observation_steps, options.actions, images)
    make_env, adapters = robosuite_parts(description)
    # Poses in the units of deltas: an error, or a sigma, of the same size means the same in both spaces, and
    # positions, which range far, do not weigh little beside the gripper in the loss.
    absolute = adapters.get("actions")
    units = {ACTION: absolute.one_step} if isinstance(absolute, AbsoluteActions) else None
    vector = OBSERVATION if images is None else (OBSERVATION, STATE)
    normalizer = Normalizer.fit(dataset.data, (vector, ACTION), units=units)
    data = normalizer.normalize(dataset.data.exclude("next"))
    sha256 = found.digest(_names(images), demos)
    # Nothing is said of what is usual.
    space: dict[str, Any] = {} if options.actions == "delta" else {"actions": options.actions}
    space |= {} if images is None else {"obs": "image", "images": images}
    return Task(
        _name_of(dataset),
        style,
        data,
        make_env,
        normalizer,
        facts={
            "source": source,
            "file": found.name,
            "sha256": sha256,
            "demonstrations": dataset.num_episodes,
            "steps": len(dataset.data),
            **space,
        },
        adapters=adapters,
        rest=None if absolute is None else RestingAction(dataset.pose_columns, normalizer),
        # What leaves the span of the normalised demonstrations is executed, and remembered, at the bound.
        clip=1.0 if absolute is None else data[ACTION].abs().amax(0).tolist(),
        environment=description,
        # Images are drawn by what is installed.
        digest=digest_of(sha256, demos, space, images and renderer_versions()),
    )


def _open(place: Path | str, task: str | None, mask: str | None = None) -> Demonstrations:
    """The demonstrations at a place; the task's environment is theirs where they do not say."""
    return Demonstrations(place, task_env_args(task) if task in TASKS else None, mask)


def _names(images: Mapping[str, Any] | None) -> list[str]:
    """The images' names."""
    return [] if images is None else [f"{camera}_image" for camera in images["cameras"]]


def _read(
    found: Demonstrations, options: DataOptions, demos: int | None = None
) -> tuple[DemonstrationReplay, dict[str, Any] | None]:
    """The demonstrations as policies are to see them, and what images are among it, if any."""
    if options.obs == "state":
        absolute = options.actions == "absolute"
        return found.replay(absolute_actions=absolute, demos=demos), None
    index = found.index(demos=demos)
    cameras = options.cameras or (index.task.cameras if index.task else index.cameras)
    if not cameras:
        raise ValueError(f"{found.name} has no images, and its task is unknown: name --cameras")
    names, fast = _names({"cameras": cameras}), options.fast_rendering
    if set(cameras) <= set(index.cameras):
        size = found.index(image_keys=names, demos=demos).image_size
        if size != options.image_size:
            raise ValueError(
                f"{index.path} has images of {size} pixels: add --image-size {size} (and a --crop-size "
                "below), or render it anew"
            )
    found = found.with_images(cameras, options.image_size, demos=demos, fast=fast)
    # What robomimic's image policies see besides: the robot, and not where the objects are.
    vector = [key for key in index.observation_keys if key != "object"]
    dataset = found.replay(observation_keys=vector, image_keys=names, storage="memmap", demos=demos)
    return dataset, {
        "cameras": list(cameras),
        "size": dataset.image_size,
        "fast_rendering": fast,
        "low_dim_keys": vector,
    }


def _name_of(dataset: DemonstrationReplay | DatasetIndex) -> str:
    """Short name of a dataset's task, or the environment's where it is none of ours."""
    task = dataset.task
    return str(dataset.env_args["env_name"]).lower() if task is None else task.name


def read_like(
    place: Path | str, name: str, facts: Mapping[str, Any], mask: str | None = None
) -> tuple[TensorDictBase, str]:
    """Further demonstrations of a task in robosuite, in raw units, as policies of these facts see them.

    Also what the place is called in results. A ``ValueError`` if they are of another task.
    """
    found = _open(place, name, mask)
    if (theirs := _name_of(found.index())) != name:  # before images are rendered
        raise ValueError(f"{place} holds demonstrations of {theirs}, but these policies are for {name}")
    images = facts.get("images")
    demos = min(facts["demonstrations"], len(found.index().demos))
    called = found.name
    if found.digest(_names(images), demos) == facts["sha256"]:
        called = "the TRAINING demonstrations (not held out)"
    seen: dict[str, Any] = {}
    if images is not None:
        seen = {
            "obs": "image",
            "cameras": tuple(images["cameras"]),
            "image_size": images["size"],
            "fast_rendering": images["fast_rendering"],
        }
    dataset, _ = _read(found, DataOptions(actions=facts.get("actions", "delta"), **seen))
    return dataset.data.exclude("next"), called


def navigation_task(style: Literal["toy", "position"] = "toy") -> Task:
    """The one-dimensional navigation toy (Fig. 5): :class:`~warmprior.envs.NavigationEnv` and its data.

    In the style ``"position"`` policies see the position alone, as in the paper.

    Examples:
        >>> from warmprior.training import navigation_task
        >>> task = navigation_task()
        >>> task.title, task.make_env(batch_size=[8]).batch_size
        ('navigation toy', torch.Size([8]))
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
        >>> from warmprior.training import DataOptions, load_task
        >>> load_task(DataOptions(), "navigation").title
        'navigation toy'
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
            there = tuple(style for style in styles if style in TASKS[name].official)
            if there and there != styles:
                left_out = ", ".join(style for style in styles if style not in there)
                print(f"Data: there are no official {left_out} demonstrations of {name}.", flush=True)
                styles = there
        found |= dict.fromkeys((name, style) for style in styles)
    return list(found)
