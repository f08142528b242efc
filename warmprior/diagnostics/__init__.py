"""Success statistics, tables and figures."""

from warmprior.diagnostics.branching import branching_bound, branching_cost
from warmprior.diagnostics.curvature import compare_curvature, curvature
from warmprior.diagnostics.history_shift import HistoryShift
from warmprior.diagnostics.navigation_plots import plot_flow_paths, plot_navigation
from warmprior.diagnostics.paper import PAPER_SUCCESS, paper_success
from warmprior.diagnostics.paths import flow_paths, forecast_mean
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.diagnostics.results import Results, Row, success_table, summarize
from warmprior.diagnostics.smoothness import (
    Smoothness,
    compare_smoothness,
    executed_actions,
    smoothness,
)
from warmprior.diagnostics.statistics import (
    SeedSummary,
    exceeds_one_sigma,
    probability_better,
    success_posterior,
    summarize_seeds,
    top_k_mean,
)

__all__ = [
    "PAPER_SUCCESS",
    "HistoryShift",
    "Results",
    "Row",
    "SeedSummary",
    "Smoothness",
    "branching_bound",
    "branching_cost",
    "compare_curvature",
    "compare_smoothness",
    "curvature",
    "exceeds_one_sigma",
    "executed_actions",
    "flow_paths",
    "forecast_mean",
    "paper_success",
    "plot_filmstrip",
    "plot_flow_paths",
    "plot_learning_curves",
    "plot_navigation",
    "plot_success",
    "probability_better",
    "smoothness",
    "success_posterior",
    "success_table",
    "summarize",
    "summarize_seeds",
    "top_k_mean",
]
