"""The paper's sigma ablation: success, curvature and the branching bound against the residual noise.

python benchmarks/sigma.py                                # square ph, one seed, under an hour on two cores
python benchmarks/sigma.py --data mh --preset cpu         # the paper's task, three seeds
python benchmarks/sigma.py --resume                       # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import pandas as pd
from common import observations_of, policies_of, replace_rows, trained_actors
from measures import straightness
from options import PRESETS, MeasuredOptions, Options, check_single, parse, script, started, study
from plots import plot_sigma
from report import sigma_table, write_report
from robomimic import compare

SIGMAS = (1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0)


def preset(base: Options) -> MeasuredOptions:
    """The paper's seven, at one network evaluation per chunk."""
    sources, evaluation = replace(base.sources, sigma=SIGMAS), replace(base.evaluation, nfe=(1,))
    return study(MeasuredOptions, base, sources=sources, evaluation=evaluation)


@script("sigma.py")
def main(argv: list[str] | None) -> None:
    """Train a policy per source and sigma, play it, and measure its flow."""
    presets = {name: preset(base) for name, base in PRESETS.items()}
    options = parse(presets, argv, "sigma", __doc__)
    check_single(options, "nfe")
    with started(options, "sigma") as out:
        policies = policies_of(options, options.sources.methods())
        # Before the hours of training: what cannot be measured on is better known now.
        observations, source = observations_of(options, policies[0])
        rows, failures = compare(options, policies)
        flow = straightness(
            trained_actors(policies),
            observations,
            n_steps=options.held_out.steps,
            draws=options.held_out.draws,
        )
        curvatures = replace_rows(out / "curvature.jsonl", flow)
        top_k, task = options.evaluation.top_k, policies[0].task()
        chunk, nfe = options.sources.chunk[0], options.evaluation.nfe[0]
        plot_sigma(
            rows,
            curvatures,
            out / "sigma.png",
            top_k=top_k,
            title=f"{task.title}, H = {chunk}, NFE {nfe}, {options.evaluation.seeds} seed(s)",
        )
        table = sigma_table(rows, curvatures, top_k) + f"- Flow: on {source}.\n"
        write_report(out, table, table, pd.concat([rows, curvatures]), failures)


if __name__ == "__main__":
    sys.exit(main())
