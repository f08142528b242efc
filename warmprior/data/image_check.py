"""A comparison of demonstrations' images with those of the simulator."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cached_property
from importlib.metadata import version

import numpy as np

from warmprior.data.checks import DatasetError, store_finite
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.index import DatasetIndex
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.rendering import CameraRenderer
from warmprior.envs.simulator import make_simulator, scene_stays

RENDERER_VERSION = 2
"""The version of rendering here; it is raised whenever the same states give other images."""

CLEARLY = 8.0
"""The mean difference of two images, out of 255, above which they show different things."""


def renderer_versions() -> tuple[int | str, ...]:
    """Return the versions on which images of the same states depend, in addition to the options."""
    return RENDERER_VERSION, version("mujoco"), version("robosuite")


class StateRenderer:
    """A renderer of demonstrations' states; it builds its simulator when first needed."""

    def __init__(self, index: DatasetIndex, size: tuple[int, int], fast: bool) -> None:
        self.index, self.size, self.fast = index, size, fast

    @cached_property
    def renderer(self) -> CameraRenderer:
        """The renderer of the simulator's model, in which nothing may depend on a reset."""
        env = make_simulator(modernize_env_args(self.index.env_args))
        if not scene_stays(env):
            what = f"{type(env).__name__} moves fixtures at resets: images do not follow from states"
            raise DatasetError(f"{self.index.path}: {what}")
        model = env.sim.model._model
        return CameraRenderer(model, *self.size, fast=self.fast)

    def joints(self, states: np.ndarray, steps: int, what: str) -> np.ndarray:
        """Return the positions of all joints, ``[steps, nq]``, in states of this simulator."""
        model = self.renderer.model
        expected = (steps, 1 + model.nq + model.nv)
        if states.shape != expected:
            name = self.index.env_args["env_name"]
            raise DatasetError(f"{what} has shape {states.shape}, but the simulator of {name} has {expected}")
        store_finite(states, states, what, "Leave the demo out.")  # MuJoCo would render NaN without an error
        return states[:, 1 : 1 + model.nq]

    def compare(self, state: np.ndarray, images: Mapping[str, np.ndarray]) -> None:
        """Compare images of a state, by camera, with the simulator's."""
        name = self.index.path
        (joints,) = self.joints(state[None], 1, f"{name}: the first state")
        for camera, image in images.items():
            shown = self.renderer.render(camera, joints).astype(np.float32)
            stored = image.astype(np.float32)
            views = {
                "show something else than the simulator": stored,
                "are upside down": stored[::-1],
                "have red and blue exchanged": stored[..., ::-1],
            }
            off = {name: float(np.abs(shown - image).mean()) for name, image in views.items()}
            (as_stored, *_), view = off.values(), min(off, key=lambda name: off[name])
            # Most of a scene may look the same upside down, and have little colour.
            other = as_stored > 1 and off[view] < as_stored / 2
            if other or as_stored > CLEARLY:
                view = view if other else next(iter(views))
                raise DatasetError(
                    f"{name}: images of {camera} {view} ({as_stored:.0f} of 255 off): render these again"
                )


def check_images(demonstrations: Demonstrations, index: DatasetIndex, fast: bool) -> None:
    """Compare the first images of an index, as they are stored, with the simulator's.

    Raises DatasetError if they differ, or were rendered in the other quality; warns if there is no state, or
    this machine cannot render, or lacks the simulator.
    """
    rendering, state = demonstrations.origin(index)
    if rendering is not None and bool(rendering["fast"]) != fast:
        how = "in full quality" if fast else "fast"
        raise DatasetError(f"{index.path}: its images were rendered {how}: use fast_rendering={not fast}")
    why = "it holds no states"
    if state is not None:
        with demonstrations.reader(index) as reader:
            first = {key: next(reader.images(index.demos[0], key))[0] for key in index.image_keys}
        images = {key.removesuffix("_image"): image.permute(1, 2, 0).numpy() for key, image in first.items()}
        try:
            for size in {*index.image_shapes}:
                stored = {camera: image for camera, image in images.items() if image.shape[:2] == size}
                StateRenderer(index, size, fast).compare(state, stored)
            return
        except ImportError as error:  # policies are often trained where nothing renders
            why = str(error)
    warnings.warn(f"{index.path}: its images are not compared with the simulator's: {why}", stacklevel=2)
