"""Tasks: what is learnt from demonstrations, and how it is played."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, get_args

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from warmprior.checks import check_choice, check_whole_numbers
from warmprior.io.files import digest_of
from warmprior.keys import ACTION, CHUNK, EPISODE, OBSERVATION, STATE, SUCCESS
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.normalize import Normalizer, bound_of
from warmprior.modules.prior import GaussianPrior, Prior
from warmprior.modules.recording import AS_RECORDED
from warmprior.modules.trend import RestingAction, RestingJoints, RestingPose
from warmprior.options.data import Actions
from warmprior.saving.training_state import data_digest
from warmprior.transforms.chunk import Measures, check_measures
from warmprior.transforms.policy import PolicyEnv, policy_transforms

if TYPE_CHECKING:  # to import a task takes no reader
    from warmprior.data.demonstrations import Demonstrations
    from warmprior.data.index import DatasetIndex


@dataclass(frozen=True)
class Play:
    """How policies of a task are played; by default as the demonstrations were recorded.

    Attributes:
        make_env: builds the environment in which episodes are played, in place of the recorded one; called
            without arguments: a TorchRL environment without batch dimensions, in raw units, with
            ``"observation"`` ``[d_o]`` and ``"action"`` ``[d_a]``, that starts the same episode after every
            ``set_seed(seed)``.
        horizon: time limit in control steps; by default the recorded environment's own, or robosuite's for
            the style.
        success: the key of a flag of ``make_env``'s environment that is True once the task is solved, bool
            ``[1]``.
        measures: further keys that its episodes report, each with the way in which its values are combined:
            ``"max"``, ``"sum"`` or ``"last"``.
        video_rate: control steps per second of its videos. The environment then needs a method ``render``
            that returns a picture, uint8 ``[h, w, 3]``. ``None`` for no videos, except of environments that
            are opened by name.
        fast_rendering: True if robosuite's images have no reflections, shadows and smooth edges.

    Raises:
        ValueError: if a measure is combined in another way, or an option belongs to another environment.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from warmprior.tasks import Play
        >>> Play(lambda: GymEnv("Pendulum-v1"), measures={"reward": "sum"}).success
        'success'
    """

    make_env: Callable[..., EnvBase] | None = None
    horizon: int | None = None
    success: NestedKey = SUCCESS
    measures: Measures = field(default_factory=dict)
    video_rate: int | None = None
    fast_rendering: bool = False

    def __post_init__(self) -> None:
        check_measures(self.measures)
        own = {"success": self.success != SUCCESS, "measures": self.measures, "video_rate": self.video_rate}
        if self.make_env is None and (named := [name for name, value in own.items() if value]):
            raise ValueError(f"{', '.join(named)} of an environment of your own: pass its make_env as well")


def _no_environment() -> EnvBase:
    raise ValueError("these demonstrations have no environment: give Play a function that builds one")


@dataclass(frozen=True)
class RecordedEnvironment:
    """A record of what is known of the environment in which demonstrations were recorded.

    Attributes:
        index: the demonstrations, with the observations that policies see.
        name: short name of the task.
        style: style of the demonstrations.
        make_env: builds it.
        description: the description that a saved policy keeps, see :func:`~warmprior.envs.environment_of`;
            ``None`` if it is unknown.
        adapters: transforms directly after it, as arguments of :func:`~warmprior.policy_transforms`.
        units: raw sizes of one normalised unit, see :meth:`Normalizer.fit`.
        poses: the columns of grippers' poses, if actions are absolute poses.
        facts: facts about the data for results.
        digest: digest of the data, if that of the values is not to be computed.
    """

    index: DatasetIndex
    name: str
    style: str
    make_env: Callable[..., EnvBase] = _no_environment
    description: Mapping[str, Any] | None = None
    adapters: Mapping[str, Transform] = field(default_factory=dict)
    units: Mapping[NestedKey, Tensor] | None = None
    poses: Tensor | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    digest: str | None = None


class Task:
    """A task: what is learnt from demonstrations, and how it is played.

    Args:
        demonstrations: the demonstrations, see :func:`~warmprior.data.open_demonstrations`, and
            :func:`~warmprior.data.demonstrations_of` for steps in memory. A normaliser is fitted to them.

    Keyword Args:
        observations: observations to concatenate; by default the task's, or those that the format chooses
            (:doc:`/data`).
        images: images that policies see in addition to the robot's state, such as ``"agentview_image"``; in a
            LeRobotDataset ``"front_image"`` stands for ``"observation.images.front"``. None by default.
        joints: for absolute joint targets, the observation whose numbers the actions set, one by one; actions
            beyond its width are not targets. Or for each action the index in the observation of the number
            that it sets, in the same units, -1 for none. A preconditioned network then learns the motion from
            there (:class:`~warmprior.RestingJoints`). By default ``"observation.state"`` if a LeRobotDataset
            gives it the names of the actions, and the numbers are near; ``""`` for none.
        actions: the policies' actions: as recorded, or the absolute poses that robosuite's deltas target.
        play: how policies are played; by default as the demonstrations were recorded, if that is known.

    Attributes:
        name: short name, such as ``"square"``.
        style: style of the demonstrations, such as ``"ph"``.
        data: contiguous steps in normalised units, see :class:`~warmprior.ActionWindow`.
        make_env: builds the environment in which episodes are played.
        normalizer: converts between raw and normalised units; ``None`` if they are the same.
        facts: facts about the data for results, as JSON.
        recording: what policies see, what is left out, and what their actions are.
        adapters: transforms directly after the environment, as arguments of
            :func:`~warmprior.policy_transforms`.
        rest: the resting action, for absolute poses and joint targets, see :class:`~warmprior.RestingTrend`.
        resize: how the images were resized, see :func:`~warmprior.modules.resize.resized`.
        clip: bound of the normalised actions that are executed, or one per dimension; ``None`` for no bound.
        environment: the description of the environment that a saved policy keeps, see
            :func:`~warmprior.envs.environment_of`; ``None`` if it is not a recorded one.
        digest: digest of the data; ``None`` for that of their values.

    Raises:
        FileNotFoundError: if there is no such file or dataset.
        OSError: if a download fails.
        DatasetError: if the data are invalid, their images differ from the simulator's, or an observation
            that was not named holds the action of the same or a later step.
        ValueError: if name or style cannot be part of a file name, the place holds another task, its actions
            are not near the joints, or an option is unknown or for another environment.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> from warmprior.data import demonstrations_of
        >>> from warmprior.tasks import Play, Task
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> demonstrations = demonstrations_of(TensorDict(steps, [60]), "pendulum")
        >>> task = Task(demonstrations, play=Play(lambda: GymEnv("Pendulum-v1")))
        >>> round(task.data["action"].amax().item(), 3), task.facts["demonstrations"]
        (1.0, 3)
        >>> joints = torch.rand(60, 3)
        >>> steps |= {"observation": joints, "action": joints[:, 1:] + 0.01}
        >>> arm = Task(demonstrations_of(TensorDict(steps, [60])), joints=[1, 2])
        >>> arm.rest.columns.tolist()
        [1, 2]
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        *,
        observations: Sequence[str] | None = None,
        images: Sequence[str] = (),
        joints: str | Sequence[int] | None = None,
        actions: Actions = "delta",
        play: Play | None = None,
    ) -> None:
        from warmprior.data.demonstrations import Demonstrations

        if not isinstance(demonstrations, Demonstrations):
            kind = type(demonstrations).__name__
            raise TypeError(
                f"a task takes open_demonstrations(place) or demonstrations_of(steps), not {kind}"
            )
        for option, names in (("observations", observations), ("images", images)):
            if isinstance(names, str):
                raise TypeError(f"{option} must be a list of names, such as [{names!r}]")
        check_choice("actions", actions, get_args(Actions))
        self.play = play = play or Play()
        if play.fast_rendering and not images:
            raise ValueError("fast_rendering belongs to images: name them, or leave it out")
        index, recorded = demonstrations.index(observations), None
        if play.make_env is None and (described := demonstrations.environment(index)):
            # Imported here, since training itself needs no simulator.
            from warmprior.tasks.recorded import KINDS

            ((kind, environment),) = described.items()
            recorded = KINDS[kind](
                demonstrations, index, environment, observations, images, actions=actions, play=play
            )
        if recorded is None:
            style = demonstrations.style or "human"
            index = demonstrations.index(observations, images)
            recorded = RecordedEnvironment(index, demonstrations.title, style)
        index, self.environment = recorded.index, recorded.description
        if not index.image_keys and (demonstrations.image_size, demonstrations.resize) != (None, "squeeze"):
            raise ValueError("image_size and resize belong to images: name them, or leave both out")
        is_robosuite = self.environment is not None and index.env_args
        others = {
            "actions": actions != "delta" and not is_robosuite,
            "fast_rendering": play.fast_rendering and not is_robosuite,
            "task": demonstrations.task is not None and not index.env_args,
            "horizon": play.horizon is not None and self.environment is None,
        }
        if unused := [name for name, given in others.items() if given]:
            known = "the demonstrations name none" if play.make_env is None else "make_env replaces it"
            raise ValueError(
                f"{demonstrations}: {', '.join(unused)} would change a recorded environment, but {known}: "
                "leave out what cannot be applied"
            )
        read = partial(demonstrations.steps, index.observation_keys, actions=actions)
        steps = read(())
        if observations is None:
            demonstrations.check_targets(index, steps, joints)  # who names the joints wants them
        targets = index.joints if joints is None else joints
        columns = index.joint_columns(targets) if isinstance(targets, str) and targets else [*targets]
        if index.image_keys:  # what takes long comes last
            steps = read(index.image_keys, storage="memmap")
        self.resize, self.name, self.style = index.resize, recorded.name, recorded.style
        for part in (self.name, self.style):
            if Path(part).name != part:
                raise ValueError(f"name and style become parts of file names, which cannot hold {part!r}")
        self.data, vector = steps.select(OBSERVATION, ACTION, EPISODE), index.vector_key
        self.normalizer: Normalizer | None = None
        self.clip: float | Sequence[float] | None = None
        if not demonstrations.normalised:
            widths = zip(index.observation_keys, index.observation_dims, strict=True)
            columns_of = {vector: [f"{key} [{i}]" for key, width in widths for i in range(width)]}
            self.normalizer = Normalizer.fit(steps, (vector, ACTION), units=recorded.units, names=columns_of)
            self.data = self.normalizer.normalize(self.data)
            self.clip = bound_of(self.data[ACTION])
        self.make_env = play.make_env or recorded.make_env
        self.adapters, self.digest = recorded.adapters, recorded.digest
        counts = {"demonstrations": len(index.demos), "steps": len(self.data)}
        self.facts: dict[str, Any] = {**counts, **demonstrations.facts, **recorded.facts}
        self.rest: RestingAction | None = None
        words = AS_RECORDED if self.environment is None else ", as the recorded environment takes them"
        if recorded.poses is not None:
            self.rest, words = RestingPose(recorded.poses, self.normalizer), ", absolute poses"
        if columns and (joint_targets := self._joints(columns, needed=joints is not None)):
            self.rest, words = joint_targets, f", absolute targets of {targets}"
        observed = steps[vector].split(list(index.observation_dims), -1)
        parts = {**dict(zip(index.observation_keys, observed, strict=True)), ACTION: steps[ACTION]}
        ranges = {name: part.aminmax() for name, part in parts.items() if part.numel()}
        self.recording = replace(
            demonstrations.recording(index, f"[{self.data[ACTION].shape[-1]}]{words}"),
            ranges={name: [float(end) for end in ends] for name, ends in ranges.items()},
            sizes=dict(zip(index.image_keys, index.image_shapes, strict=True)),
        )

    def _joints(self, columns: list[int], needed: bool) -> RestingJoints | None:
        """Return the resting action of joint targets, if actions are near the joints; else ``None``."""
        actions, width = self.data[ACTION], self.vector.shape[-1]
        if self.rest is not None or self.normalizer is None:
            raise ValueError(
                f"{self.name} has a resting action already, or no normaliser: joint targets need the "
                "recorded actions (leave out actions='absolute')"
            )
        check_whole_numbers(-1, **{f"column {i}": column for i, column in enumerate(columns)})
        if len(columns) != actions.shape[-1] or not -1 < max(columns) < width:
            raise ValueError(
                f"joints must be {actions.shape[-1]} numbers from -1 to {width - 1}, not all -1, got "
                f"{columns}"
            )
        rest = RestingJoints(torch.tensor(columns), self.normalizer)
        worst = rest.farthest(self.vector, actions)
        if worst is not None and needed:
            raise ValueError(
                f"actions of {self.name} are not near the observed numbers they should set, least of all "
                f"action {worst} (number {columns[worst]} of the observation): use the same order and units"
            )
        return rest if worst is None else None

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
            success=self.play.success,
            measures=self.play.measures,
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
            for key in (self.play.success, *self.play.measures):
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
        mask = torch.isin(episode, numbers[:-held_out])
        kept: Any = mask
        left_out: Any = ~mask
        if mask[: (first := int(mask.sum()))].all():  # views, so that images stay on the disk
            kept, left_out = slice(first), slice(first, None)
        part = copy.copy(self)
        part.__dict__.pop("identity", None)
        part.data = self.data[kept]
        sizes: dict[str, Any] = {"demonstrations": len(numbers) - held_out, "steps": len(part.data)}
        part.facts = self.facts | sizes
        part.recording = replace(self.recording, **sizes, held_out=held_out)
        part.digest = None if self.digest is None else digest_of(self.digest, held_out)
        return part, self.data[left_out]

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
