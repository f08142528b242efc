"""Options of ``--env.type=warmprior_robosuite``: the library's simulated tasks for ``lerobot-eval``."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from warmprior.envs.tasks import get_task

__all__ = ["RobosuiteEnvConfig"]


@EnvConfig.register_subclass("warmprior_robosuite")
@dataclass
class RobosuiteEnvConfig(EnvConfig):
    """A task of robosuite with the observations that ``python -m warmprior convert`` gives demonstrations.

    Attributes:
        task: a name of ``warmprior.envs.TASKS``.
        style: of the demonstrations, ``ph`` or ``mh``; decides the time limit.
        cameras: to render; with them the state of the objects is left out, as in image datasets.
        image_size: side of the images in pixels.
        episode_length: time limit in control steps; the task's by default.
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
        entries = {
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
        """Arguments of the environment."""
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
        """One batch of environments; in worker processes, they need not know of any registry."""
        from lerobot_policy_warmprior.robosuite_env import RobosuiteGymEnv

        make = partial(RobosuiteGymEnv, **self.gym_kwargs)
        options: dict[str, Any] = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        if use_async_envs and n_envs > 1:
            batch = gymnasium.vector.AsyncVectorEnv([make] * n_envs, context="forkserver", **options)
        else:
            batch = gymnasium.vector.SyncVectorEnv([make] * n_envs, **options)
        return {self.type: {0: batch}}
