"""How much training the sources need: success and held-out error against iterations.

python benchmarks/budget.py                                          # square ph, four budgets, one seed
python benchmarks/budget.py --task can --budgets 2500 10000 --nfe 1
python benchmarks/budget.py --resume                                 # after an interruption

Every budget is a training of its own, with its own learning-rate schedule. The policies of robomimic.py
with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from warmprior.diagnostics import SharedObservations, action_error, encoded_windows
from warmprior.experiments import (
    PRESETS,
    Comparison,
    HeldOutOptions,
    MeasuredRecipe,
    Row,
    comparison_preset,
    mean_known,
    parse,
    plot_budget,
    started,
    success_cell,
    table,
    write_report,
)
from warmprior.experiments.recipe import check_counts
from warmprior.experiments.tables import source_at_nfe
from warmprior.io.script import run_script
from warmprior.training import TrainingConfig


@dataclass(frozen=True)
class BudgetRecipe(MeasuredRecipe):
    """A comparison at several lengths of training.

    Attributes:
        budgets: iterations to train for, instead of --iterations.
    """

    budgets: tuple[int, ...] = (2_500, 5_000, 10_000, 20_000)

    def check(self) -> None:
        """Refuse what cannot work, before any work."""
        super().check()
        self.check_single(sigma=True)
        check_counts(self, "budgets")
        if not self.budgets:
            raise ValueError("--budgets needs at least one number of iterations")

    def trainings(self) -> list[TrainingConfig]:
        """One per budget, the shortest first, each with its last policy alone."""
        return [
            replace(self.training, iterations=n, checkpoints=1) for n in sorted(set(self.budgets))
        ]


def with_errors(comparison: Comparison, observations: SharedObservations) -> list[Row]:
    """The rows, with the error of their policies on demonstrations that none was trained on."""
    errors: dict[tuple[Any, ...], float] = {}
    for contestant in comparison.contestants:
        player = comparison.player(contestant)
        windows = observations.windows(player.prior, see_history=contestant.method.sees_history)
        windows = encoded_windows(player, windows)
        found = action_error(player, windows, nfes=comparison.nfes)
        for nfe, error in found.items():
            errors[(*contestant.facts().values(), nfe)] = error
    names = (*comparison.contestants[0].facts(), "nfe")
    return [
        replace(
            row, measures={**row.measures, "action_error": errors[tuple(row[n] for n in names)]}
        )
        for row in comparison.rows
    ]


def make_table(rows: Sequence[Row], top_k: int) -> str:
    success = success_cell(top_k)
    return table(
        sorted(rows, key=lambda row: (row["iterations"], -row["nfe"])),
        lambda row: str(row["iterations"]),
        source_at_nfe(rows),
        {"": lambda cell: f"{success(cell)} ({mean_known(cell, 'action_error'):.4f})"},
        head="iterations",
        notes=[
            "Success in percent; in parentheses the mean squared error of the executed actions on held-out "
            "demonstrations, given the mean of the training, in squared normalised action units. The error "
            "prefers the average of what could be done, and grows with NFE where the data leave a choice."
        ],
    )


def run(argv: Sequence[str] | None) -> None:
    presets = {
        name: BudgetRecipe.of(preset, held_out=HeldOutOptions(observations=1_000))
        for name, preset in PRESETS.items()
    }
    recipe = parse(
        presets,
        argv,
        study="budget",
        description=__doc__,
        preset=partial(comparison_preset, presets=presets),
        # Every budget is a number of iterations, with its last policy; no curvature is measured.
        unused=("iterations", "checkpoints", "steps", "draws"),
    )
    with started(recipe, "budget") as out:
        comparison = Comparison(recipe, "budget")
        # Before the hours of training: what cannot be measured on is better known now.
        observations, source = comparison.observe(recipe.held_out)
        comparison.results.meta["observations"] = source
        comparison.run()
        rows = with_errors(comparison, observations)
        comparison.results.add(*rows)
        top_k = recipe.evaluation.top_k
        plot_budget(rows, out / "budget.png", top_k=top_k, title=comparison.title)
        write_report(out, make_table(rows, top_k), comparison.failures)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "budget.py")


if __name__ == "__main__":
    sys.exit(main())
