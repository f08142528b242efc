"""Off-screen rendering: which OpenGL backend works here, and one frame on demand.

MuJoCo's backend is chosen by the environment variable ``MUJOCO_GL``, and robosuite overrides it
when imported. Nothing here runs until a frame is asked for, so machines without OpenGL can still
simulate.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from typing import Any

import numpy as np

from warmprior.io.extras import require

__all__ = ["render_camera", "rendering_backend", "require_rendering"]

# EGL first: it uses a GPU where there is one. Both render the same pixels in software.
_BACKENDS = ("egl", "osmesa")
_PROBE = """
import mujoco
context = mujoco.GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


@functools.cache
def rendering_backend() -> str | None:
    """Find an OpenGL backend that renders without a display.

    ``MUJOCO_GL`` is tried first if it names one, then ``egl``, then ``osmesa``. Each is tried in a
    process of its own, because a failed attempt cannot be undone; the answer is kept.

    Returns:
        ``"egl"``, ``"osmesa"``, or ``None`` if neither works.

    Examples:
        >>> rendering_backend() in ("egl", "osmesa", None)  # doctest: +SKIP
        True
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    for backend in sorted(_BACKENDS, key=lambda name: name != asked):
        environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False
        )
        if probe.returncode == 0:
            return backend
    return None


def require_rendering() -> str:
    """The backend that renders here.

    Raises:
        RuntimeError: if none does; the message names the packages to install.
    """
    backend = rendering_backend()
    if backend is None:
        raise RuntimeError(
            "cannot render: neither EGL nor OSMesa works here. On Debian or Ubuntu install one of "
            "them: apt-get install libegl1 (with libegl-mesa0) or apt-get install libosmesa6"
        )
    return backend


def _attach_context(sim: Any) -> None:
    """Give a simulation an off-screen context without disturbing its physics."""
    backend = require_rendering()
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
    binding: Any = require("robosuite.utils.binding_utils", "sim")
    # robosuite read the variable when it was imported, which may be before the backend was known.
    binding._MUJOCO_GL = backend
    # Creating a context evaluates the dynamics, which would change the solver's starting point and
    # with it the episode: a rendered run has to equal the same run unrendered.
    warm_start = sim.data.qacc_warmstart.copy()
    context = binding.MjRenderContextOffscreen(sim, device_id=-1)
    sim.data.qacc_warmstart[:] = warm_start
    context.vopt.geomgroup[0] = 0  # collision meshes
    context.vopt.geomgroup[1] = 1  # visual meshes


def render_camera(env: Any, camera: str, height: int, width: int) -> np.ndarray:
    """Render the current state of a robosuite environment.

    Args:
        env: the robosuite environment.
        camera: a camera of its model, e.g. ``"agentview"``.
        height: of the image, in pixels.
        width: of the image, in pixels.

    Returns:
        uint8 ``[height, width, 3]``, the right way up.

    Raises:
        ValueError: if the model has no such camera.
        RuntimeError: if no OpenGL backend works.

    Examples:
        >>> render_camera(env, "agentview", 84, 84).shape  # doctest: +SKIP
        (84, 84, 3)
    """
    sim = env.sim
    cameras = tuple(sim.model.camera_names)
    if camera not in cameras:
        raise ValueError(f"no camera {camera!r}; choose one of {', '.join(cameras)}")
    if sim._render_context_offscreen is None:
        _attach_context(sim)
    mujoco = require("mujoco", "sim")
    model, data = sim.model._model, sim.data._data
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    # OpenGL counts rows from the bottom.
    return sim.render(width=width, height=height, camera_name=camera)[::-1].copy()
