"""The paper's sigma ablation: success, curvature and the branching bound against the residual noise.

python benchmarks/sigma.py                                # square ph, one seed, under an hour on two cores
python benchmarks/sigma.py --data mh --preset cpu         # the paper's task, three seeds
python benchmarks/sigma.py --resume                       # after an interruption

The policies of robomimic.py with the same options are used, not trained again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from warmprior.experiments import (
    PRESETS,
    Comparison,
    MeasuredRecipe,
    Recipe,
    comparison_preset,
    mean_cell,
    parse,
    plot_sigma,
    prior_label,
    select,
    started,
    straightness,
    success_cell,
    table,
    write_report,
)
from warmprior.experiments.labels import source_of
from warmprior.experiments.straightness import pooled
from warmprior.experiments.tables import Cell
from warmprior.io.script import run_script

SIGMAS = (1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0)


def study(preset: Recipe) -> MeasuredRecipe:
    """The paper's seven, at one network evaluation per chunk."""
    recipe = MeasuredRecipe.of(preset)
    sources, evaluation = recipe.sources, recipe.evaluation
    return replace(
        recipe, sources=replace(sources, sigma=SIGMAS), evaluation=replace(evaluation, nfe=(1,))
    )


def run(argv: Sequence[str] | None) -> None:
    presets = {name: study(preset) for name, preset in PRESETS.items()}
    seen = partial(comparison_preset, presets=presets)
    recipe = parse(presets, argv, study="sigma", description=__doc__, preset=seen)
    recipe.check_single(nfe=True)
    recipe.sources.check_sigma()
    with started(recipe, "sigma") as out:
        comparison = Comparison(recipe, "sigma")
        # Before the hours of training: what cannot be measured on is better known now.
        observations, source = comparison.observe(recipe.held_out)
        results = comparison.run()
        results.meta["observations"] = source
        steps, draws = recipe.held_out.steps, recipe.held_out.draws
        policies = comparison.policies()
        results.add(
            *straightness(
                policies, observations, n_steps=steps, draws=draws, description="curvature"
            )
        )
        top_k = recipe.evaluation.top_k
        trained, deployed = (
            pooled(select(results.rows, "ratio_executed", mean=mean))
            for mean in ("training", "deployed")
        )
        curvature, bound = mean_cell("ratio_executed", ".3f"), mean_cell("bound_executed", ".2f")
        success = success_cell(top_k)

        def at(mean: str, cell: Cell) -> Cell:
            # A policy without a mean is the same at both.
            return lambda rows: cell(select(rows, mean=mean) or select(rows, mean="training"))

        text = table(
            [*comparison.rows, *trained, *deployed],
            lambda row: f"{prior_label(*source_of(row))}, sigma {row['sigma']:g}",
            None,
            {
                "success (%)": lambda rows: success(select(rows, "success_rate")),
                "curvature, training mean": at("training", curvature),
                "deployed mean": at("deployed", curvature),
                "per squared mean velocity": at("training", mean_cell("ratio_relative", ".3f")),
                "bound, training mean": at("training", bound),
                "bound, deployed mean": at("deployed", bound),
            },
            head="source",
            notes=[
                "- Curvature (relative to the first source) and bound (in squared normalised action units) "
                "are those of the executed positions. -: the policy predicts no motion."
            ],
        )
        problem = comparison.stores[0].problem
        chunk, nfe = recipe.sources.chunk[0], recipe.evaluation.nfe[0]
        plot_sigma(
            results.rows,
            out / "sigma.png",
            top_k=top_k,
            title=f"{problem.name}, H = {chunk}, NFE {nfe}, {recipe.evaluation.seeds} seed(s)",
            paper=(problem.task, problem.style, chunk, nfe) == ("square", "mh", 8, 1)
            and not problem.images,
        )
        write_report(out, text, comparison.failures)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "sigma.py")


if __name__ == "__main__":
    sys.exit(main())
