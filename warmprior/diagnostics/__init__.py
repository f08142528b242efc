"""Success statistics, tables and figures."""

from warmprior.diagnostics._figure import prior_color, prior_label
from warmprior.diagnostics.action_error import action_error
from warmprior.diagnostics.branching import branching_bound, branching_cost
from warmprior.diagnostics.curvature import compare_curvature, curvature
from warmprior.diagnostics.held_out import SharedObservations
from warmprior.diagnostics.history_shift import HistoryShift
from warmprior.diagnostics.navigation_plots import plot_flow_paths, plot_navigation
from warmprior.diagnostics.paper import (
    paper_success,
)
from warmprior.diagnostics.paths import flow_paths, forecast_mean
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.diagnostics.reinforcement_plots import plot_reinforcement
from warmprior.diagnostics.results import (
    Results,
    Row,
    success_table,
    summarize,
    summarize_cell,
    write_results,
)
from warmprior.diagnostics.smoothness import (
    Smoothness,
    compare_smoothness,
    executed_actions,
    smoothness,
)
from warmprior.diagnostics.source_leak import SourceLeak, source_leak
from warmprior.diagnostics.statistics import (
    SeedSummary,
    bootstrap_ratio,
    exceeds_one_sigma,
    probability_better,
    success_posterior,
    summarize_seeds,
    top_k_mean,
)
from warmprior.diagnostics.straightness import curvature_table, straightness
from warmprior.diagnostics.study_plots import (
    plot_budget,
    plot_chunk_lengths,
    plot_sigma,
    plot_success_bars,
)
from warmprior.diagnostics.table import markdown_table

__all__ = [
    "HistoryShift",
    "Results",
    "Row",
    "SeedSummary",
    "SharedObservations",
    "Smoothness",
    "SourceLeak",
    "action_error",
    "bootstrap_ratio",
    "branching_bound",
    "branching_cost",
    "compare_curvature",
    "compare_smoothness",
    "curvature",
    "curvature_table",
    "exceeds_one_sigma",
    "executed_actions",
    "flow_paths",
    "forecast_mean",
    "markdown_table",
    "paper_success",
    "plot_budget",
    "plot_chunk_lengths",
    "plot_filmstrip",
    "plot_flow_paths",
    "plot_learning_curves",
    "plot_navigation",
    "plot_reinforcement",
    "plot_sigma",
    "plot_success",
    "plot_success_bars",
    "prior_color",
    "prior_label",
    "probability_better",
    "smoothness",
    "source_leak",
    "straightness",
    "success_posterior",
    "success_table",
    "summarize",
    "summarize_cell",
    "summarize_seeds",
    "top_k_mean",
    "write_results",
]
