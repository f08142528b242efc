"""How much training the sources need: success and held-out error against iterations.

python benchmarks/budget.py                                          # square ph, four budgets, one seed
python benchmarks/budget.py --task can --budgets 2500 10000 --nfe 1
python benchmarks/budget.py --resume                                 # after an interruption

Every budget is a training of its own, with its own learning-rate schedule. The policies of robomimic.py
with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

from lab.command_line import parse, script, started
from lab.comparison import compare
from lab.measures import held_out
from lab.options import MeasuredOptions, check_given, check_single
from lab.plots import plot_lines
from lab.policies import policies_of, write_rows
from lab.presets import PRESETS, study
from lab.report import labelled, per_seed, table, write_report
from lab.rows import PLAYED, read_rows
from lab.tasks import check_counts, title_of
from warmprior.diagnostics import action_error, encoded_windows
from warmprior.training import TrainingConfig


@dataclass(frozen=True)
class BudgetOptions(MeasuredOptions):
    """A comparison at several lengths of training."""

    budgets: tuple[int, ...] = (2_500, 5_000, 10_000, 20_000)  # iterations, instead of --iterations

    def check(self) -> None:
        super().check()
        check_single(self, "sigma")
        check_counts(self, "budgets")
        check_given(self, "budgets")

    def trainings(self) -> list[TrainingConfig]:
        """One per budget, the shortest first, each with its last policy alone."""
        budgets = sorted(set(self.budgets))
        return [replace(self.training, iterations=n, checkpoints=1) for n in budgets]


@script("budget.py")
def main(argv: list[str] | None) -> None:
    """Train and play a policy per source and number of iterations."""
    presets = {name: study(BudgetOptions, base, observations=1_000) for name, base in PRESETS.items()}
    options = parse(presets, argv, "budget", __doc__)
    with started(options, "budget") as out:
        policies = policies_of(options)
        # Before the hours of training: what cannot be measured on is better known now.
        observations, source = held_out(options, policies[0])
        _, failures = compare(options, policies)
        error: dict[tuple[str, int], float] = {}
        for policy in (policy for policy in policies if policy.is_trained):
            actor, nfes = policy.load(), policy.method.nfes(options.evaluation.nfe)
            windows = observations.windows(actor.prior, see_history=policy.method.parts.sees_history)
            found = action_error(actor, encoded_windows(actor, windows), nfes=nfes)
            error |= {(policy.name, nfe): value for nfe, value in found.items()}
        played = read_rows(out / "results.jsonl", PLAYED)
        measured = [{**row, "action_error": error[row["policy"], row["nfe"]]} for row in played]
        rows = write_rows(out / "results.jsonl", measured)
        seeds = per_seed(labelled(rows), options.evaluation.top_k)
        seeds = seeds.sort_values(["iterations", "nfe"], ascending=[True, False], kind="stable")
        lines = {"success": "success rate", "action_error": "squared error, held out"}
        title = title_of(policies[0].task())
        plot_lines(seeds, out / "budget.png", title, "iterations", lines, scale="log")
        notes = [
            f"Error: on {source}. It favours the average of all good actions, so it grows with NFE where the "
            "data leave a choice."
        ]
        text = table(seeds, ["iterations", "nfe", "method"], ["success", "action_error"], notes)
        write_report(out, text, text, rows, failures)


if __name__ == "__main__":
    sys.exit(main())
