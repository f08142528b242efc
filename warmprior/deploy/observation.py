"""What a robot's drivers return, as its policy sees it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import interpolate

from warmprior import keys
from warmprior.checks import check_keys, check_shape
from warmprior.modules.normalize import Normalizer


class RobotObservation:
    """Turns raw observations into those of a policy: a copy of what it sees, in its units and sizes.

    Args:
        shapes: of what the policy sees, by name: vectors ``(d,)`` and images ``(3, h, w)``; ``None`` if that
            is not known, and observations are taken as they are.
        normalizer: of vectors.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]] | None, normalizer: Normalizer | None) -> None:
        self.shapes, self.normalizer = shapes, normalizer
        # A policy that sees one vector takes it without its name.
        self._vector = shapes is not None and [len(shape) for shape in shapes.values()] == [1]

    def __call__(self, observation: Any) -> Tensor | TensorDictBase:
        """The observation of one step, ``[d]`` or a tensordict ``[]``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if one is no array, a vector of another width, or no image.
        """
        seen = self._entries(observation)
        if self.normalizer is None:
            return seen
        return self.normalizer.normalize(TensorDict({keys.OBSERVATION: seen}))[keys.OBSERVATION]

    def _entries(self, observation: Any) -> Tensor | TensorDictBase:
        named = isinstance(observation, Mapping | TensorDictBase)
        if self.shapes is None:
            if not named:
                return _copied("observation", observation)
            return TensorDict({str(name): _copied(str(name), value) for name, value in observation.items()})
        if not named:
            if not self._vector:
                raise ValueError(
                    f"the observation is {type(observation).__name__}, and the policy sees the entries "
                    f"{list(self.shapes)}"
                )
            observation = dict.fromkeys(self.shapes, observation)
        check_keys(
            observation, self.shapes, "the policy", f"; there are {sorted(map(str, observation.keys()))}"
        )
        seen = {name: _fitted(name, observation[name], shape) for name, shape in self.shapes.items()}
        return next(iter(seen.values())) if self._vector else TensorDict(seen)


def _copied(name: str, value: Any) -> Tensor:
    """A copy on the CPU: drivers may reuse the memory for the next observation."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    try:
        # Of NumPy, since PyTorch takes no array that was turned over, as from BGR to RGB.
        return torch.from_numpy(np.array(value, order="C"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name!r} is no array of numbers, but {type(value).__name__}") from error


def _fitted(name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    """A vector as it is; an image channels first and resized, as LeRobot's images are for ``warm_flow``."""
    found = _copied(name, value)
    if len(shape) != 3:
        check_shape(name, found, shape)
        return found
    image = found if found.ndim != 3 or len(found) == 3 else found.movedim(-1, 0)
    if image.dtype != torch.uint8 or image.ndim != 3 or len(image) != 3 or not image.numel():
        raise ValueError(
            f"{name!r} is no image: it has shape {list(found.shape)} of {found.dtype}, and a camera gives "
            "uint8 [h, w, 3] or [3, h, w]"
        )
    if image.shape == shape:
        return image
    return interpolate(image[None], shape[1:], mode="bilinear", antialias=True)[0]
