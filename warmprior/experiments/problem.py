"""What policies of any source are trained for: demonstrations, their units, and the environment."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from warmprior.data import download_mimicgen, download_robomimic, generate_demonstrations
from warmprior.data.index import DatasetIndex
from warmprior.data.opening import Demonstrations, open_demonstrations
from warmprior.data.render import renderer_versions
from warmprior.data.replay import DemonstrationReplay
from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.envs.description import environment_description, robosuite_parts
from warmprior.envs.mimicgen import find_mimicgen, is_mimicgen
from warmprior.envs.navigation1d import NavigationEnv, navigation_demonstrations
from warmprior.envs.simulator import task_env_args
from warmprior.envs.tasks import TASKS, get_task
from warmprior.experiments.labels import space_of, with_space
from warmprior.experiments.recipe import DataOptions, HeldOutOptions
from warmprior.io.files import digest_of
from warmprior.keys import ACTION, OBSERVATION, STATE
from warmprior.modules.normalize import Normalizer
from warmprior.modules.trend import RestingAction
from warmprior.transforms.absolute_actions import AbsoluteActions

__all__ = [
    "Problem",
    "find_problems",
    "navigation_problem",
    "observe",
    "robosuite_problem",
]

HELD_OUT_SEED = 50
"""Of the generated files that no training uses; training files have seed 0."""


@dataclass(frozen=True)
class Problem:
    """A task as every policy meets it.

    Attributes:
        task: short name.
        style: of the demonstrations, such as ``"ph"``.
        data: contiguous steps in normalised units, see :class:`~warmprior.ActionWindow`.
        make_env: builds the environment; one that is evaluated by episodes tells ``"success"`` and starts
            the same episode after every ``set_seed(seed)``.
        identity: of the data, which is part of the identity of every policy trained on them.
        facts: what results tell about the data, as JSON.
        normalizer: between raw and normalised units; ``None`` if they are the same.
        adapters: transforms next to the environment, as arguments of
            :func:`~warmprior.policy_transforms`.
        rest: for absolute actions, to let networks learn only what does not follow from where the grippers
            are, see :class:`~warmprior.PoseTrend`.
        clip: bound of the normalised actions that are executed, or one per dimension; ``None`` for none.
        environment: what a saved policy keeps of the environment, see
            :func:`~warmprior.envs.environment_of`.

    Raises:
        ValueError: if ``task`` or ``style`` is no name of a file.

    See Also:
        - :func:`~warmprior.experiments.robosuite_problem`: one of demonstrations in robosuite.
        - :func:`~warmprior.experiments.navigation_problem`: the toy.
        - :class:`~warmprior.experiments.Store`: trains policies on it.

    Examples:
        >>> from warmprior.envs import GoalNavigationEnv, navigation_demonstrations
        >>> problem = Problem(
        ...     "goal", "toy", navigation_demonstrations(), GoalNavigationEnv, identity="1")
        >>> problem.name, problem.vector.shape
        ('goal toy', torch.Size([384, 9]))
    """

    task: str
    style: str
    data: TensorDictBase
    make_env: Callable[..., EnvBase]
    identity: str
    facts: dict[str, Any] = field(default_factory=dict)
    normalizer: Normalizer | None = None
    adapters: Mapping[str, Transform] = field(default_factory=dict)
    rest: RestingAction | None = None
    clip: float | Sequence[float] | None = None
    environment: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for part in (self.task, self.style):
            if Path(part).name != part:
                raise ValueError(f"task and style become names of files: {part!r} cannot")

    @property
    def name(self) -> str:
        """Task, style and what is unusual, for titles."""
        source = self.facts.get("source")
        told = f"{self.task} {self.style}" + (f" ({source} data)" if source else "")
        return with_space(told, self.facts)

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
        """The spaces of actions and observations, as rows tell them: nothing of the usual ones."""
        return space_of(self.facts)


def robosuite_problem(
    path: Path | str,
    style: str = "ph",
    *,
    source: str = "file",
    observation_steps: int = 2,
    options: DataOptions | None = None,
) -> Problem:
    """The problem of demonstrations, in their own simulator.

    Args:
        path: of a robomimic HDF5 file; or ``lerobot:`` and the folder or repository of a LeRobotDataset,
            whose environment is that of ``options.task`` where it does not describe its own.
        style: of the demonstrations, such as ``"ph"``; decides the time limit of tasks of ours.

    Keyword Args:
        source: where the file comes from: ``"scripted"``, ``"official"`` or ``"file"``.
        observation_steps: ``To`` of the policies.
        options: the policies' actions and observations, and how many demonstrations to take; those of the
            file by default.

    Raises:
        DatasetError: if the file cannot be read or has fewer demonstrations, or images are to be rendered
            and it has no states.
        ValueError: if it has no pose deltas to make absolute poses of, there is no such camera, its
            environment is unknown, or a file is of another task than the one that is named.
        ImportError: if its simulator is MimicGen's, and its package is missing.

    See Also:
        - :func:`~warmprior.experiments.find_problems`: all that the options name.
        - :class:`~warmprior.envs.RobosuiteEnv`: its environment.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> import h5py
        >>> task = TASKS["lift"]
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "lift.hdf5"
        ...     with h5py.File(path, "w") as file:
        ...         widths = {f"obs/{key}": width for key, width in task.low_dim_widths.items()}
        ...         for name, width in {"actions": task.action_dim, "rewards": 1, **widths}.items():
        ...             file[f"data/demo_0/{name}"] = torch.arange(9.0)[:, None].expand(9, width).numpy()
        ...         file["data"].attrs["env_args"] = '{"env_name": "Lift", "env_kwargs": {}}'
        ...     problem = robosuite_problem(path)
        >>> problem.name, problem.vector.shape, problem.vector.amin().item(), problem.vector.amax().item()
        ('lift ph (file data)', torch.Size([9, 19]), -1.0, 1.0)
    """
    options = DataOptions() if options is None else options
    actions = options.actions
    # A generated file has as many as were asked for.
    demos = None if source == "scripted" else options.first(style)
    found = _open(path, next(iter(options.task), None))
    index = found.index()
    if demos == len(index.demos):
        demos = None  # all of them
    if not index.env_args:
        raise ValueError(
            f"{path} does not say which environment it was recorded in: name it with --task"
        )
    # Not after hours of rendering, or of training.
    if source == "file" and options.task not in ((), (task_of(index),)):
        raise ValueError(
            f"{path} holds demonstrations of {task_of(index)}, not of {options.task[0]}: leave --task out or "
            "correct it"
        )
    if is_mimicgen(index.env_args["env_name"]):
        find_mimicgen()
    dataset, images = _read(found, options, demos)
    description = environment_description(
        dataset.recorded_env_args, style, observation_steps, actions, images
    )
    make_env, adapters = robosuite_parts(description)
    # Poses in the units of deltas: an error, or a sigma, of the same size means the same in both spaces, and
    # positions, which range far, do not weigh little beside the gripper in the loss.
    absolute = adapters.get("actions")
    units = {ACTION: absolute.one_step} if isinstance(absolute, AbsoluteActions) else None
    vector = OBSERVATION if images is None else (OBSERVATION, STATE)
    normalizer = Normalizer.fit(dataset.data, (vector, ACTION), units=units)
    data = normalizer.normalize(dataset.data.exclude("next"))
    digest = found.digest(_names(images), demos)
    # Of what is usual nothing is said: policies and rows from before there was a choice have these.
    space = {} if actions == "delta" else {"actions": actions}
    seen = {} if images is None else {"obs": "image", "images": images}
    return Problem(
        task=task_of(dataset),
        style=style,
        data=data,
        make_env=make_env,
        identity=" ".join(
            [
                digest,
                # Policies of absolute poses once had a single bound, and remembered grippers wider than any.
                *(f"{name}, a bound per dimension" for name in space.values()),
                *([] if images is None else [digest_of(images, renderer_versions())]),
                *([] if demos is None else [f"the first {demos}"]),
            ]
        ),
        facts={
            "source": source,
            "file": found.name,
            "sha256": digest,
            "demonstrations": dataset.num_episodes,
            "steps": len(dataset.data),
            **space,
            **seen,
        },
        normalizer=normalizer,
        adapters=adapters,
        rest=None if absolute is None else RestingAction(dataset.pose_columns, normalizer),
        # What leaves the span of the normalised demonstrations is executed, and remembered, at the bound.
        clip=1.0 if absolute is None else data[ACTION].abs().amax(0).tolist(),
        environment=description,
    )


def _open(place: Path | str, task: str | None) -> Demonstrations:
    """The demonstrations at a place; the task's environment is theirs where they do not say."""
    return open_demonstrations(place, task_env_args(task) if task in TASKS else None)


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


def navigation_problem() -> Problem:
    """The one-dimensional navigation toy (Fig. 5).

    See Also:
        - :class:`~warmprior.envs.NavigationEnv`: its environment.
        - :func:`~warmprior.envs.navigation_demonstrations`: its data.

    Examples:
        >>> problem = navigation_problem()
        >>> problem.name, problem.make_env(batch_size=[8]).batch_size
        ('navigation toy', torch.Size([8]))
    """
    return Problem(
        "navigation", "toy", navigation_demonstrations(), NavigationEnv, "navigation1d", {}
    )


def task_of(dataset: DemonstrationReplay | DatasetIndex) -> str:
    """Short name of a dataset's task, or the environment's where it is none of ours."""
    task = dataset.task
    return str(dataset.env_args["env_name"]).lower() if task is None else task.name


def find_problems(options: DataOptions, observation_steps: int = 2) -> list[Problem]:
    """Read, download or generate the demonstrations of every task and style.

    Args:
        options: which.
        observation_steps: ``To`` of the policies.

    Raises:
        ValueError: if a file is of another task than the one that is named.

    See Also:
        - :func:`~warmprior.experiments.robosuite_problem`: a single file.
        - :class:`~warmprior.experiments.Store`: trains on a problem.

    Examples:
        >>> [problem.name for problem in find_problems(DataOptions(task=("lift", "can")))]  # doctest: +SKIP
        Data: 150 ph scripted demonstrations per task. ...
        ['lift ph (scripted data)', 'can ph (scripted data)']
        >>> find_problems(DataOptions(data=("core",)))
        Traceback (most recent call last):
            ...
        ValueError: --data core is that of MimicGen's files: add --download, or --dataset FILE
    """
    options.check()
    if options.dataset is not None:
        return [
            robosuite_problem(
                options.dataset,
                options.data[0],
                observation_steps=observation_steps,
                options=options,
            )
        ]
    if not options.download:
        counts = ", ".join(f"{options.count(style)} {style}" for style in options.data)
        print(
            f"Data: {counts} scripted demonstrations per task. They stand in for the official human data "
            "(--download); success rates on them are not comparable with the paper's.",
            flush=True,
        )
    problems = []
    for task in dict.fromkeys(options.task or ("square",)):
        for style in dict.fromkeys(options.data):
            if options.download:
                theirs = is_mimicgen(get_task(task).env_name)
                download = download_mimicgen if theirs else download_robomimic
                path = download(task, style, force=options.force_download)
                source = "official"
            else:
                path = generate_demonstrations(task, style, options.count(style))
                source = "scripted"
            problems.append(
                robosuite_problem(
                    path,
                    style,
                    source=source,
                    observation_steps=observation_steps,
                    options=options,
                )
            )
    return problems


def observe(
    options: HeldOutOptions,
    facts: Mapping[str, Any],
    normalizer: Normalizer,
    *,
    chunk_length: int,
    observation_steps: int,
    device: str = "cpu",
) -> tuple[SharedObservations, str]:
    """Draw observations, normalised as policies were trained, and say what they are.

    Args:
        options: which.
        facts: of the problem: ``task``, ``style``, and those of the data.
        normalizer: of the policies.

    Keyword Args:
        chunk_length: ``H``.
        observation_steps: ``To``.
        device: where to keep them.

    Raises:
        ValueError: if there are no demonstrations to hold out, or they are of another task.

    See Also:
        - :func:`~warmprior.diagnostics.curvature`: a measure on them.
        - :func:`~warmprior.experiments.finished_policies`: the policies.

    Examples:
        >>> told = {"task": "lift", "style": "ph", "source": "official", "file": "low_dim_v15.hdf5"}
        >>> normalizer = Normalizer.fit(navigation_demonstrations(), ("observation", "action"))
        >>> observe(HeldOutOptions(), told, normalizer, chunk_length=8, observation_steps=2)
        Traceback (most recent call last):
            ...
        ValueError: these policies are trained on demonstrations of low_dim_v15.hdf5: add --validation ...
    """
    task, style = facts["task"], facts["style"]
    if options.validation is not None:
        found = _open(options.validation, task)
        told = found.name
        demos = min(facts["demonstrations"], len(found.index().demos))
        if found.digest(_names(facts.get("images")), demos) == facts["sha256"]:
            told = "the TRAINING demonstrations (not held out)"
    elif facts["source"] != "scripted":
        raise ValueError(
            f"these policies are trained on demonstrations of {facts['file']}: add --validation FILE "
            "with others (or with the same file, to measure on the training data)"
        )
    else:
        # As many as the training demonstrations suggest, with room to spare.
        mean_steps = facts["steps"] / facts["demonstrations"]
        usable = max(1.0, min(50.0, 0.8 * (mean_steps - chunk_length)))
        n = max(20, int(-(-options.observations // usable)))
        found = _open(generate_demonstrations(task, style, n, HELD_OUT_SEED), None)
        told = f"{n} newly generated demonstrations"
    theirs = task_of(found.index())
    if theirs != task:  # before images are rendered
        raise ValueError(
            f"--validation {found.name} holds demonstrations of {theirs}, but these policies are for {task}"
        )
    images = facts.get("images")
    seen: dict[str, Any] = {}
    if images is not None:
        seen = {
            "obs": "image",
            "cameras": tuple(images["cameras"]),
            "image_size": images["size"],
            "fast_rendering": images["fast_rendering"],
        }
    dataset, _ = _read(found, DataOptions(actions=facts.get("actions", "delta"), **seen))
    # A copy: the data are normalised on the CPU, the policy may live elsewhere.
    normalizer = copy.deepcopy(normalizer).to("cpu")
    shared = SharedObservations(
        normalizer.normalize(dataset.data.exclude("next")).to(device),
        chunk_length,
        observation_steps=observation_steps,
        count=options.observations,
        generator=torch.Generator().manual_seed(0),
    )
    return shared, told
