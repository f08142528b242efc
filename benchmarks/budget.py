"""The training that sources need: success and held-out error against iterations.

python benchmarks/budget.py                                          # square ph, four budgets, one seed
python benchmarks/budget.py --task can --budgets 2500 10000 --nfe 1
python benchmarks/budget.py --resume                                 # after an interruption

Every budget is a separate training with its own learning-rate schedule. Policies that robomimic.py trained
with the same options are reused.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lab.demonstrations.data_options import check_counts
from lab.options.command_line import parse, script, started
from lab.options.options import MeasuredOptions, check_given, check_single
from lab.options.presets import PRESETS, study

if TYPE_CHECKING:
    from warmprior.options.training import TrainingConfig


@dataclass(frozen=True)
class BudgetOptions(MeasuredOptions):
    """Options of a comparison at several lengths of training."""

    budgets: tuple[int, ...] = (2_500, 5_000, 10_000, 20_000)  # training lengths in place of --iterations

    def check(self) -> None:
        super().check()
        check_single(self, "sigma", "temperature")
        check_counts(self, "budgets")
        check_given(self, "budgets")

    def trainings(self) -> list[TrainingConfig]:
        """Return a training per budget, the shortest first; each saves only its last policy."""
        budgets = sorted(set(self.budgets))
        return [replace(self.training, iterations=n, checkpoints=1) for n in budgets]


@script("budget.py")
def main(argv: list[str] | None) -> None:
    """Train and play a policy per source and number of iterations."""
    presets = {name: study(BudgetOptions, base, measured=1_000) for name, base in PRESETS.items()}
    options = parse(presets, argv, "budget", __doc__)
    from lab.demonstrations.loading import title_of
    from lab.reporting.plots import plot_lines
    from lab.reporting.report import labelled, per_seed, table, write_report
    from lab.reporting.rows import PLAYED, RESULTS, read_rows, write_rows
    from lab.running.comparison import compare
    from lab.running.measuring import held_out
    from lab.running.policies import policies_of
    from warmprior.diagnostics import action_error, encoded_windows

    with started(options, "budget") as out:
        policies = policies_of(options)
        # Before the training, so that data that cannot be measured on cost no hours.
        observations, source = held_out(options, policies[0])
        _, failures = compare(options, policies)
        error: dict[tuple[str, int], float] = {}
        for policy in (policy for policy in policies if policy.is_trained):
            actor, nfes = policy.load(), policy.method.nfes(options.evaluation.nfe)
            windows = observations.windows(actor.prior, see_history=policy.method.parts.sees_history)
            error_by_nfe = action_error(actor, encoded_windows(actor, windows), nfes=nfes)
            error |= {(policy.name, nfe): value for nfe, value in error_by_nfe.items()}
        played = read_rows(out / RESULTS, PLAYED)
        measured = [{**row, "action_error": error[row["policy"], row["nfe"]]} for row in played]
        rows = write_rows(out / RESULTS, measured)
        seeds = per_seed(labelled(rows), options.evaluation.top_k)
        seeds = seeds.sort_values(["iterations", "nfe"], ascending=[True, False], kind="stable")
        lines = {"success": "success rate", "action_error": "held-out squared error"}
        title = title_of(policies[0].task())
        plot_lines(seeds, out / "budget.png", title, "iterations", lines, scale="log")
        notes = [
            f"Error: mean squared error on {source}. Where several actions are good, their average has the "
            "smallest error, so the error grows with NFE."
        ]
        text = table(seeds, ["iterations", "nfe", "method"], ["success", "action_error"], notes)
        write_report(out, text, text, rows, failures)


if __name__ == "__main__":
    sys.exit(main())
