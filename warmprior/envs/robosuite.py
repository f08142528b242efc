"""robosuite environments for TorchRL: the tasks of robomimic, from low-dimensional state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from warmprior import keys
from warmprior.checks import check_choice, check_whole_numbers
from warmprior.envs.control_loop import ControlLoop, StepLoop, is_plain
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.rendering import EnvRenderers
from warmprior.envs.robosuite_tasks import STYLES, task_of_env
from warmprior.envs.robosuite_tasks import low_dim_keys as default_keys
from warmprior.envs.simulator import action_limits, make_simulator, task_env_args

_LOOPS = {"lean": ControlLoop, "robosuite": StepLoop}


class RobosuiteEnv(EnvBase):
    """A robosuite environment: a task by its short name, that of a robomimic file, or your own.

    ==================  =============================================================
    key                 shape, dtype
    ==================  =============================================================
    ``"observation"``   ``[d_o]`` float32: ``low_dim_keys``, concatenated
    ``"sim_state"``     ``[1 + nq + nv]`` float64, time, positions and velocities; only ``sim_state``
    ``"eef_pose"``      ``[arms, 3, 4]`` float32; only ``eef_pose``
    ``"success"``       ``[1]`` bool
    ``"action"``        ``[d_a]`` float32 in the controller's range, ``[-1, 1]`` for the tasks
    ``"reward"``        ``[1]`` float32: 1 where the task is solved, 0 elsewhere
    ``"terminated"``    ``[1]`` bool: solved (see ``terminate_on_success``)
    ``"truncated"``     ``[1]`` bool: out of time
    ==================  =============================================================

    The n-th reset after :meth:`set_seed` (or after construction) plays the episode of simulator seed ``seed +
    n``, counted from 0. The global generators of numpy and Python are not changed.

    Policies that see images need them only at decisions, for which
    :class:`~warmprior.transforms.CameraImages` renders them. TorchRL's ``PixelRenderTransform(render_method=
    "render_frame", camera="agentview")`` renders every step, such as for its ``VideoRecorder``.

    Args:
        task: a name of :data:`warmprior.envs.TASKS`. Those that end in ``_d0`` are MimicGen's and need its
            package (see :func:`~warmprior.envs.mimicgen.register_mimicgen`).
        env_args: instead of ``task``: the parsed ``data.attrs["env_args"]`` of a robomimic or MimicGen file
            of any version.
        env: instead of both: a robosuite environment. Its own time limit, reward and renderer are not used.
        style: style of the data whose time limit applies: ``"ph"``, ``"mh"``, ``"source"`` or ``"core"``.
        low_dim_keys: robomimic names of the observations to concatenate; by default ``"object"`` and each
            arm's pose and gripper.
        horizon: time limit in control steps; by default the task's, or else the environment's own.
        control_loop: ``"lean"`` for :class:`~warmprior.envs.control_loop.ControlLoop`, ``"robosuite"`` for
            ``env.step``; by default the lean loop if it supports robots, sensors and ``env.step``.
        fast_rendering: see :class:`~warmprior.envs.rendering.CameraRenderer`.
        sim_state: True writes the simulator's state.
        eef_pose: True writes the grippers' poses in the world: rotation and, in the last column, position in
            metres (see :class:`~warmprior.transforms.AbsoluteActions`).
        seed: seed of the first episode.
        terminate_on_success: True ends the episode once the task is solved.
        device: device of the tensordicts.

    Raises:
        ImportError: if robosuite, or the package of the environment, is not installed or imported.
        ValueError: if the task is unknown, not exactly one of ``task``, ``env_args`` and ``env`` is given, an
            option is out of range, an observation does not exist, or the lean loop does not support the
            robots.

    Examples:
        >>> from warmprior.envs import RobosuiteEnv
        >>> RobosuiteEnv("lift", seed=3).rollout(5)["observation"].shape  # doctest: +SKIP
        torch.Size([5, 19])
        >>> RobosuiteEnv("life")
        Traceback (most recent call last):
            ...
        ValueError: task must be one of lift, can, square, stack, transport, ..., got 'life'
    """

    def __init__(
        self,
        task: str | None = None,
        *,
        env_args: Mapping[str, Any] | None = None,
        env: Any = None,
        style: str = "ph",
        low_dim_keys: Sequence[str] | None = None,
        horizon: int | None = None,
        control_loop: Literal["lean", "robosuite"] | None = None,
        fast_rendering: bool = False,
        sim_state: bool = False,
        eef_pose: bool = False,
        seed: int = 0,
        terminate_on_success: bool = True,
        device: torch.device | str | None = None,
    ) -> None:
        if sum(choice is not None for choice in (task, env_args, env)) != 1:
            raise ValueError("give one of task, env_args and env")
        check_choice("style", style, STYLES)
        if control_loop is not None:
            check_choice("control_loop", control_loop, _LOOPS)
        check_whole_numbers(horizon=1 if horizon is None else horizon)
        if task is not None:
            env_args = task_env_args(task)
        elif env_args is not None:
            env_args = modernize_env_args(env_args)
        spec = None if env_args is None else task_of_env(env_args)
        if spec is not None and horizon is None:
            horizon = spec.horizon(style)
        super().__init__(device=device)
        self.task = spec
        #: The camera of :meth:`render_frame` by default; robosuite's ``"frontview"`` has the whole arm.
        self.camera = "frontview"
        self._env = env if env_args is None else make_simulator(env_args)
        if control_loop is None:
            control_loop = "lean" if is_plain(self._env) else "robosuite"
        if horizon is None:
            # Also if the environment itself has no limit (``ignore_done``): an evaluation would wait for a
            # success that may never come.
            horizon = self._env.horizon
            check_whole_numbers(horizon=horizon)
        default = default_keys(len(self._env.robots))
        self.low_dim_keys = default if low_dim_keys is None else tuple(low_dim_keys)
        self.horizon = horizon
        self.control_loop = control_loop
        self.fast_rendering = fast_rendering
        self.sim_state, self.eef_pose = sim_state, eef_pose
        self.terminate_on_success = terminate_on_success
        self._next_seed = seed
        self._elapsed = 0
        self._make_specs(self._env)
        self.is_closed = False

    def render_frame(
        self,
        camera: str | None = None,
        size: int | tuple[int, int] = 84,
        state: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return a picture of a state, uint8 ``[h, w, 3]``, upright.

        The size is a side, or height and width. By default :attr:`camera` shows the current state; a state
        has the form of ``"sim_state"``. Rendering does not affect the episode.

        Raises:
            ValueError: if the camera does not exist.
            ImportError: if no OpenGL backend works.
        """
        height, width = (size, size) if isinstance(size, int) else size
        qpos = None if state is None else state[1 : 1 + self._env.sim.model.nq]
        return self._renderers.render(camera or self.camera, height, width, qpos)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulator."""
        if not self.is_closed:
            self._env.close()
        super().close(raise_if_closed=raise_if_closed)

    def _make_specs(self, env: Any) -> None:
        #: The control loop, with access to the simulator's state and the poses of bodies and sites.
        self.loop: StepLoop = _LOOPS[self.control_loop](env, self.low_dim_keys)
        self._renderers = EnvRenderers(env, fast=self.fast_rendering)
        width = sum(value.size for value in self.loop.observations().values())

        def flag() -> Categorical:
            return Categorical(2, dtype=torch.bool, shape=(1,), device=self.device)

        self.observation_spec = Composite(
            {keys.OBSERVATION: Unbounded((width,), device=self.device), "success": flag()}
        )
        if self.sim_state:
            numbers = len(self.loop.state())
            state = Unbounded((numbers,), dtype=torch.float64, device=self.device)
            self.observation_spec[keys.SIM_STATE] = state
        if self.eef_pose:
            shape = (len(env.robots), 3, 4)
            self.observation_spec[keys.EEF_POSE] = Unbounded(shape, device=self.device)
        low, high = (torch.from_numpy(ends).float() for ends in action_limits(env))
        self.action_spec = Bounded(low, high, device=self.device)
        self.reward_spec = Bounded(0.0, 1.0, shape=(1,), device=self.device)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._next_seed = seed

    def _measure(self, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        # Kept short: it runs between physics steps, which evict everything else from the caches.
        state = [observations[key] for key in self.low_dim_keys]
        measured = {keys.OBSERVATION: np.concatenate(state, dtype=np.float32, casting="same_kind")}
        if self.sim_state:
            measured[keys.SIM_STATE] = self.loop.state()
        if self.eef_pose:
            arms = range(len(self._env.robots))
            poses = [np.column_stack(self.loop.eef(arm)[::-1]) for arm in arms]
            measured[keys.EEF_POSE] = np.stack(poses).astype(np.float32)
        return measured

    def _tell(self, observations: Mapping[str, np.ndarray], success: bool = False) -> TensorDictBase:
        """Return the result of a step."""
        terminated = success and self.terminate_on_success
        truncated = self._elapsed >= self.horizon and not terminated
        flags = {keys.SUCCESS: success, "terminated": terminated, "truncated": truncated}
        flags["done"] = terminated or truncated
        entry: dict[str, Any] = {"reward": torch.tensor([float(success)])}
        entry |= {name: torch.tensor([flag]) for name, flag in flags.items()}
        entry |= {key: torch.from_numpy(value) for key, value in self._measure(observations).items()}
        # The constructor's checks are skipped, because they take longer than all of the above.
        result = TensorDict._new_unsafe(entry, batch_size=torch.Size([]))
        return result if self.device is None else result.to(self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        observations = self.loop.reset(self._next_seed)
        self._next_seed += 1
        self._elapsed = 0
        return self._tell(observations).exclude("reward")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(keys.ACTION).detach().cpu().double().numpy()
        observations, success = self.loop.step(action)
        self._elapsed += 1
        return self._tell(observations, success)
