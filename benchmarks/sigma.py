"""The paper's sigma ablation: success, curvature and the branching bound against the residual noise.

python benchmarks/sigma.py                                # square ph, one seed, under an hour on two cores
python benchmarks/sigma.py --style mh --preset cpu         # the paper's task, three seeds
python benchmarks/sigma.py --resume                       # after an interruption

Policies that robomimic.py trained with the same options are reused.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

from lab.options.command_line import parse, script, started
from lab.options.options import MeasuredOptions, Options, check_single
from lab.options.presets import PRESETS, study

SIGMAS = (1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0)


def preset(base: Options) -> MeasuredOptions:
    """Return a preset with the paper's seven sigmas, at one network evaluation per chunk."""
    sources, evaluation = replace(base.sources, sigma=SIGMAS), replace(base.evaluation, nfe=(1,))
    return study(MeasuredOptions, base, sources=sources, evaluation=evaluation)


@script("sigma.py")
def main(argv: list[str] | None) -> None:
    """Train a policy per source and sigma, play it, and measure its flow."""
    presets = {name: preset(base) for name, base in PRESETS.items()}
    options = parse(presets, argv, "sigma", __doc__)
    import pandas as pd

    from lab.demonstrations.loading import title_of
    from lab.measures.straightness import check_flows, straightness
    from lab.reporting.paper import paper_success
    from lab.reporting.plots import plot_lines
    from lab.reporting.report import labelled, per_seed, pooled, table, write_report
    from lab.reporting.rows import write_rows
    from lab.running.comparison import compare
    from lab.running.measuring import held_out
    from lab.running.policies import policies_of, trained_actors

    check_single(options, "nfe", "temperature")
    check_flows(options.sources.methods())
    with started(options, "sigma") as out:
        policies = policies_of(options)
        # Before the training, so that data that cannot be measured on cost no hours.
        observations, source = held_out(options, policies[0])
        rows, failures = compare(options, policies)
        seeds = per_seed(labelled(rows, "sigma"), options.evaluation.top_k)
        seeds = seeds.assign(paper=seeds.apply(paper_success, axis=1))
        text = table(seeds, ["method", "sigma"], ["success", "paper"])
        actors = trained_actors(policies, options.run.device)
        if not any(method.is_flow for method in actors):  # a seed of each failed, so this raises
            write_report(out, text, text, rows, failures)
        flow = straightness(actors, observations)
        curvatures = write_rows(out / "curvature.jsonl", flow)
        title = f"{title_of(policies[0].task())}, NFE {options.evaluation.nfe[0]}"
        # A line per source; a source without the option sigma is a single point.
        flow = pooled(curvatures[curvatures["mean"] == "training"])
        flow = flow.assign(relative_bound=flow.bound_executed / (flow.bound_executed.iloc[0] or math.nan))
        both = labelled(pd.concat([per_seed(rows, options.evaluation.top_k), flow]), "sigma", "chunk")
        both = both.assign(panel=title).sort_values("sigma", ascending=False, kind="stable")
        pair = ("ratio_executed", "relative_bound")
        lines = {"success": "success rate", pair: "curvature (dotted: bound)"}
        plot_lines(both, out / "sigma.png", "", "sigma", lines, column="panel")
        flow = labelled(pooled(curvatures), "sigma")
        names = ["ratio_executed", "ratio_relative", "bound_executed"]
        notes = [
            f"Flow: measured on {source}, relative to {curvatures.policy.iloc[0]}. A dash marks a policy "
            "that predicts no motion."
        ]
        text += "\n" + table(flow, ["method", "sigma", "mean"], names, notes)
        write_report(out, text, text, pd.concat([rows, curvatures]), failures)


if __name__ == "__main__":
    sys.exit(main())
