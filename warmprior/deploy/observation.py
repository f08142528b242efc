"""Conversion of a robot's raw observations to those of its policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_keys, check_shape
from warmprior.modules.encoder import ImageEncoder
from warmprior.modules.network import VelocityNetwork, uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.modules.recording import Recording
from warmprior.modules.resize import resized
from warmprior.options.data import Resize
from warmprior.transforms.history import HistoryObservation


def encoder_in(actor: Any) -> ImageEncoder | None:
    """Return the image encoder of a policy's network, if it has one."""
    network = uncompiled(getattr(uncompiled(actor), "network", None))
    modules = network.modules() if isinstance(network, torch.nn.Module) else ()
    return next((part for part in modules if isinstance(part, ImageEncoder)), None)


def observation_shapes(actor: Any, prior: Prior | None = None) -> Mapping[str, tuple[int, ...]] | None:
    """Return the shapes of a policy's observation at one step, by name, or ``None`` if they are unknown.

    Vectors are ``(d,)``, and images ``(3, h, w)`` at the size of the training images.

    Args:
        actor: the policy.
        prior: its source; by default ``actor.prior``.
    """
    plain = uncompiled(actor)
    network = uncompiled(getattr(plain, "network", None))
    if (shapes := getattr(plain, "shapes", None)) is not None or not isinstance(network, VelocityNetwork):
        return shapes
    encoder = encoder_in(actor)
    if encoder is None and network.encodes:  # a user's own encoder may have no shapes
        return None
    shapes = {keys.STATE: (network.observation_dim,)} if encoder is None else {**encoder.shapes}
    if keys.CONDITIONED in actor.in_keys and keys.STATE in shapes:
        prior = plain.prior if prior is None else prior
        added = HistoryObservation.width(prior.history_length, network.action_dim)
        shapes[keys.STATE] = (shapes[keys.STATE][0] - added,)
    return shapes


class RobotObservation:
    """A converter of raw observations to those of a policy: copies in its units and sizes.

    Args:
        shapes: see :func:`observation_shapes`; with ``None`` observations are only copied.
        normalizer: normaliser of vectors.
        resize: how images are resized, see :func:`~warmprior.modules.resize.resized`.
        recording: the demonstrations' own names of observations, which are known as well.

    Raises:
        ValueError: if the normaliser lacks a vector.
    """

    def __init__(
        self,
        shapes: Mapping[str, tuple[int, ...]] | None,
        normalizer: Normalizer | None,
        resize: Resize = "squeeze",
        recording: Recording | None = None,
    ) -> None:
        self.shapes, self.normalizer, self.resize, self.recording = shapes, normalizer, resize, recording
        # A policy with a single vector takes it without a name.
        self._vector = shapes is not None and [len(shape) for shape in shapes.values()] == [1]
        if normalizer is None or shapes is None:
            return
        vectors: list[Any] = [(keys.OBSERVATION, name) for name, shape in shapes.items() if len(shape) == 1]
        normalizer.check_has(*[keys.OBSERVATION] if self._vector else vectors)

    def __call__(self, observation: Any) -> Tensor | TensorDictBase:
        """Return the observation of one step, ``[d]`` or a tensordict ``[]``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if an entry is not an array, has another width, or should be an image and is not.
        """
        converted = self._entries(observation)
        if self.normalizer is None:
            return converted
        return self.normalizer.normalize(TensorDict({keys.OBSERVATION: converted}))[keys.OBSERVATION]

    def _entries(self, observation: Any) -> Tensor | TensorDictBase:
        named = isinstance(observation, Mapping | TensorDictBase)
        if self.shapes is None:
            if not named:
                return _copied("observation", observation)
            return TensorDict({str(name): _copied(str(name), value) for name, value in observation.items()})
        if not named:
            if not self._vector:
                raise ValueError(
                    f"the observation is {type(observation).__name__}, but the policy needs the entries "
                    f"{list(self.shapes)}"
                )
            observation = dict.fromkeys(self.shapes, observation)
        given = {name: value for name, value in observation.items() if value is not None}
        there = f"; there are {sorted(map(str, given))}"
        if self.recording is not None:
            own = {keys.STATE: [*self.recording.observations], **self.recording.names}
            there += f"; the demonstrations' own names are {own}"
            given = self._renamed(given, self.recording)
        # An empty vector, of a policy of images that sees the history, is not asked of the driver.
        given |= {name: () for name, shape in self.shapes.items() if tuple(shape) == (0,)}
        check_keys(given, self.shapes, "the policy", there)
        entries = {
            name: _fitted(name, given[name], shape, self.resize) for name, shape in self.shapes.items()
        }
        return next(iter(entries.values())) if self._vector else TensorDict(entries)

    def _renamed(self, given: dict[Any, Any], recording: Recording) -> dict[Any, Any]:
        """Return entries under the policy's names, which may have those of the demonstrations."""
        images = {name: given[own] for name, own in recording.names.items() if own in given}
        parts = {name: (width,) for name, width in recording.observations.items()}
        if parts and parts.keys() <= given.keys():
            vectors = [_fitted(name, given[name], shape, self.resize) for name, shape in parts.items()]
            given = given | {keys.STATE: torch.cat(vectors)}
        return given | images


def _copied(name: str, value: Any) -> Tensor:
    """Copy to the CPU, because drivers may reuse the memory for the next observation."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    try:
        # Copied by NumPy, since PyTorch takes no array with negative strides, as from BGR to RGB.
        return torch.from_numpy(np.array(value, order="C"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name!r} is not an array of numbers: {error}") from error


def _fitted(name: str, value: Any, shape: tuple[int, ...], resize: Resize) -> Tensor:
    """Check a vector; put an image's channels first and resize it."""
    array = _copied(name, value)
    if len(shape) != 3:
        check_shape(name, array, shape)
        return array if array.is_floating_point() else array.float()
    image = array if array.ndim != 3 or len(array) == 3 else array.movedim(-1, 0)
    if image.dtype != torch.uint8 or image.ndim != 3 or len(image) != 3 or not image.numel():
        raise ValueError(
            f"{name!r} is not an image: it has shape {list(array.shape)} of {array.dtype}, but a camera "
            "gives uint8 [h, w, 3] or [3, h, w]"
        )
    return resized(image, (shape[1], shape[2]), resize)
