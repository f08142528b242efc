"""Measures of flows, of executed actions and of success rates."""

from warmprior.diagnostics.action_error import action_error
from warmprior.diagnostics.curvature import branching_bound, branching_cost, curvature, flow_paths
from warmprior.diagnostics.flow import SharedObservations, encoded_windows
from warmprior.diagnostics.leaks import HistoryShift, SourceLeak, source_leak
from warmprior.diagnostics.smoothness import Smoothness, executed_actions, smoothness
from warmprior.diagnostics.statistics import success_posterior

__all__ = [
    "HistoryShift",
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
    "smoothness",
    "source_leak",
    "success_posterior",
]
