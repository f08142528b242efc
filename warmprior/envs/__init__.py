"""Environments. robosuite is imported only when one of its environments is built."""

from __future__ import annotations

from warmprior.envs.rendering import rendering_backend
from warmprior.envs.robosuite import RobosuiteEnv, RobosuiteWrapper

__all__ = ["RobosuiteEnv", "RobosuiteWrapper", "rendering_backend"]
