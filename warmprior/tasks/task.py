"""Tasks: demonstrations, their units, and the environment that plays episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self, get_args

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from warmprior.checks import check_choice, check_keys, check_whole_numbers, given
from warmprior.io.files import digest_of
from warmprior.keys import ACTION, CHUNK, EPISODE, OBSERVATION, STATE, SUCCESS
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.normalize import Normalizer, bound_of
from warmprior.modules.prior import GaussianPrior, Prior
from warmprior.modules.trend import RestingAction, RestingJoints
from warmprior.saving.checkpoint import data_digest
from warmprior.transforms.absolute_actions import Actions
from warmprior.transforms.chunk import Measures, check_measures
from warmprior.transforms.policy import PolicyEnv, policy_transforms


@dataclass(frozen=True)
class Task:
    """A task: demonstrations, and the environment in which policies trained on them are played.

    Build one from raw demonstrations with :meth:`of`, or from a file or dataset with :meth:`open`.

    Attributes:
        name: short name, such as ``"square"``.
        style: style of the demonstrations, such as ``"ph"``.
        data: contiguous steps in normalised units, see :class:`~warmprior.ActionWindow`.
        make_env: builds the environment in which episodes are played, called without arguments: a TorchRL
            environment without batch dimensions, in raw units, with ``"observation"`` ``[d_o]`` and
            ``"action"`` ``[d_a]``, that starts the same episode after every ``set_seed(seed)``.
        normalizer: converts between raw and normalised units; ``None`` if they are the same.
        success: the environment's key of a flag that is True once the task is solved, bool ``[1]``.
        measures: further keys that episodes report, each with the way in which its values are combined:
            ``"max"``, ``"sum"`` or ``"last"``.
        video_rate: control steps per second of videos. The environment then needs a method ``render`` that
            returns a picture, uint8 ``[h, w, 3]``. ``None`` for no videos, except with environments that are
            opened by name.
        facts: facts about the data for results, as JSON.
        adapters: transforms directly after the environment, as arguments of
            :func:`~warmprior.policy_transforms`.
        rest: the resting action, for absolute poses and joint targets, see :class:`~warmprior.PoseTrend`.
        clip: bound of the normalised actions that are executed, or one per dimension; ``None`` for no bound.
        environment: the description of the environment that a saved policy keeps, see
            :func:`~warmprior.envs.environment_of`.
        digest: digest of the data; computed by default.

    Raises:
        ValueError: if ``name`` or ``style`` cannot be part of a file name, or a measure is combined in
            another way.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> from warmprior.tasks import Task
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> task = Task.of("pendulum", TensorDict(steps, [60]), lambda: GymEnv("Pendulum-v1"))
        >>> round(task.data["action"].amax().item(), 3), task.facts["demonstrations"]
        (1.0, 3)
    """

    name: str
    style: str
    data: TensorDictBase
    make_env: Callable[..., EnvBase]
    normalizer: Normalizer | None = None
    success: NestedKey = SUCCESS
    measures: Measures = field(default_factory=dict)
    video_rate: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    adapters: Mapping[str, Transform] = field(default_factory=dict)
    rest: RestingAction | None = None
    clip: float | Sequence[float] | None = None
    environment: Mapping[str, Any] | None = None
    digest: str | None = None

    def __post_init__(self) -> None:
        for part in (self.name, self.style):
            if Path(part).name != part:
                raise ValueError(f"name and style become parts of file names, which cannot hold {part!r}")
        check_measures(self.measures)

    @classmethod
    def of(
        cls,
        name: str,
        data: TensorDictBase,
        make_env: Callable[..., EnvBase] | None = None,
        *,
        style: str = "human",
        success: NestedKey = SUCCESS,
        measures: Measures | None = None,
        video_rate: int | None = None,
    ) -> Self:
        """Build a task from raw demonstrations; the normaliser is fitted to them.

        Arguments are as the attributes, except ``data``: contiguous steps ``[N]`` in raw units, with
        ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]`` and ``"episode"``, an integer ``[N]``. With
        images, ``"observation"`` has the entries ``"state"`` ``[N, d_o]`` and each image, uint8
        ``[N, 3, size, size]``. Without ``make_env``, policies can be trained but not played.

        Raises:
            KeyError: if the data lack an entry.
            ValueError: if an entry has another shape, or is not finite.
        """
        if data.ndim != 1:
            raise ValueError(f"the demonstrations of {name} must be flat steps [N], got {tuple(data.shape)}")
        needed = (OBSERVATION, ACTION, EPISODE)
        check_keys(data, needed, f"the demonstrations of {name}", f": they have {list(data.keys())}")
        vector: NestedKey = OBSERVATION
        if isinstance(data[OBSERVATION], TensorDictBase):
            vector = (OBSERVATION, STATE)
            check_keys(data, [vector], f"the demonstrations of {name}", ", the robot's state next to images")
            sizes: set[int] = set()
            for key, image in data[OBSERVATION].exclude(STATE).items():
                sizes.update(image.shape[2:])
                if image.dtype != torch.uint8 or image.ndim != 4 or image.shape[1] != 3 or len(sizes) > 1:
                    raise ValueError(
                        f"{key!r} of {name} has shape {tuple(image.shape)} of {image.dtype}, but images must "
                        "be uint8 [N, 3, size, size], of one size for all cameras: crop or resize them"
                    )
        for key, shape in ((vector, "[N, d]"), (ACTION, "[N, d]"), (EPISODE, "[N]")):
            value = data[key]
            found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else "text"
            if found == "text" or value.is_complex() or value.ndim != len(shape.split()):
                raise ValueError(f"{key!r} of {name} must be real numbers {shape}, got {found}")
        if data[EPISODE].is_floating_point() or bool((data[EPISODE] < 0).any()):
            raise ValueError(f"{EPISODE!r} of {name} must be whole numbers from 0 on, got {found}")
        normalizer = Normalizer.fit(data, (vector, ACTION))
        data = normalizer.normalize(data.select(OBSERVATION, ACTION, EPISODE))
        return cls(
            name,
            style,
            data,
            make_env or _no_environment,
            normalizer,
            success=success,
            measures=measures or {},
            video_rate=video_rate,
            facts={"demonstrations": len(data[EPISODE].unique()), "steps": len(data)},
            clip=bound_of(data[ACTION]),
        )

    @classmethod
    def open(
        cls,
        place: str | Path,
        make_env: Callable[..., EnvBase] | None = None,
        *,
        task: str | None = None,
        style: str | None = None,
        actions: Actions = "delta",
        observation_keys: Sequence[str] | None = None,
        joint_key: str | None = None,
        image_keys: Sequence[str] = (),
        fast_rendering: bool = False,
        mask: str | None = None,
        demos: int | None = None,
        horizon: int | None = None,
        success: NestedKey | None = None,
        measures: Measures | None = None,
        video_rate: int | None = None,
    ) -> Self:
        """Build a task from a file or dataset, with the environment that recorded it if that is known.

        Args:
            place: a robomimic HDF5 file; ``lerobot:`` and the folder or repository of a LeRobotDataset; or
                ``minari:`` and the name of a Minari dataset.
            make_env: builds another environment than the recorded one, see :meth:`of`.

        Keyword Args:
            task: task of robosuite, for a LeRobotDataset that does not describe its environment.
            style: style of the demonstrations, which decides robosuite's time limit: ``"ph"`` by default,
                and ``"human"`` outside robosuite.
            actions: the policies' actions: pose deltas as recorded, or the absolute poses that these target.
            observation_keys: observations to concatenate; by default the task's, or those that the reader of
                this format chooses (:doc:`/data`).
            joint_key: the observation whose numbers the actions set, one by one, such as joint positions;
                actions beyond its width are not targets (see :meth:`with_joints`).
            image_keys: images that policies see in addition to the robot's state, such as
                ``"agentview_image"``; in a LeRobotDataset ``"front_image"`` stands for
                ``"observation.images.front"``. None by default.
            fast_rendering: True if the images have no reflections, shadows and smooth edges.
            mask: a mask of the file, such as ``"train"``.
            demos: number of demonstrations to take, from the first on; all by default.
            horizon: control steps per episode; by default the environment's own, or that of the style.
            success: see :meth:`of`; only with a ``make_env``, like the next two.
            measures: see :meth:`of`.
            video_rate: see :meth:`of`.

        Raises:
            FileNotFoundError: if there is no such file or dataset.
            OSError: if a download fails.
            DatasetError: if the data are invalid, or their images differ from the simulator's.
            ValueError: if the file holds another task, its actions are not near ``joint_key``, or an option
                is unknown or for another environment.

        Examples:
            >>> from warmprior.tasks import Task
            >>> Task.open("square.hdf5", mask="train").name  # doctest: +SKIP
            'square'
        """
        # Imported here, since training on a TensorDict needs no reader and no simulator.
        from warmprior.data.demonstrations import name_of_place
        from warmprior.data.images import renderer_versions
        from warmprior.envs.description import registered_description
        from warmprior.envs.gymnasium import registered_env
        from warmprior.tasks import recorded as files

        check_choice("actions", actions, get_args(Actions))
        outcome = given(success=success, measures=measures, video_rate=video_rate)
        if outcome and make_env is None:
            raise ValueError(f"{', '.join(outcome)} of an environment of your own: pass its make_env as well")
        if fast_rendering and not image_keys:
            raise ValueError("fast_rendering belongs to images: name image_keys, or leave it out")
        demonstrations = files.opened(place, task, mask)
        image_keys = demonstrations.image_keys(image_keys)
        index = demonstrations.index(observation_keys=observation_keys)
        if make_env is not None or not index.env_args:
            environment = None if make_env is not None or image_keys else demonstrations.environment()
            others = {
                "actions": actions != "delta",
                "fast_rendering": fast_rendering,
                "task": task is not None and not index.env_args,
                "horizon": horizon is not None and environment is None,
            }
            if unused := [name for name, given in others.items() if given]:
                known = "the demonstrations name none" if make_env is None else "make_env replaces it"
                raise ValueError(
                    f"{place}: {', '.join(unused)} would change a recorded environment, but {known}: leave "
                    "out what cannot be applied"
                )
            storage = "memmap" if image_keys else "memory"
            chosen: dict[str, Any] = {"observation_keys": observation_keys, "image_keys": image_keys}
            replay = demonstrations.replay(demos=demos, storage=storage, **chosen)
            opened = cls.of(name_of_place(place), replay.data, make_env, style=style or "human", **outcome)
            if joint_key is not None:
                opened = opened.with_joints(replay.joint_columns(joint_key))
            facts: dict[str, Any] = opened.facts | {"source": "file", "file": demonstrations.name}
            if environment is None:
                return replace(opened, facts=facts)
            environment |= {"observation_keys": list(index.observation_keys)}
            environment |= given(max_episode_steps=horizon)
            description = registered_description(environment)
            # Unknown wrappers raise an error only when it is built, which training does not need.
            recorded: Any = partial(registered_env, environment)
            return replace(opened, facts=facts, make_env=recorded, environment=description)
        style, cameras = style or "ph", [key.removesuffix("_image") for key in image_keys]
        if demos == len(index.demos):
            demos = None  # all of them
        name = files.task_name(index)
        if task not in (None, name):
            raise ValueError(f"{place} holds demonstrations of {name}, not of {task}: correct the task")
        dataset, images = files.read_steps(
            demonstrations,
            absolute_actions=actions == "absolute",
            observation_keys=observation_keys,
            cameras=cameras,
            fast_rendering=fast_rendering,
            demos=demos,
        )
        recorded = files.recorded_task(dataset, images, style=style, actions=actions, horizon=horizon)
        sha256 = demonstrations.digest(observation_keys=observation_keys, image_keys=image_keys, demos=demos)
        # The default is left out.
        space: dict[str, Any] = {} if actions == "delta" else {"actions": actions}
        space |= {} if images is None else {"obs": "image", "images": images}
        space |= {} if observation_keys is None else {"observation_keys": list(observation_keys)}
        facts = {"source": "file", "file": demonstrations.name, "sha256": sha256}
        facts |= {"demonstrations": dataset.num_episodes, "steps": len(dataset.data), **space}
        # Images depend on the installed renderer.
        digest = digest_of(sha256, demos, space, images and renderer_versions())
        made = cls(name, style, facts=facts, digest=digest, **recorded)
        return made if joint_key is None else made.with_joints(dataset.joint_columns(joint_key))

    def with_joints(self, columns: Sequence[int]) -> Self:
        """Return a task whose actions are absolute targets for observed numbers, such as joint positions.

        A preconditioned network then learns the motion from there (:class:`~warmprior.RestingJoints`).

        Args:
            columns: for each action the index in the observation of the number that it sets, in the same
                units; -1 for an action that is not a target.

        Raises:
            ValueError: if an index is out of range, or actions are not near the numbers they set.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from warmprior.tasks import Task
            >>> joints = torch.rand(60, 3)
            >>> steps = {"observation": joints, "action": joints[:, 1:] + 0.01}
            >>> steps = TensorDict(steps | {"episode": torch.arange(60) // 20}, [60])
            >>> task = Task.of("arm", steps).with_joints([1, 2])
            >>> task.rest.columns.tolist()
            [1, 2]
        """
        columns = list(columns)
        actions, width = self.data[ACTION], self.vector.shape[-1]
        if self.rest is not None or self.normalizer is None:
            raise ValueError(
                f"{self.name} has a resting action already, or no normaliser: joint targets need the "
                "recorded actions (leave out actions='absolute')"
            )
        check_whole_numbers(-1, **{f"column {i}": column for i, column in enumerate(columns)})
        if len(columns) != actions.shape[-1] or not -1 < max(columns) < width:
            raise ValueError(
                f"columns must be {actions.shape[-1]} numbers from -1 to {width - 1}, not all -1, got "
                f"{columns}"
            )
        rest = RestingJoints(torch.tensor(columns), self.normalizer)
        worst = rest.farthest(self.vector, actions)
        if worst is not None:
            raise ValueError(
                f"actions of {self.name} are not near the observed numbers they should set, least of all "
                f"action {worst} (number {columns[worst]} of the observation): use the same order and units"
            )
        return replace(self, rest=rest)

    def env(
        self,
        policy: WarmPriorActor | Prior,
        base: EnvBase | None = None,
        *,
        execute: int | None = None,
        delay: int | None = None,
        **options: Any,
    ) -> TransformedEnv:
        """Return the environment with a policy's transforms.

        Args:
            policy: the policy, or its prior.
            base: an environment of the task; by default the one that ``make_env(**options)`` builds.

        Keyword Args:
            execute: see :func:`~warmprior.policy_transforms`.
            delay: see :func:`~warmprior.policy_transforms`.
            **options: options of ``make_env``.
        """
        transforms = policy_transforms(
            policy,
            normalizer=self.normalizer,
            **self.adapters,
            execute=execute,
            delay=delay,
            success=self.success,
            measures=self.measures,
        )
        return PolicyEnv(base or self.make_env(**options), transforms)

    def check_environment(self, **options: Any) -> None:
        """Build the environment, reset it and step once with a recorded action, without training.

        Args:
            **options: options of ``make_env``.

        Raises:
            ImportError: if the environment is not installed, or its images cannot be rendered here.
            ValueError: if the environment cannot be played, or does not fit the demonstrations.
        """
        env: EnvBase | None = None
        try:
            env = base = self.make_env(**options)
            env = self.env(GaussianPrior(1), base)
            present = list(base.observation_spec.keys(True, True))
            for key in (self.success, *self.measures):
                if key not in present:
                    raise ValueError(f"it does not write {key!r} next to its reward: it writes {present}")
            specs = dict(env.observation_spec.items(True, True)) | {ACTION: env.full_action_spec[CHUNK]}
            for key, value in self.data.select(OBSERVATION, ACTION).items(True, True):
                found = _form(specs[key]) if key in specs else "missing"
                if found != (expected := _form(value)):
                    raise ValueError(f"its {key!r} is {found}, but that of the demonstrations {expected}")
            env.set_seed(0)
            env.step(env.reset().set(CHUNK, self.data[ACTION][:1].to("cpu")))
        except Exception as error:  # the simulator or the user's code can raise anything
            reason = error.args[0] if isinstance(error, KeyError) and error.args else error
            file = f" ({self.facts['file']})" if "file" in self.facts else ""
            kind = ImportError if isinstance(error, ImportError) else ValueError
            raise kind(
                f"the environment of {self.name} {self.style}{file} cannot be played: {reason}"
            ) from error
        finally:
            if env is not None:
                env.close()

    def split(self, held_out: int) -> tuple[Self, TensorDictBase | None]:
        """Return the task without its last demonstrations, and their normalised steps, in unchanged units.

        Raises ValueError if no demonstration would be left.
        """
        check_whole_numbers(0, held_out=held_out)
        if not held_out:
            return self, None
        episode = self.data[EPISODE]
        numbers = episode.unique()
        if held_out >= len(numbers):
            raise ValueError(f"held_out={held_out} of {len(numbers)} demonstrations leaves none to train on")
        kept = torch.isin(episode, numbers[:-held_out])
        data = self.data[kept]
        facts = self.facts | {"demonstrations": len(numbers) - held_out, "steps": len(data)}
        digest = None if self.digest is None else digest_of(self.digest, held_out)
        return replace(self, data=data, facts=facts, digest=digest), self.data[~kept]

    @cached_property
    def identity(self) -> str:
        """A digest of the data, part of the identity of every policy trained on them."""
        joints = [self.rest.columns.tolist()] if isinstance(self.rest, RestingJoints) else []
        if self.digest:
            return digest_of(self.digest, joints) if joints else self.digest
        # Data in other units may be equal after normalisation.
        units = self.normalizer.state_dict() if self.normalizer else {}
        data = data_digest(self.data.select(OBSERVATION, ACTION, EPISODE))
        return digest_of(data, {key: value.tolist() for key, value in units.items()}, *joints)

    @property
    def vector(self) -> Tensor:
        """The observation, or its vector if it has images, ``[N, d]``."""
        observation = self.data[OBSERVATION]
        return observation[STATE] if isinstance(observation, TensorDictBase) else observation

    @property
    def images(self) -> dict[str, int]:
        """The names of the observation's images, and their sides in pixels."""
        observation = self.data[OBSERVATION]
        if not isinstance(observation, TensorDictBase):
            return {}
        return {name: int(value.shape[-1]) for name, value in observation.items() if name != STATE}


def _form(entry: Tensor | TensorSpec) -> str:
    """Return the shape of an entry of stacks, chunks or steps, and the type of images."""
    return f"{list(entry.shape[1:])}{' of uint8' if entry.dtype == torch.uint8 else ''}"


def _no_environment() -> EnvBase:
    raise ValueError("these demonstrations have no environment: give Task.of a function that builds one")
