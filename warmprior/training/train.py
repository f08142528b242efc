"""Training of a policy for a task and a source: preconditioning, fresh weights and behaviour cloning."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.record.loggers.common import Logger
from tqdm import tqdm

from warmprior import keys
from warmprior.checks import check_device
from warmprior.io.distributed import rank, wait_for_leader, world_size
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import StartPoint, WarmPriorActor
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import Prior
from warmprior.modules.trend import RestingAction, RestingJoints, RestingTrend
from warmprior.objectives.couplings import Coupling
from warmprior.options.training import NetworkOptions, TrainingConfig
from warmprior.saving.policies import load_policy
from warmprior.tasks.task import Task
from warmprior.training.cloning import BehaviourCloning
from warmprior.training.learned_parts import learned, learns_first
from warmprior.training.networks import check_network, make_network
from warmprior.training.placement import placed
from warmprior.transforms.history import HistoryObservation
from warmprior.transforms.window import window_replay_buffer, without_images

if TYPE_CHECKING:
    from warmprior.data import Demonstrations


def new_policy(
    task: Task,
    prior: Prior,
    network: NetworkOptions,
    training: TrainingConfig,
    *,
    start: StartPoint | None = None,
    coupling: Coupling | None = None,
    see_history: bool = False,
    **sampling: Any,
) -> WarmPriorActor:
    """Return a policy with fresh weights, which depend only on the seed; see :func:`train_policy`."""
    action_dim, observation_dim = task.data[keys.ACTION].shape[-1], task.vector.shape[-1]
    if see_history:
        observation_dim += HistoryObservation.width(prior.history_length, action_dim)
    torch.manual_seed(training.seed)
    velocity = make_network(
        network, action_dim, observation_dim, prior.prediction_length, task.images, task.resize
    )
    if network.precondition:
        velocity = precondition(
            velocity,
            task.data,
            prior,
            coupling=coupling,
            withhold=training.cold_probability,
            rest=copy.deepcopy(task.rest),
        )
    return WarmPriorActor(
        velocity,
        prior,
        start=start,
        **{"clip": task.clip, **sampling},
        observation_key=keys.CONDITIONED if see_history else keys.OBSERVATION,
        # A copy, because the policy moves to the device and the environments' normaliser stays on the CPU.
        normalizer=copy.deepcopy(task.normalizer),
        environment=task.environment,
        recording=task.recording,
    )


def train_policy(
    demonstrations: str | Path | Demonstrations | TensorDictBase | ReplayBuffer | Task,
    prior: Prior,
    directory: str | Path | None = None,
    *,
    observations: Sequence[str] | None = None,
    images: Sequence[str] = (),
    nfe: int | None = None,
    network: NetworkOptions | None = None,
    training: TrainingConfig | None = None,
    start: StartPoint | None = None,
    coupling: Coupling | None = None,
    see_history: bool = False,
    device: str = "cpu",
    compile: bool = False,
    logger: Logger | None = None,
    description: str | None = "train",
    progress: Callable[[int], object] | None = None,
    **sampling: Any,
) -> WarmPriorActor:
    """Train a policy on demonstrations with a source, by behaviour cloning.

    The defaults are those of most of the documentation's tables: a :class:`VelocityMLP` that is
    preconditioned for the source and the demonstrations, and the recipe of :class:`TrainingConfig`. CPU
    training uses one thread so that results are reproducible.

    Args:
        demonstrations: a :class:`Task`; or demonstrations, or their place, such as ``"demos.hdf5"``,
            ``"lerobot:user/name"`` or ``"minari:D4RL/door/human-v2"``
            (:func:`~warmprior.data.open_demonstrations`); or steps in memory, or a replay buffer of them, as
            for :func:`~warmprior.data.demonstrations_of`.
        prior: the source distribution. What it or ``start`` learns before the flow (:meth:`Prior.fit`), in a
            quarter of the iterations, is saved with the policy; the given object stays as it is.
        directory: folder where the run is saved and resumed, see :class:`BehaviourCloning`; if omitted,
            nothing is saved and an interrupted run is lost.

    Keyword Args:
        observations: observations of policies, see :class:`Task`; not with a task, which has its own.
        images: images of policies, see :class:`Task`.
        nfe: network evaluations per chunk, saved with the policy; see :class:`~warmprior.Sampling`.
        network: options of the velocity network.
        training: the recipe; :data:`~warmprior.options.training.PAPER` is the paper's.
        start: the point from which integration starts; the source sample by default.
        coupling: pairs sources and targets, see :class:`~warmprior.FlowMatchingLoss`; in order by default.
        see_history: True if the network sees the last actions.
        device: device of the network and, if they fit, the demonstrations.
        compile: True compiles the network with :func:`torch.compile`, which needs a C++ compiler.
        logger: a TorchRL logger, closed at the end.
        description: label of the progress bar; no bar if ``None``. With a place, what is used of it and what
            is left out is said above the bar.
        progress: called with the number of iterations, at the start and after each iteration.
        **sampling: further options of :class:`~warmprior.Sampling`, saved with the policy, such as
            ``max_nfe`` for a field trained at only a few values of ``t``.

    Returns:
        The last policy, with averaged weights, on the CPU, with the demonstrations' normaliser. Use
        :func:`~warmprior.policy_transforms` to build the environment that it acts in.

    Raises:
        TypeError: if the demonstrations or the prior have the wrong type.
        KeyError: if the demonstrations lack an entry.
        FloatingPointError: if the loss becomes NaN or infinite.
        FileNotFoundError: if there is no such file or dataset.
        ValueError: if the demonstrations have the wrong form, the folder belongs to a different training
            run, the device does not work, or the network cannot be compiled.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import PastPrior, policy_transforms
        >>> from warmprior.training import TrainingConfig, train_policy
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> recipe = TrainingConfig(iterations=2)  # 10,000 by default
        >>> actor = train_policy(TensorDict(steps, [60]), PastPrior(4), training=recipe, description=None)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), policy_transforms(actor))
        >>> env.rollout(3, actor)["vla_action", "chunk"].shape
        torch.Size([3, 4, 1])
    """
    network, training = network or NetworkOptions(), training or TrainingConfig()
    if not isinstance(prior, Prior):
        raise TypeError(f"the prior must be an object such as PastPrior(8), got {prior!r}")
    if see_history and any(map(learns_first, (prior, start))):  # it would be given another observation
        raise ValueError("a source or start point that learns before the flow needs see_history=False")
    check_device(device)  # before the demonstrations are read
    check_network(network)
    task = _task_of(demonstrations, {"observations": observations, "images": images})
    if isinstance(task.rest, RestingJoints) and not network.precondition:
        raise ValueError(
            "joint targets are learnt from the present joints by preconditioning: leave precondition=False "
            "out, or turn the joints off (joints='')"
        )
    if description is not None and isinstance(demonstrations, str | Path) and not rank():
        tqdm.write(task.recording.text(), file=sys.stderr)
    home = torch.device(device)
    if directory is None and world_size() > 1:
        raise ValueError("processes that train together need a directory that all of them see")
    with ExitStack() as stack:
        stack.enter_context(torch_threads(1 if home.type == "cpu" else None))
        # The training seeds PyTorch's global generator, whose state is restored at the end.
        stack.enter_context(torch.random.fork_rng([home] if home.type == "cuda" else []))
        if logger is not None:  # some loggers write in exit handlers, which a killed process does not run
            stack.enter_context(closing(logger))  # type: ignore[type-var]
        if directory is None:
            directory = stack.enter_context(TemporaryDirectory())
        given, steps = (task.data, training, directory), network.observation_steps
        if learns_first(prior):
            prior = learned(prior, prior, *given, observation_steps=steps)
        if learns_first(start):
            start = learned(start, prior, *given, observation_steps=steps)
        actor = new_policy(
            task,
            prior,
            network,
            training,
            start=start,
            coupling=coupling,
            see_history=see_history,
            nfe=nfe,
            **sampling,
        )
        cloning = BehaviourCloning(
            actor.to(device),
            placed(task.data, device),
            training,
            directory,
            coupling=coupling,
            logger=logger,
            compile=compile,
        )
        cloning.run(description, progress)
        wait_for_leader()  # until it has written the policy
        return load_policy(cloning.policy_path())


def _task_of(demonstrations: Any, chosen: dict[str, Any]) -> Task:
    """Return the task of what :func:`train_policy` is given."""
    # Imported here, since readers are not needed to import the training.
    from warmprior.data import Demonstrations, demonstrations_of, open_demonstrations

    if isinstance(demonstrations, str | Path):
        demonstrations = open_demonstrations(demonstrations)
    if isinstance(demonstrations, Demonstrations):
        return Task(demonstrations, **chosen)
    if any(chosen.values()):
        raise ValueError("observations and images are only for files and datasets: leave them out")
    if isinstance(demonstrations, Task):
        return demonstrations
    if isinstance(demonstrations, ReplayBuffer):
        if getattr(demonstrations, "write_count", 0) > len(demonstrations):
            raise ValueError("the replay buffer holds its last steps first: give its storage room for all")
        demonstrations = demonstrations[:]
    if not isinstance(demonstrations, TensorDictBase):
        raise TypeError(
            "train_policy takes a file or dataset, a TensorDict or replay buffer of steps, or a Task, got "
            f"{type(demonstrations).__name__}"
        )
    return Task(demonstrations_of(demonstrations))


TREND_BATCHES = 16
"""The number of batches of 1,024 windows to which a :class:`RestingTrend` is fitted."""


def precondition(
    network: VelocityNetwork,
    data: TensorDictBase,
    prior: Prior,
    *,
    coupling: Coupling | None = None,
    withhold: float = 0.0,
    rest: RestingAction | None = None,
) -> PreconditionedNetwork:
    """Wrap a network in a :class:`~warmprior.PreconditionedNetwork` for a prior and demonstrations.

    No training is needed. The result is deterministic: equal data and prior give an equal wrapper.

    Args:
        network: the network to wrap.
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`.
        prior: the source distribution.

    Keyword Args:
        coupling: pairs sources and targets, as the training does; in order by default. The path is its
            ``interpolant``, if it has one, or linear.
        withhold: share of the windows whose history is withheld.
        rest: the resting action, for absolute actions; the network then learns the motion from there.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> from warmprior.envs import navigation_demonstrations
        >>> from warmprior.training import precondition
        >>> network = VelocityMLP(1, 9, 4, observation_steps=1, hidden_dim=8)
        >>> wrapped = precondition(network, navigation_demonstrations(), PastPrior(4))
        >>> type(wrapped).__name__
        'PreconditionedNetwork'
    """
    generator = torch.Generator(data.device or "cpu").manual_seed(0)
    if coupling is None:  # a coupling may read the images
        data = without_images(data)
    windows = window_replay_buffer(
        data,
        prior,
        batch_size=1024,
        observation_steps=network.observation_steps,
        withhold=withhold,
        generator=generator,
    )
    trend = None
    if rest is not None:
        batch = torch.cat([windows.sample() for _ in range(TREND_BATCHES)])
        trend = RestingTrend.fit(batch, prior, rest, generator=generator)
    moments = SourceMoments.fit(windows, prior, coupling=coupling, trend=trend, generator=generator)
    path = getattr(coupling, "interpolant", None)
    return PreconditionedNetwork(network, moments=moments, trend=trend, interpolant=path)
