"""Off-screen rendering: the choice of an OpenGL backend, and single frames.

robosuite overrides the environment variable ``MUJOCO_GL`` when imported. Nothing here runs until a frame is
needed, so machines without OpenGL can still simulate.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import os
import subprocess
import sys
import weakref
from typing import Any

import numpy as np

from warmprior.checks import check_choice
from warmprior.io.extras import require
from warmprior.io.workers import stop_forking

# EGL first, because it uses a GPU if there is one. Both render the same pixels in software.
_BACKENDS = ("egl", "osmesa")
_BUFFER = (640, 480)  # as in robosuite; an image is a corner of it, so its size affects smoothed edges
_MOST_GEOMS = 10_000
_rendering_process: int | None = None
_OPEN: weakref.WeakSet[CameraRenderer] = weakref.WeakSet()
_PROBE = """
import mujoco
context = mujoco.GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


@functools.cache
def rendering_backend() -> str | None:
    """Return the OpenGL backend that renders without a display, ``"egl"``, ``"osmesa"`` or ``None``.

    ``MUJOCO_GL`` is tried first if it names one. Each is tried in a separate process, because a failed
    attempt cannot be undone; the result is cached.

    Examples:
        >>> from warmprior.envs import rendering_backend
        >>> rendering_backend() in ("egl", "osmesa", None)  # doctest: +SKIP
        True
    """
    first = os.environ.get("MUJOCO_GL", "").lower()
    for backend in sorted(_BACKENDS, key=lambda name: name != first):
        environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False
        )
        if probe.returncode == 0:
            return backend
    return None


def require_rendering() -> str:
    """Return the backend that renders here; raise ImportError with packages to install if none does."""
    backend = rendering_backend()
    if backend is None:
        require("mujoco", "sim")  # no backend can be tried without mujoco
        raise ImportError(
            "neither EGL nor OSMesa works here: apt-get install libegl1 libegl-mesa0 or libosmesa6"
        )
    return backend


class CameraRenderer:
    """A renderer of the cameras of a MuJoCo model, an ``MjModel``, independent of any episode.

    ``fast`` leaves out reflections, shadows and smooth edges: it is three to five times faster, and its
    images differ by 1 to 2 of 255 on average.
    """

    def __init__(self, model: Any, height: int, width: int, *, fast: bool = False) -> None:
        backend = require_rendering()
        _check_process()
        os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
        # The backend's own module, because mujoco.GLContext was chosen when mujoco was imported.
        gl = importlib.import_module(f"mujoco.{backend}").GLContext
        mujoco = self._mujoco = require("mujoco", "sim")
        self.model, self.height, self.width = model, height, width
        self._data, self._scene = mujoco.MjData(model), mujoco.MjvScene(model, _MOST_GEOMS)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._option.geomgroup[:2] = 0, 1  # visual meshes instead of collision meshes
        if fast:
            flags = mujoco.mjtRndFlag
            self._scene.flags[flags.mjRND_REFLECTION] = self._scene.flags[flags.mjRND_SHADOW] = 0
        buffer = (width, height) if fast else (max(width, _BUFFER[0]), max(height, _BUFFER[1]))
        self._gl = gl(*buffer)
        self._gl.make_current()
        sizes, quality = model.vis.global_, model.vis.quality
        before = sizes.offwidth, sizes.offheight, quality.offsamples
        sizes.offwidth, sizes.offheight = buffer
        quality.offsamples = 0 if fast else before[2]
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:
            raise ValueError(f"OpenGL cannot render {width} x {height} pixels here: {error}") from error
        finally:
            sizes.offwidth, sizes.offheight, quality.offsamples = before
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if not _OPEN:
            # Registered after mujoco's own handler, which ends OpenGL, so that this one runs first.
            atexit.register(_close_all)
        _OPEN.add(self)

    def close(self) -> None:
        """Free the resources of OpenGL."""
        if self in _OPEN:
            _OPEN.discard(self)
            if os.getpid() != _rendering_process:  # the resources belong to the parent process
                return
            self._gl.make_current()
            self._context.free()
            self._gl.free()

    def __del__(self) -> None:
        self.close()

    def render(self, camera: str, qpos: np.ndarray) -> np.ndarray:
        """Return a camera's image, uint8 ``[height, width, 3]``, upright, at joint positions ``[nq]``."""
        _check_process()
        mujoco, model, data = self._mujoco, self.model, self._data
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if number < 0:
            check_choice("camera", camera, [model.camera(i).name for i in range(model.ncam)])
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        self._camera.fixedcamid = number
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
        image = np.empty((self.height, self.width, 3), dtype=np.uint8)
        view = mujoco.MjrRect(0, 0, self.width, self.height)
        self._gl.make_current()
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, view, self._context)
        return image[::-1].copy()  # OpenGL counts rows from the bottom


def _check_process() -> None:
    """Raise RuntimeError in the fork of a process that rendered, which would wait for OpenGL forever."""
    global _rendering_process
    if _rendering_process not in (None, os.getpid()):
        raise RuntimeError("OpenGL does not work in the fork of a process that rendered: start it by spawn")
    _rendering_process = os.getpid()
    stop_forking()


def _close_all() -> None:
    for renderer in list(_OPEN):
        renderer.close()


class EnvRenderers:
    """The renderers of a robosuite environment, built when they are needed."""

    def __init__(self, env: Any, *, fast: bool = False) -> None:
        self.env, self.fast = env, fast
        self._made: dict[tuple[int, int], CameraRenderer] = {}

    def render(self, camera: str, height: int, width: int, qpos: np.ndarray | None = None) -> np.ndarray:
        """Return a camera's image, by default of the current state, see :meth:`CameraRenderer.render`."""
        model = self.env.sim.model._model
        renderer = self._made.get((height, width))
        if renderer is None or renderer.model is not model:  # a reset may load another one
            renderer = CameraRenderer(model, height, width, fast=self.fast)
            self._made[height, width] = renderer
        return renderer.render(camera, self.env.sim.data.qpos if qpos is None else qpos)
