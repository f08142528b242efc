"""The paper's Fig. 7: reinforcement learning in the source space of a frozen policy.

python benchmarks/prior_space_rl.py --preset unit            # the navigation toy, under two minutes
python benchmarks/prior_space_rl.py                          # lift from a weak policy, half an hour
python benchmarks/prior_space_rl.py --preset paper --task square --run runs/square-ph-paper
python benchmarks/prior_space_rl.py --resume                 # after an interruption

A frozen policy per prior and seed comes from --run (a finished run of robomimic.py) or is trained first.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from warmprior import WarmPriorActor
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments import (
    Comparison,
    Results,
    Row,
    Store,
    finished_policies,
    mean_cell,
    navigation_problem,
    parse,
    plot_reinforcement,
    plot_success,
    record,
    select,
    started,
    table,
    write_report,
)
from warmprior.experiments.figures import agent_label
from warmprior.experiments.labels import with_actions
from warmprior.experiments.prior_space import (
    PRIOR_SPACE_PRESETS,
    PriorSpaceRecipe,
    agent_environment,
    prior_space_preset,
)
from warmprior.experiments.results import facts_of_machine, grouped
from warmprior.io.files import read_json, write_atomic
from warmprior.io.script import run_script
from warmprior.rl import PriorSpaceTraining
from warmprior.training.threads import torch_threads

Frozen = dict[str, dict[int, WarmPriorActor]]
"""Policies by prior name and training seed."""


def frozen_policies(recipe: PriorSpaceRecipe, out: Path) -> tuple[dict[str, Any], Frozen]:
    """The facts of the problem, and the policies: of --run, or trained now where they are not yet."""
    run, device = recipe.policies.run, recipe.run.device
    if run is not None:
        facts, actors = finished_policies(run, device)
        if recipe.data.task not in ((), (facts["task"],)):
            raise ValueError(f"--run {run} is of {facts['task']}, not of {recipe.data.task[0]}")
        missing = [p.name for p in recipe.sources.priors() if p.name not in actors]
        if missing:
            raise ValueError(
                f"--run {run} has policies of {', '.join(actors)}, but none of {', '.join(missing)}"
            )
        return facts, actors
    stores = None
    if recipe.is_toy:
        policies, logs = out.parent / "policies", out / "logs"
        stores = [Store(navigation_problem(), recipe.network, policies, logs, recipe.run)]
    comparison = Comparison(recipe, "frozen policies", stores=stores, directory=out / "frozen")
    comparison.train()
    frozen: Frozen = {}
    for c in comparison.contestants:
        frozen.setdefault(c.prior.name, {})[c.training.seed] = c.policy()
    return comparison.results.meta["problems"][0], frozen


def kept_policies(recipe: PriorSpaceRecipe, out: Path) -> tuple[dict[str, Any], Frozen]:
    """Copies of the frozen policies that belong to the agents.

    To continue, they must find the very policies they began with, whatever has become of those, or would
    be trained by now.
    """
    names = dict.fromkeys(prior.name for prior in recipe.sources.priors())
    folders = {(n, s): out / "policies" / f"{n}-seed{s}" for n in names for s in recipe.seeds}
    facts = out / "policies" / "problem.json"
    if not (recipe.run.resume and facts.exists()):
        problem, frozen = frozen_policies(recipe, out)
        for (name, seed), folder in folders.items():
            group = frozen[name]
            if seed not in group:
                print(f"--run has {len(group)} seeds of {name}: agent {seed} shares a policy")
            of_seeds = list(group.values())
            group.get(seed, of_seeds[seed % len(of_seeds)]).save_pretrained(folder)
        text = json.dumps(problem) + "\n"
        write_atomic(facts, lambda path: path.write_text(text))
    loaded: Frozen = {name: {} for name in names}
    for (name, seed), folder in folders.items():
        loaded[name][seed] = WarmPriorActor.from_pretrained(folder, device=recipe.run.device)
    return read_json(facts), loaded


def make_table(rows: Sequence[Row]) -> str:
    """Success before and after, mean and standard deviation over seeds."""
    percent = mean_cell("success_rate", ".1f", 100)

    def last(kind: str) -> Callable[[list[Row]], str | None]:
        def cell(rows: list[Row]) -> str | None:
            ended = grouped(select(rows, evaluation=kind), lambda row: row["seed"])
            return percent([group[-1] for group in ended.values()])

        return cell

    seeds = {
        agent: len(grouped(g, lambda r: r["seed"])) for agent, g in grouped(rows, agent_of).items()
    }
    return table(
        rows,
        lambda row: agent_label(row, seeds[agent_of(row)]),
        None,
        {
            "delta": lambda rows: f"{rows[0]['delta']:g}",
            "control steps": lambda rows: str(max(row["environment_steps"] for row in rows)),
            "frozen policy (%)": last("base"),
            "greedy agent (%)": last("greedy"),
            "stochastic agent (%)": last("stochastic"),
        },
        head="agent",
    )


def agent_of(row: Row) -> tuple[str, str]:
    return row["algorithm"], row["prior"]


def draw(rows: Sequence[Row], out: Path, title: str, warmup: int) -> None:
    """The curves, and the posteriors of the greedy agents."""
    plot_reinforcement(rows, out / "curves.png", title=title, warmup_steps=warmup)
    ends = grouped(select(rows, evaluation="greedy"), lambda row: (*agent_of(row), row["seed"]))
    plot_success(
        [group[-1] for group in ends.values()],
        out / "success.png",
        title=f"{title}: greedy agents",
        group=lambda row: row["algorithm"].upper(),
    )


def run(argv: Sequence[str] | None) -> None:
    recipe = parse(
        PRIOR_SPACE_PRESETS,
        argv,
        study="rl",
        description=__doc__,
        preset=prior_space_preset,
        unused=("top_k", "checkpoints", "grid"),
    )
    with started(recipe, "rl") as out:
        problem, frozen = kept_policies(recipe, out)
        meta = facts_of_machine(torch_threads=recipe.agents.threads) | {"problems": [problem]}
        identity = {"study": "rl", "recipe": record(recipe)}
        results = Results(out / "results.json", meta, identity, resume=recipe.run.resume)
        results.save()  # from now on there is something to continue
        diverged: dict[tuple[str, str, int], str] = {}
        names = dict.fromkeys(prior.name for prior in recipe.sources.priors())
        for seed, algorithm, name in product(recipe.seeds, recipe.agents.algorithm, names):
            agent, actor = f"{algorithm} {name}, seed {seed}", frozen[name][seed]
            config = recipe.agent(actor.prior, algorithm, seed)
            training = PriorSpaceTraining(
                actor,
                agent_environment(recipe, actor),
                config,
                out / f"{algorithm}-{name}-seed{seed}",
                evaluation_seed=EVALUATION_SEED,
                description=agent,
            )
            try:
                with torch_threads(recipe.agents.threads):
                    training.run()
            except FloatingPointError as error:  # no reason to keep the other agents from learning
                diverged[algorithm, name, seed] = f"{agent}: {error}"
            facts = {
                "task": problem["task"],
                "data": problem["style"],
                **{name: problem[name] for name in ("actions",) if name in problem},
                "algorithm": algorithm,
                "prior": name,
                "sigma": actor.prior.sigma,
                "chunk": actor.prior.chunk_length,
                "nfe": config.nfe,
                "delta": training.decoder.delta,
                "seed": seed,
            }
            results.add(*(evaluated(facts, point) for point in training.curve))
        complete = [row for row in results.rows if (*agent_of(row), row["seed"]) not in diverged]
        if complete:
            told = with_actions(f"{problem['task']} {problem['style']}", problem.get("actions"))
            title = f"{told}, NFE {recipe.evaluation.nfe[0]}"
            draw(complete, out, title, recipe.rl.warmup_steps)
            write_report(out, make_table(complete))
        if diverged:
            raise FloatingPointError("; ".join(diverged.values()))


def evaluated(facts: dict[str, Any], point: dict[str, Any]) -> Row:
    """The row of one evaluation of an agent."""
    told = {name: point[name] for name in ("environment_steps", "evaluation")}
    counted = ("episodes", "successes", "success_rate")
    return Row(facts | told, {name: point[name] for name in counted})


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "prior_space_rl.py")


if __name__ == "__main__":
    sys.exit(main())
