"""Conversion of a robot's raw observations to those of its policy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_keys, check_shape
from warmprior.modules.encoder import ImageEncoder
from warmprior.modules.network import VelocityNetwork, uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.recording import Recording
from warmprior.modules.resize import resized
from warmprior.options.data import Resize
from warmprior.transforms.history import HistoryObservation

FAR = 2.0
"""The normalised number, half the demonstrations' range beyond its end, above which one is warned."""


def encoder_in(actor: Any) -> ImageEncoder | None:
    """Return the image encoder of a policy's network, if it has one."""
    network = uncompiled(getattr(uncompiled(actor), "network", None))
    modules = network.modules() if isinstance(network, torch.nn.Module) else ()
    return next((part for part in modules if isinstance(part, ImageEncoder)), None)


def observation_shapes(actor: Any) -> Mapping[str, tuple[int, ...]] | None:
    """Return the shapes of a policy's observation at one step, by name, or ``None`` if they are unknown.

    Vectors are ``(d,)``, and images ``(3, h, w)`` at the size of the training images.
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
        added = HistoryObservation.width(plain.prior.history_length, network.action_dim)
        shapes[keys.STATE] = (shapes[keys.STATE][0] - added,)
    return shapes


class RobotObservation:
    """A converter of raw observations to those of a policy: copies in its units and sizes.

    Args:
        shapes: see :func:`observation_shapes`; with ``None`` observations are only copied.
        normalizer: normaliser of vectors.
        resize: how images are resized, see :func:`~warmprior.modules.resize.resized`.
        recording: the demonstrations' own names of observations, which are known as well, and the recorded
            sizes of images.

    Warns:
        UserWarning: once for each observation far outside of the range of the demonstrations, and for each
            image whose sides have another ratio.

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
        self._warned: set[str] = set()
        vectors = [] if shapes is None else [name for name, shape in shapes.items() if len(shape) == 1]
        self._vectors: dict[NestedKey, str] = {(keys.OBSERVATION, name): name for name in vectors}
        if self._vector:
            self._vectors = {keys.OBSERVATION: vectors[0]}
        if normalizer is not None:
            normalizer.check_has(*self._vectors)

    def __call__(self, observation: Any) -> Tensor | TensorDictBase:
        """Return the observation of one step, ``[d]`` or a tensordict ``[]``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if an entry is not an array, has another width, holds NaN or infinity, or should be an
                image and is not.
        """
        raw: TensorDictBase = TensorDict({keys.OBSERVATION: self._entries(observation)})
        data, far = raw, math.inf
        if self.normalizer is not None:
            data, far = self.normalizer.normalize(raw), FAR
        for key, name in self._vectors.items():
            if not (data[key].abs() < far).all():  # NaN is not less
                self._check_vector(key, name, raw[key], data[key])
        return data[keys.OBSERVATION]

    def _check_vector(self, key: NestedKey, name: str, raw: Tensor, normalised: Tensor) -> None:
        """Raise ValueError for NaN or infinity, and warn of the farthest number of each observation."""
        numbers = self._numbers(name, len(raw))
        if wrong := [" ".join(numbers[i]) for i in (~raw.isfinite()).nonzero().flatten().tolist()]:
            raise ValueError(
                f"the observation holds NaN or infinity in {', '.join(wrong)}: check the robot's sensors"
            )
        assert self.normalizer is not None, "without one, every finite number is near"
        loc, scale = self.normalizer.loc(key), self.normalizer.scale(key)
        distance = normalised.abs()
        for i in distance.argsort(descending=True).tolist():
            part, number = numbers[i]
            if distance[i] <= FAR:
                return
            if part not in self._warned:
                self._warned.add(part)
                low, high = (loc - scale)[i], (loc + scale)[i]
                # The scale is 1 where the demonstrations are constant, too.
                seen = f"within 1 of {loc[i]:.4g}" if scale[i] == 1 else f"from {low:.4g} to {high:.4g}"
                warnings.warn(
                    f"{part} {number} is {raw[i]:.4g}, far outside of the demonstrations, which are {seen}: "
                    "give the observation in their unit and order",
                    stacklevel=4,
                )

    def _numbers(self, name: str, width: int) -> list[tuple[str, str]]:
        """Return the observation and the name or index of each number of a vector, as the data name them."""
        seen, parts = self.recording, {name: width}
        if seen is not None and sum(seen.observations.values()) == width:
            parts = {**seen.observations}
        found = []
        for part, count in parts.items():
            names = () if seen is None else seen.numbers.get(part, ())
            found += [(part, names[i] if len(names) == count else f"[{i}]") for i in range(count)]
        return found

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
            if keys.STATE not in given and given.keys() & self.recording.observations.keys():
                check_keys(given, self.recording.observations, "the policy", there)  # some of several
        # An empty vector, of a policy of images that sees the history, is not asked of the driver.
        given |= {name: () for name, shape in self.shapes.items() if tuple(shape) == (0,)}
        check_keys(given, self.shapes, "the policy", there)
        entries = {name: self._fitted(name, given[name], shape) for name, shape in self.shapes.items()}
        return next(iter(entries.values())) if self._vector else TensorDict(entries)

    def _renamed(self, given: dict[Any, Any], recording: Recording) -> dict[Any, Any]:
        """Return entries under the policy's names, which may have those of the demonstrations."""
        images = {name: given[own] for name, own in recording.names.items() if own in given}
        parts = {name: (width,) for name, width in recording.observations.items()}
        if parts and parts.keys() <= given.keys():
            vectors = [self._fitted(name, given[name], shape) for name, shape in parts.items()]
            given = given | {keys.STATE: torch.cat(vectors)}
        return given | images

    def _fitted(self, name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
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
        self._check_sides(name, image, shape)
        return resized(image, (shape[1], shape[2]), self.resize)

    def _check_sides(self, name: str, image: Tensor, shape: tuple[int, ...]) -> None:
        """Warn once of an image whose sides have another ratio than the recorded ones."""
        if self.recording is None or name in self._warned:
            return
        (height, width), (rows, columns) = image.shape[1:], self.recording.sizes.get(name, shape[1:])
        # Images of the policy's own size may have been resized before they were recorded, or given.
        if shape[1:] not in ((rows, columns), (height, width)) and not math.isclose(
            width * rows, height * columns, rel_tol=0.02
        ):
            self._warned.add(name)
            warnings.warn(
                f"{self.recording.names.get(name, name)} has {height} x {width} pixels (height x width), and "
                f"{rows} x {columns} in the demonstrations: resized, it looks otherwise than there. Crop it "
                "to their ratio, or check which camera it is",
                stacklevel=6,
            )


def _copied(name: str, value: Any) -> Tensor:
    """Copy to the CPU, because drivers may reuse the memory for the next observation."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    try:
        # Copied by NumPy, since PyTorch takes no array with negative strides, as from BGR to RGB.
        return torch.from_numpy(np.array(value, order="C"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name!r} is not an array of numbers: {error}") from error
