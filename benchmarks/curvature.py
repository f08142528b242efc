"""Curvature of the flow (the paper's Table 2 and Fig. 4): how straight each source makes it.

python benchmarks/curvature.py --run runs/square-ph-quick     # the policies of a run of robomimic.py
python benchmarks/curvature.py --data mh --preset cpu         # of these options, trained if they are not yet
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch

from warmprior import WarmPriorActor
from warmprior.diagnostics import SharedObservations, encoded_windows, flow_paths
from warmprior.diagnostics.flow import sees_history
from warmprior.experiments import (
    PRESETS,
    Comparison,
    HeldOutOptions,
    MeasuredRecipe,
    PolicyOptions,
    Results,
    Row,
    comparison_preset,
    curvature_table,
    finished_policies,
    grouped,
    observe,
    parse,
    record,
    source_labels,
    started,
    straightness,
    write_report,
)
from warmprior.experiments.labels import with_space
from warmprior.experiments.methods import Method
from warmprior.experiments.navigation_figures import plot_flow_paths
from warmprior.experiments.recipe import Flat
from warmprior.experiments.record import refuse_ignored
from warmprior.experiments.results import facts_of_machine
from warmprior.io.script import run_script

SHOWN = 40


@dataclass(frozen=True)
class CurvatureRecipe(MeasuredRecipe):
    """What to measure.

    Attributes:
        policies: of another run, instead of those of the options.
        coordinate: of the action, in flow_paths.png.
    """

    policies: Annotated[PolicyOptions, Flat] = field(default_factory=PolicyOptions)
    coordinate: int = 0

    @property
    def name(self) -> str:
        """Of the output folder."""
        run = self.policies.run
        return super().name if run is None else run.resolve().name

    def check(self) -> None:
        """Refuse what cannot work, or has no effect, before any work."""
        super().check()
        if self.policies.run is not None:
            base = PRESETS[self.run.preset]
            parts = ["data", "network", "training", "evaluation", "run"]
            # Priors of one's own are not what to compare, but what to import for it.
            parts += [] if all(":" in name for name in self.sources.prior) else ["sources"]
            told = "--run measures policies as they were trained"
            refuse_ignored(self, base, parts, told, but=["preset", "device"])
        elif not any(method.is_flow for method in self.sources.methods()):
            raise ValueError("none of these policies has a flow: compare gaussian, past or preview")


@dataclass
class Measured:
    """What is measured: the facts of the problem, policies, and observations with their name."""

    results: Results
    facts: dict[str, Any]
    actors: dict[Method, dict[int, WarmPriorActor]]
    observations: SharedObservations
    source: str


def own_run(recipe: CurvatureRecipe) -> Measured:
    """The policies of these options: those of earlier runs where they exist, or trained now."""
    comparison = Comparison(recipe, "curvature")
    # Before the training: what cannot be measured on is better known now.
    observations, source = comparison.observe(recipe.held_out)
    check_coordinate(recipe, observations)
    comparison.train()
    facts = comparison.results.meta["problems"][0]
    return Measured(comparison.results, facts, comparison.policies(), observations, source)


def finished_run(recipe: CurvatureRecipe, run: Path) -> Measured:
    """The last policies of a run of robomimic.py."""
    facts, actors = finished_policies(run, recipe.run.device)
    first = next(iter(next(iter(actors.values())).values()))
    observations, source = observe(
        recipe.held_out,
        facts,
        first.normalizer,
        chunk_length=first.prior.chunk_length,
        observation_steps=first.network.observation_steps,
        device=recipe.run.device,
    )
    check_coordinate(recipe, observations)
    identity = {"study": "curvature", "recipe": record(recipe)}
    meta = facts_of_machine() | {"problems": [facts]}
    results = Results(recipe.run.directory / "results.json", meta, identity)
    return Measured(results, facts, actors, observations, source)


def check_coordinate(recipe: CurvatureRecipe, observations: SharedObservations) -> None:
    width = observations.data["action"].shape[-1]
    if not 0 <= recipe.coordinate < width:
        raise ValueError(f"--coordinate must be in [0, {width}), got {recipe.coordinate}")


def draw(recipe: CurvatureRecipe, measured: Measured, rows: Sequence[Row]) -> None:
    observations, paths = measured.observations, {}
    few = observations.subset(torch.linspace(0, len(observations) - 1, SHOWN).long())
    label = source_labels(rows)
    for policy, group in grouped(rows, lambda row: row["policy"]).items():
        actor = next(iter(next(g for m, g in measured.actors.items() if str(m) == policy).values()))
        generator = torch.Generator(recipe.run.device).manual_seed(0)
        windows = few.windows(actor.prior, see_history=sees_history(actor))
        windows = encoded_windows(actor, windows)
        path = flow_paths(actor, windows, recipe.held_out.steps, generator=generator)
        paths[label(group[0])] = path[..., 0, recipe.coordinate].cpu()
    facts = measured.facts
    told = with_space(f"{facts['task']} {facts['style']}", facts)
    title = f"{told}: action coordinate {recipe.coordinate} "
    plot_flow_paths(
        paths,
        recipe.run.directory / "flow_paths.png",
        title=f"{title}along the flow,\n{measured.source}",
    )


def run(argv: Sequence[str] | None) -> None:
    held_out = HeldOutOptions(observations=2_000)
    presets = {n: CurvatureRecipe.of(p, held_out=held_out) for n, p in PRESETS.items()}
    recipe = parse(
        presets,
        argv,
        study="curvature",
        description=__doc__,
        preset=partial(comparison_preset, presets=presets),
        unused=("episodes", "nfe", "top_k", "play_on", "grid", "checkpoints"),
    )
    with started(recipe, "curvature") as out:
        folder = recipe.policies.run
        measured = own_run(recipe) if folder is None else finished_run(recipe, folder)
        rows = straightness(
            measured.actors,
            measured.observations,
            n_steps=recipe.held_out.steps,
            draws=recipe.held_out.draws,
            description="curvature",
        )
        measured.results.meta["observations"] = measured.source
        measured.results.add(*rows)
        draw(recipe, measured, rows)
        write_report(out, curvature_table(rows, measured.facts, source=measured.source))


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "curvature.py")


if __name__ == "__main__":
    sys.exit(main())
