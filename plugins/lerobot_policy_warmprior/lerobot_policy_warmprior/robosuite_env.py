"""``--env.type=warmprior_robosuite``: the library's simulated tasks for ``lerobot-eval``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from tensordict import TensorDict

from warmprior.envs import RobosuiteEnv, get_task


class RobosuiteGymEnv(gymnasium.Env):
    """Gymnasium interface of :class:`~warmprior.envs.RobosuiteEnv`; its options are in the configuration."""

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium annotates no class variable
        "render_modes": ["rgb_array"],
        "render_fps": 20,
    }

    def __init__(
        self,
        task: str,
        style: str = "ph",
        cameras: Sequence[str] = (),
        image_size: int = 84,
        horizon: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._env = RobosuiteEnv(task, style=style, horizon=horizon)
        spec = self._env.task
        assert spec is not None  # named tasks have one
        self.task = self.task_description = spec.name
        self._object_dim, self._cameras, self._image_size = spec.object_dim, list(cameras), image_size
        self._max_episode_steps = spec.horizon(style) if horizon is None else horizon
        self.render_mode = render_mode
        self._begun = False
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.action_dim,), np.float32)

        def box(width: int) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)

        spaces: dict[str, gymnasium.Space] = {"agent_pos": box(spec.observation_dim - spec.object_dim)}
        if cameras:
            image = gymnasium.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
            spaces["pixels"] = gymnasium.spaces.Dict({camera: image for camera in cameras})
        else:
            spaces["environment_state"] = box(spec.object_dim)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the episode of a seed, or the next one; without any seed the first is drawn."""
        super().reset(seed=seed)
        if seed is not None or not self._begun:  # else every environment would play the episodes of seed 0
            drawn = int(self.np_random.integers(2**31)) if seed is None else seed
            self._env.set_seed(drawn, static_seed=True)
        self._begun = True
        return self._observation(self._env.reset()), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take a control step; actions are clipped to ``[-1, 1]``."""
        value = torch.as_tensor(np.clip(action, -1.0, 1.0), dtype=torch.float32)
        step = self._env.step(TensorDict({"action": value}, []))["next"]
        info = {"is_success": bool(step["success"])}
        ended = bool(step["terminated"]), bool(step["truncated"])
        return self._observation(step), float(step["reward"]), *ended, info

    def render(self) -> np.ndarray:
        """Return a picture of the scene, ``[h, w, 3]`` uint8."""
        return self._env.render_frame(size=256)

    def close(self) -> None:
        """Free the simulator."""
        self._env.close(raise_if_closed=False)

    def _observation(self, data: Any) -> dict[str, Any]:
        vector = data["observation"].numpy()
        observation: dict[str, Any] = {"agent_pos": vector[self._object_dim :]}
        if not self._cameras:
            return {**observation, "environment_state": vector[: self._object_dim]}
        images = {camera: self._env.render_frame(camera, self._image_size) for camera in self._cameras}
        return {**observation, "pixels": images}


@EnvConfig.register_subclass("warmprior_robosuite")
@dataclass
class RobosuiteEnvConfig(EnvConfig):
    """Options of a robosuite task with the observations of ``python -m warmprior convert``.

    Attributes:
        task: name of the task in ``warmprior.envs.TASKS``.
        style: style of the demonstrations, ``ph`` or ``mh``, which decides the time limit.
        cameras: cameras to render; with any, the state of the objects is left out, as in image datasets.
        image_size: side of the images in pixels.
        episode_length: control steps per episode; the task's by default.
    """

    task: str = "lift"
    fps: int = 20
    style: str = "ph"
    cameras: list[str] = field(default_factory=list)
    image_size: int = 84
    episode_length: int | None = None
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "agent_pos": "observation.state",
            "environment_state": "observation.environment_state",
        }
    )

    def __post_init__(self) -> None:
        task = get_task(self.task)
        state = task.observation_dim - task.object_dim
        entries: dict[str, tuple[FeatureType, tuple[int, ...]]] = {
            "action": (FeatureType.ACTION, (task.action_dim,)),
            "agent_pos": (FeatureType.STATE, (state,)),
        }
        for camera in self.cameras:
            name = f"pixels/{camera}"
            entries[name] = (FeatureType.VISUAL, (self.image_size, self.image_size, 3))
            self.features_map[name] = f"observation.images.{camera}"
        if not self.cameras:
            entries["environment_state"] = (FeatureType.ENV, (task.object_dim,))
        self.features = {
            name: PolicyFeature(type=kind, shape=shape) for name, (kind, shape) in entries.items()
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return the arguments of the environment."""
        return {
            "task": self.task,
            "style": self.style,
            "cameras": self.cameras,
            "image_size": self.image_size,
            "horizon": self.episode_length,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Make a batch of environments, with ``use_async_envs`` in worker processes."""
        make = partial(RobosuiteGymEnv, **self.gym_kwargs)
        options: dict[str, Any] = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        batch: gymnasium.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            batch = gymnasium.vector.AsyncVectorEnv([make] * n_envs, context="forkserver", **options)
        else:
            batch = gymnasium.vector.SyncVectorEnv([make] * n_envs, **options)
        return {self.type: {0: batch}}
