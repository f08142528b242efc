"""A renderer that cannot be loaded, which would stop every import of TorchRL."""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from importlib.util import find_spec


def leave_out_broken_renderer() -> None:
    """Forget ``MUJOCO_GL`` if mujoco cannot load what it names, with a warning.

    TorchRL imports mujoco to look for one of its parts, and mujoco the library that the variable names.
    Nothing here needs it: :func:`warmprior.envs.rendering_backend` finds one that works.
    """
    if "MUJOCO_GL" not in os.environ or "mujoco" in sys.modules or find_spec("mujoco") is None:
        return
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # of whatever type the library's absence has
        name = os.environ.pop("MUJOCO_GL")
        if platform is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
        warnings.warn(
            f"MUJOCO_GL={name} names a renderer that cannot be loaded ({error}): it is ignored. Install it, "
            "or name another, egl or osmesa",
            stacklevel=3,
        )
