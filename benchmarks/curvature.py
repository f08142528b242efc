"""Curvature of the flow (the paper's Table 2 and Fig. 4): how straight each source makes it.

python benchmarks/curvature.py --run runs/can-ph-quick     # the policies of a finished run
python benchmarks/curvature.py --style mh --preset cpu         # policies of these options, trained first
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from lab.options.command_line import parse, script, started
from lab.options.options import FinishedRun, MeasuredOptions
from lab.options.presets import PRESETS, study


@dataclass(frozen=True)
class CurvatureOptions(MeasuredOptions):
    """Options of the curvature study."""

    policies: FinishedRun = None  # folder of a finished run whose policies to measure (default: train them)

    @property
    def name(self) -> str:
        return super().name if self.policies is None else self.policies.resolve().name


@script("curvature.py")
def main(argv: list[str] | None) -> None:
    """Train the policies, or take those of a run, and measure how straight their flows are."""
    presets = {name: study(CurvatureOptions, base, measured=2_000) for name, base in PRESETS.items()}
    options = parse(presets, argv, "curvature", __doc__)
    import torch

    from lab.measures.straightness import RATIOS, check_flows, straightness
    from lab.reporting.paper import paper_curvature
    from lab.reporting.plots import plot_flow_paths
    from lab.reporting.report import counted, labelled, pooled, setting_title, table, write_report
    from lab.reporting.rows import write_rows
    from lab.running.comparison import train_all
    from lab.running.measuring import held_out
    from lab.running.policies import facts_of, finished_policies, policies_of, trained_actors
    from warmprior.diagnostics import encoded_windows, flow_paths

    check_flows(options.sources.methods())
    with started(options, "curvature") as out:
        run = options.policies
        policies = policies_of(options) if run is None else finished_policies(run, options)
        if run is not None and len({policy.training.seed for policy in policies}) < options.evaluation.seeds:
            raise ValueError(f"--run {run} has fewer seeds than --seeds {options.evaluation.seeds}")
        policies = [policy for policy in policies if policy.training.seed in options.seeds]
        # Before the training, so that data that cannot be measured on cost no hours.
        observations, source = held_out(options, policies[0])
        if run is None:
            train_all(options, policies)
        task, actors = facts_of(policies[0].task()), trained_actors(policies, options.run.device)
        measured = straightness(actors, observations)
        rows = write_rows(out / "curvature.jsonl", measured)

        few = observations.subset(torch.linspace(0, len(observations) - 1, 40).long())
        labels = dict(zip(rows.policy, labelled(rows).method, strict=True))
        paths = {}
        for method, by_seed in actors.items():
            if str(method) in labels:
                actor = by_seed[min(by_seed)]
                generator = torch.Generator(options.run.device).manual_seed(0)
                windows = few.windows(actor.prior, see_history=actor.sees_history)
                windows = encoded_windows(actor, windows)
                path = flow_paths(actor, windows, generator=generator)
                paths[labels[str(method)]] = path[..., 0, 0].cpu()
        title = f"{task['task']} {task['data']}: action coordinate 0 along the flow,\n{source}"
        plot_flow_paths(paths, out / "flow_paths.png", title=title)
        seeds = rows.seed.dropna().nunique()
        notes = [
            f"{setting_title(task)}, {len(observations)} observations of {source}, {counted(seeds, 'seed')}. "
            "In brackets: 95% bootstrap intervals over episodes.",
            "The paper does not say which mean it uses, nor whether it averages over all 2H positions.",
            "Shorter paths have less curvature. Curvature divided by the squared mean velocity does not "
            "depend on their length.",
        ]
        chosen = labelled(pooled(rows))
        if chosen.prior.iloc[0] == "gaussian":  # the paper's ratios are to the Gaussian source
            chosen = chosen.assign(
                paper_ratio=[paper_curvature(task | row) for row in chosen.to_dict("records")]
            )
        text = table(chosen, ["mean", "method"], [*RATIOS, "paper_ratio"], notes)
        write_report(out, text, text, rows)


if __name__ == "__main__":
    sys.exit(main())
