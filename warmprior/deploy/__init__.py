"""Policies on robots, which do not wait for a computation."""

from warmprior.deploy.executor import AsyncExecutor

__all__ = ["AsyncExecutor"]
