"""One episode in pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.evaluation import acting_in_episode

__all__ = ["Filmstrip", "record_filmstrip"]


@dataclass(frozen=True)
class Filmstrip:
    """Evenly spaced frames of one episode.

    Attributes:
        frames: uint8 ``[h, w, 3]`` each; the first before the first action, the last at the end.
        steps: control steps executed before each frame.
        success: whether the task was solved.
    """

    frames: list[np.ndarray]
    steps: list[int]
    success: bool


@torch.no_grad()
def record_filmstrip(
    actor: WarmPriorActor,
    make_env: Callable[..., EnvBase],
    make_transforms: Callable[[], Compose],
    *,
    seed: int,
    nfe: int,
    policy_seed: int = 0,
    frames: int = 9,
    size: int = 160,
) -> Filmstrip:
    """Play one episode and render it at evenly spaced decisions.

    Args:
        actor: the policy.
        make_env: builds the environment, see :class:`~warmprior.envs.RobosuiteEnv`.
        make_transforms: builds the policy's transforms.

    Keyword Args:
        seed: simulator seed of the episode.
        nfe: network evaluations per chunk.
        policy_seed: of the source samples; the episode is the one of :func:`play_episode`.
        frames: how many pictures.
        size: side of a picture in pixels.

    Raises:
        RuntimeError: if nothing on this machine can render; the message names the packages to install.
    """
    actor.eval()
    device = next(actor.parameters()).device
    env = TransformedEnv(make_env(), make_transforms())
    loop = env.base_env.loop
    states, steps, success = [], [], False
    try:
        with acting_in_episode(actor, seed, nfe=nfe, policy_seed=policy_seed) as act:
            env.set_seed(seed)
            data = env.reset()
            while True:
                states.append(loop.state())
                steps.append(int(data[keys.ELAPSED]))
                success |= bool(data[keys.SUCCESS])
                if bool(data["done"].any()):
                    break
                data = env.step_mdp(env.step(act(data.to(device)).to("cpu")))
        # Rendering is slow, and only now is it known which states are evenly spaced.
        chosen = np.unique(np.linspace(0, len(states) - 1, frames).round().astype(int))
        pictures = []
        for i in chosen:
            loop.set_state(states[i])
            pictures.append(env.base_env.render_frame(size=size))
    finally:
        env.close()
    return Filmstrip(pictures, [steps[i] for i in chosen], success)
