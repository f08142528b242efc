"""Policies on robots, which do not wait for a computation."""

from warmprior.deploy.executor import AsyncExecutor
from warmprior.deploy.exported import ExportedPolicy, export_policy, load_exported

__all__ = ["AsyncExecutor", "ExportedPolicy", "export_policy", "load_exported"]
