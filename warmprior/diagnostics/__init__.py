"""Measures of flows, of executed actions and of success rates."""

from warmprior.diagnostics.curvature import branching_bound, branching_cost, curvature, flow_paths
from warmprior.diagnostics.errors import MeanError, action_error, mean_error, mean_revision, source_coverage
from warmprior.diagnostics.flow import SharedObservations, encoded_windows
from warmprior.diagnostics.leaks import HistoryShift, SourceLeak, memory_gain, source_leak
from warmprior.diagnostics.smoothness import Smoothness, executed_actions, smoothness
from warmprior.diagnostics.statistics import (
    paired_probability_better,
    probability_better,
    success_posterior,
)

__all__ = [
    "HistoryShift",
    "MeanError",
    "SharedObservations",
    "Smoothness",
    "SourceLeak",
    "action_error",
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
]
