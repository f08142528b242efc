"""Success statistics, tables and figures."""

from warmprior.diagnostics.paper import PAPER_SUCCESS, paper_success
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.diagnostics.results import Results, Row, success_table, summarize
from warmprior.diagnostics.statistics import (
    SeedSummary,
    exceeds_one_sigma,
    success_posterior,
    summarize_seeds,
    top_k_mean,
)

__all__ = [
    "PAPER_SUCCESS",
    "Results",
    "Row",
    "SeedSummary",
    "exceeds_one_sigma",
    "paper_success",
    "plot_filmstrip",
    "plot_learning_curves",
    "plot_success",
    "success_posterior",
    "success_table",
    "summarize",
    "summarize_seeds",
    "top_k_mean",
]
