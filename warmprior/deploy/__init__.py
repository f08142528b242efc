"""Policies on robots, which do not wait."""

from warmprior.deploy.executor import AsyncExecutor

__all__ = ["AsyncExecutor"]
