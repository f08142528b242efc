"""The paper's Fig. 5: mode switching in a one-dimensional navigation toy.

python benchmarks/navigation1d.py                      # all policies, one seed, a few minutes
python benchmarks/navigation1d.py --seeds 5
python benchmarks/navigation1d.py --chunk 1            # a decision at every step
python benchmarks/navigation1d.py --preset wide        # the paper's network and iterations
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import torch

from warmprior.diagnostics import SharedObservations, executed_actions, flow_paths
from warmprior.experiments import (
    Comparison,
    Row,
    Store,
    mean_cell,
    navigation_problem,
    parse,
    plot_flow_paths,
    plot_navigation,
    select,
    source_labels,
    started,
    straightness,
    table,
    write_report,
)
from warmprior.experiments.navigation1d import (
    NAVIGATION_PRESETS,
    judge_navigation,
    play_navigation,
)
from warmprior.experiments.record import variation_notes
from warmprior.io.script import run_script

COLUMNS = {
    "switches at boundaries": "switch_rate",
    "rollouts on one side": "commit_rate",
    "collisions": "collision_rate",
    "route entropy (bit)": "route_entropy",
    "distance to data": "distance",
    "jump ratio": "jump_ratio",
    "kappa (H)": "kappa_executed",
    "kappa (H) / speed": "relative_executed",
    "collisions, history shifted": "shifted_collision_rate",
    "distance, history shifted": "shifted_distance",
}


def judge(comparison: Comparison) -> list[Row]:
    """What every policy does, at every number of network evaluations."""
    rollouts = comparison.recipe.evaluation.episodes
    rows = []
    for contestant in comparison.contestants:
        actor, seed = comparison.player(contestant).to("cpu"), contestant.training.seed
        for nfe in contestant.method.allowed_nfes(comparison.nfes):
            measures = judge_navigation(actor, seed, nfe=nfe, rollouts=rollouts)
            rows.append(Row(contestant.facts() | {"nfe": nfe}, measures))
    return rows


def curvatures(comparison: Comparison, observations: SharedObservations) -> list[Row]:
    """Of the flows, seed by seed: the source samples belong to the seed."""
    rows = []
    for seed in comparison.recipe.seeds:
        policies = {
            method: {seed: group[seed].to("cpu")} for method, group in comparison.policies().items()
        }
        rows += straightness(policies, observations, draws=4, seed=seed)
    return rows


def make_table(rows: Sequence[Row], notes: Sequence[str] = ()) -> str:
    """A line per policy and number of network evaluations; curvature is that of the first."""
    played = select(rows, "collision_rate")
    label, first = source_labels(played), max(row["nfe"] for row in played)
    curved = [
        Row({**row.facts, "nfe": first}, row.measures)
        for row in select(rows, "kappa_executed", mean="training")
    ]
    return table(
        [*played, *curved],
        lambda row: f"{label(row)}, NFE {row['nfe']}",
        None,
        {name: mean_cell(measure, ".3f") for name, measure in COLUMNS.items()},
        head="policy",
        notes=notes,
    )


def draw(comparison: Comparison, rows: Sequence[Row], observations: SharedObservations) -> None:
    out, recipe = comparison.directory, comparison.recipe
    seed, chunk = recipe.seeds[0], recipe.sources.chunk[0]
    told = f"H = {chunk}, {recipe.network.hidden_dim}-d network, {recipe.training.iterations} iterations"
    told += f", seed {seed}"
    label = source_labels(rows)
    panels, paths = {}, {}
    for contestant in comparison.contestants:
        if contestant.training.seed != seed:
            continue
        method, actor = contestant.method, comparison.player(contestant).to("cpu")
        nfe = max(method.allowed_nfes(comparison.nfes))
        (row,) = select(rows, "collision_rate", **contestant.facts(), nfe=nfe)
        text = [f"collides {row['collision_rate']:.0%}"]
        if row["switch_rate"] is not None:
            text[0] = f"switches sides at {row['switch_rate']:.1%} of boundaries, {text[0]}"
        if method.remembers:
            text.append(f"with its history shifted: collides {row['shifted_collision_rate']:.0%}")
        rollout = play_navigation(actor, seed, nfe=nfe)
        panels[label(row)] = (executed_actions(rollout)[0].squeeze(-1), text)
        if method.is_flow:
            # One window of a demonstration, above the first obstacle, from many source samples.
            window = observations.windows(actor.prior, see_history=method.sees_history)
            index = int((window["observation"][:60, 0, 0] + 0.45).abs().argmin())
            batch = window[index : index + 1].expand(48).contiguous()
            generator = torch.Generator().manual_seed(seed)
            paths[label(row)] = flow_paths(actor, batch, 100, generator=generator)[..., 0, 0]
    title = f"One-dimensional navigation: {told}"
    plot_navigation(panels, out / "navigation1d.png", chunk_length=chunk, title=title)
    title = f"Paths of the flow above the first obstacle, after a demonstrated history: {told}"
    plot_flow_paths(paths, out / "flow_paths.png", title=title)


def run(argv: Sequence[str] | None) -> None:
    recipe = parse(
        NAVIGATION_PRESETS,
        argv,
        study="navigation1d",
        description=__doc__,
        unused=("observation_steps", "top_k", "checkpoints"),
    )
    with started(recipe, "navigation1d") as out:
        problem = navigation_problem()
        comparison = Comparison(recipe, "navigation1d", stores=[Store.of(recipe, problem)])
        comparison.train()
        observations = SharedObservations(problem.data, recipe.sources.chunk[0])
        rows = [*judge(comparison), *curvatures(comparison, observations)]
        comparison.results.add(*rows)
        # Before the pictures, which are the lesser loss: the trainings took the time.
        write_report(out, make_table(rows, variation_notes(recipe)))
        draw(comparison, rows, observations)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "navigation1d.py", together=True)


if __name__ == "__main__":
    sys.exit(main())
