"""Images of a simulator's cameras, rendered for the observations that are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite

from warmprior import keys
from warmprior.transforms.inner_step import EnvTransform

__all__ = ["CameraImages"]


class CameraImages(EnvTransform):
    """Adds an image per camera to an observation vector.

    The images are rendered from the environment's state (``RobosuiteEnv(..., sim_state=True)``). That takes
    several times as long as a control step, so only the observations that the next decision reads are
    rendered. Place it first, next to the simulator, and inside the workers of batched environments;
    :func:`policy_transforms` does so.

    Args:
        cameras: names of the simulator's cameras; the image of ``"agentview"`` becomes
            ``("observation", "agentview_image")``, uint8 ``[3, size, size]``.
        size: side of the images in pixels.

    Raises:
        ValueError: if there are no cameras, one is named twice or (in an environment) does not exist.
        KeyError: if the environment does not write its state.
        RuntimeError: if it is no simulator, or nothing here can render.

    Examples:
        >>> from warmprior import CameraImages
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior.envs import RobosuiteEnv
        >>> env = TransformedEnv(  # doctest: +SKIP
        ...     RobosuiteEnv("lift", sim_state=True), CameraImages(["agentview"], 84))
        >>> env.reset()["observation", "agentview_image"].shape  # doctest: +SKIP
        torch.Size([3, 84, 84])
        >>> CameraImages(["agentview", "agentview"])
        Traceback (most recent call last):
            ...
        ValueError: CameraImages needs different cameras, got ['agentview', 'agentview']
    """

    def __init__(self, cameras: Sequence[str], size: int = 84) -> None:
        super().__init__(in_keys=[keys.OBSERVATION, keys.SIM_STATE], out_keys=[keys.OBSERVATION])
        self.cameras = tuple(cameras)
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"CameraImages needs different cameras, got {list(self.cameras)}")
        if size < 1:
            raise ValueError(f"the size of images must be at least 1 pixel, got {size}")
        self.size = size

    @property
    def _simulator(self) -> Any:
        base: Any = None if self.container is None else self.container.base_env
        if not hasattr(base, "render_frame"):
            raise RuntimeError(
                "CameraImages renders a simulator: append it to TransformedEnv(RobosuiteEnv(...)), inside of "
                f"batched environments, not to {type(base).__name__}"
            )
        return base

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        state = next_tensordict.get(keys.SIM_STATE, None)
        if state is None:
            raise KeyError(
                f"CameraImages needs the simulator's state at {keys.SIM_STATE!r}: build the environment with "
                "sim_state=True"
            )
        simulator, numbers = self._simulator, state.cpu().numpy()
        vector = next_tensordict.get(keys.OBSERVATION)
        entries = {keys.STATE: vector}
        for camera in self.cameras:
            image = simulator.render_frame(camera, self.size, numbers).transpose(2, 0, 1)
            entries[f"{camera}_image"] = torch.from_numpy(np.ascontiguousarray(image)).to(vector.device)
        return next_tensordict.set(keys.OBSERVATION, TensorDict(entries))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the vector by the vector and images."""
        if keys.SIM_STATE not in observation_spec:
            raise KeyError(
                f"CameraImages found no {keys.SIM_STATE!r}: build the environment with sim_state=True"
            )
        vector, shape = observation_spec[keys.OBSERVATION], (3, self.size, self.size)
        image = Bounded(0, 255, shape=shape, dtype=torch.uint8, device=vector.device)
        images = {f"{camera}_image": image.clone() for camera in self.cameras}
        observation_spec[keys.OBSERVATION] = Composite({keys.STATE: vector, **images})
        return observation_spec
