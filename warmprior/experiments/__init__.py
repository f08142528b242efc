"""Experiments: from options to trained policies, rows, tables and figures. Needs ``warmprior[sim]``."""

from warmprior.experiments.card import PolicyResults, model_card, policy_results
from warmprior.experiments.cli import parse, started, write_report
from warmprior.experiments.comparison import Comparison
from warmprior.experiments.condition import Condition
from warmprior.experiments.contestant import Contestant
from warmprior.experiments.delayed import DelayedRecipe, guided_labels
from warmprior.experiments.figures import (
    plot_filmstrip,
    plot_learning_curves,
    plot_reinforcement,
    plot_success,
    plot_success_bars,
)
from warmprior.experiments.labels import prior_color, prior_label, source_labels
from warmprior.experiments.methods import METHODS, Method
from warmprior.experiments.navigation1d import (
    NAVIGATION_PRESETS,
    NavigationRecipe,
    judge_navigation,
    play_navigation,
)
from warmprior.experiments.navigation_figures import plot_flow_paths, plot_navigation
from warmprior.experiments.paper import paper_success
from warmprior.experiments.presets import PRESETS, comparison_preset
from warmprior.experiments.problem import (
    Problem,
    find_problems,
    navigation_problem,
    observe,
    robosuite_problem,
)
from warmprior.experiments.recipe import (
    DataOptions,
    EvaluationOptions,
    HeldOutOptions,
    MeasuredRecipe,
    NetworkOptions,
    PolicyOptions,
    Recipe,
    RunOptions,
    SourceOptions,
)
from warmprior.experiments.record import record, restore
from warmprior.experiments.results import Results, Row, grouped, mean_known, select, success_summary
from warmprior.experiments.store import Store, finished_policies
from warmprior.experiments.straightness import straightness
from warmprior.experiments.study_figures import (
    plot_budget,
    plot_chunk_lengths,
    plot_delays,
    plot_sigma,
)
from warmprior.experiments.success_study import study_success
from warmprior.experiments.tables import (
    curvature_table,
    flow_table,
    mean_cell,
    success_cell,
    success_table,
    table,
)

__all__ = [
    "METHODS",
    "NAVIGATION_PRESETS",
    "PRESETS",
    "Comparison",
    "Condition",
    "Contestant",
    "DataOptions",
    "DelayedRecipe",
    "EvaluationOptions",
    "HeldOutOptions",
    "MeasuredRecipe",
    "Method",
    "NavigationRecipe",
    "NetworkOptions",
    "PolicyOptions",
    "PolicyResults",
    "Problem",
    "Recipe",
    "Results",
    "Row",
    "RunOptions",
    "SourceOptions",
    "Store",
    "comparison_preset",
    "curvature_table",
    "find_problems",
    "finished_policies",
    "flow_table",
    "grouped",
    "guided_labels",
    "judge_navigation",
    "mean_cell",
    "mean_known",
    "model_card",
    "navigation_problem",
    "observe",
    "paper_success",
    "parse",
    "play_navigation",
    "plot_budget",
    "plot_chunk_lengths",
    "plot_delays",
    "plot_filmstrip",
    "plot_flow_paths",
    "plot_learning_curves",
    "plot_navigation",
    "plot_reinforcement",
    "plot_sigma",
    "plot_success",
    "plot_success_bars",
    "policy_results",
    "prior_color",
    "prior_label",
    "record",
    "restore",
    "robosuite_problem",
    "select",
    "source_labels",
    "started",
    "straightness",
    "study_success",
    "success_cell",
    "success_summary",
    "success_table",
    "table",
    "write_report",
]
