"""Measures of flows, of executed actions and of success rates."""

from warmprior.diagnostics.action_error import action_error
from warmprior.diagnostics.branching import branching_bound, branching_cost
from warmprior.diagnostics.coverage import source_coverage
from warmprior.diagnostics.curvature import curvature
from warmprior.diagnostics.flow import encoded_windows
from warmprior.diagnostics.mean_error import MeanError, mean_error, mean_revision
from warmprior.diagnostics.memory_gain import memory_gain
from warmprior.diagnostics.paths import flow_paths
from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.diagnostics.smoothness import Smoothness, executed_actions, smoothness
from warmprior.diagnostics.source_leak import SourceLeak, source_leak
from warmprior.diagnostics.statistics import (
    bootstrap_ratio,
    paired_probability_better,
    probability_better,
    success_posterior,
    top_k_mean,
)

__all__ = [
    "MeanError",
    "SharedObservations",
    "Smoothness",
    "SourceLeak",
    "action_error",
    "bootstrap_ratio",
    "branching_bound",
    "branching_cost",
    "curvature",
    "encoded_windows",
    "executed_actions",
    "flow_paths",
    "mean_error",
    "mean_revision",
    "memory_gain",
    "paired_probability_better",
    "probability_better",
    "smoothness",
    "source_coverage",
    "source_leak",
    "success_posterior",
    "top_k_mean",
]
