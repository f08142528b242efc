"""The paper's Fig. 7: reinforcement learning in the source space of a frozen policy.

python benchmarks/prior_space_rl.py --preset unit            # the navigation toy, about two minutes
python benchmarks/prior_space_rl.py                          # lift from a weak policy, half an hour
python benchmarks/prior_space_rl.py --preset paper --task square --run runs/square-ph-paper
python benchmarks/prior_space_rl.py --resume                 # after an interruption

A frozen policy per source and seed comes from --run (a finished run of robomimic.py) or is trained first.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from warmprior.experiments.labels import source_of, space_of, with_space
from warmprior.experiments.methods import Method
from warmprior.experiments.prior_space import (
    PRIOR_SPACE_PRESETS,
    PriorSpaceRecipe,
    agent_environment,
    agent_policy,
    prior_space_preset,
)
from warmprior.experiments.results import facts_of_machine, grouped
from warmprior.io.files import digest_of, read_json, write_atomic
from warmprior.io.script import run_script
from warmprior.modules.registry import options_of
from warmprior.rl import PriorSpaceTraining, has_anchor
from warmprior.training import load_policy, save_policy
from warmprior.training.threads import torch_threads

Source = tuple[str, str]
"""Name and options of a method: agents of several options of one are compared like those of several."""

Frozen = dict[Source, dict[int, WarmPriorActor]]
"""Policies by source and training seed."""


def source_of_method(method: Method) -> Source:
    return method.name, method.options


def told(source: Source) -> str:
    """A source in words, as ``--prior`` takes it."""
    return ",".join(filter(None, source))


def slug(source: Source) -> str:
    """A source in the names of folders: two sources never share one, nor a name that is too long."""
    name, options = source
    if not options:
        return name
    # Numbers and the like stay readable; texts and lists could become the same as others.
    plain = re.fullmatch(r"[\w.=+,-]{1,60}", options, re.ASCII) is not None
    short = re.sub(r"[^\w.=+-]+", "-", options, flags=re.ASCII)[:60]
    return f"{name}-{short}" if plain else f"{name}-{short}-{digest_of(options)[:8]}"


def is_asked(text: str, own: Method) -> bool:
    """Whether a method is what a ``--prior`` names; what is not said there is as the method has it."""
    sigma = None if "sigma" in options_of(text) else own.sigma
    return Method.parse(text, own.chunk_length, sigma=sigma) == own


def frozen_policies(recipe: PriorSpaceRecipe, out: Path) -> tuple[dict[str, Any], Frozen]:
    """The facts of the problem, and the policies: of --run, or trained now where they are not yet."""
    run, device, methods = recipe.policies.run, recipe.run.device, recipe.sources.methods()
    if run is not None:
        facts, actors = finished_policies(run, device)
        if recipe.data.task not in ((), (facts["task"],)):
            raise ValueError(f"--run {run} is of {facts['task']}, not of {recipe.data.task[0]}")
        taken: Frozen = {}
        missing = []
        for text, source in zip(
            dict.fromkeys(recipe.sources.prior), map(source_of_method, methods), strict=True
        ):
            found = [group for method, group in actors.items() if is_asked(text, method)]
            if found:
                taken[source] = found[0]
            else:
                missing.append(text)
        if missing:
            have, lack = "; ".join(told(source_of_method(m)) for m in actors), "; ".join(missing)
            raise ValueError(f"--run {run} has policies of {have}, but none of {lack}")
        return facts, taken
    stores = None
    if recipe.is_toy:
        policies, logs = out.parent / "policies", out / "logs"
        stores = [Store(navigation_problem(), recipe.network, policies, logs, recipe.run)]
    comparison = Comparison(recipe, "frozen policies", stores=stores, directory=out / "frozen")
    comparison.train()
    (store,) = comparison.stores
    frozen = {
        source_of_method(method): {
            seed: store.policy(method, replace(recipe.training, seed=seed)) for seed in recipe.seeds
        }
        for method in methods
    }
    return comparison.results.meta["problems"][0], frozen


def kept_policies(recipe: PriorSpaceRecipe, out: Path) -> tuple[dict[str, Any], Frozen]:
    """Copies of the frozen policies that belong to the agents.

    To continue, they must find the very policies they began with, whatever has become of those, or would
    be trained by now.
    """
    sources = dict.fromkeys(map(source_of_method, recipe.sources.methods()))
    folders = {
        (source, seed): out / "policies" / f"{slug(source)}-seed{seed}"
        for source, seed in product(sources, recipe.seeds)
    }
    facts = out / "policies" / "problem.json"
    if not (recipe.run.resume and facts.exists()):
        problem, frozen = frozen_policies(recipe, out)
        for (source, seed), folder in folders.items():
            group = frozen[source]
            if seed not in group:
                print(
                    f"--run has {len(group)} seeds of {told(source)}: agent {seed} shares a policy"
                )
            of_seeds = list(group.values())
            save_policy(group.get(seed, of_seeds[seed % len(of_seeds)]), folder)
        text = json.dumps(problem) + "\n"
        write_atomic(facts, lambda path: path.write_text(text))
    loaded: Frozen = {}
    for (source, seed), folder in folders.items():
        actor = load_policy(folder, device=recipe.run.device)
        loaded.setdefault(source, {})[seed] = actor
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


def agent_of(row: Row) -> tuple[str, Source]:
    return row["algorithm"], source_of(row)


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
        # Rows of earlier versions have no options, and are to be replaced by those that have.
        results.rows = [replace(row, facts={"options": "", **row.facts}) for row in results.rows]
        results.save()  # from now on there is something to continue
        diverged: dict[tuple[str, Source, int], str] = {}
        for seed, algorithm, source in product(recipe.seeds, recipe.agents.algorithm, frozen):
            agent, actor = f"{algorithm} {told(source)}, seed {seed}", frozen[source][seed]
            config = recipe.agent(has_anchor(actor), algorithm, seed)
            training = PriorSpaceTraining(
                agent_policy(actor),
                agent_environment(recipe, actor),
                config,
                out / f"{algorithm}-{slug(source)}-seed{seed}",
                evaluation_seed=EVALUATION_SEED,
                description=agent,
                collectors=recipe.agents.collectors,
                ray_address=recipe.run.ray_address,
            )
            try:
                with torch_threads(recipe.agents.threads):
                    training.run()
            except FloatingPointError as error:  # no reason to keep the other agents from learning
                diverged[algorithm, source, seed] = f"{agent}: {error}"
            facts = {
                "task": problem["task"],
                "data": problem["style"],
                **space_of(problem),
                "algorithm": algorithm,
                "prior": source[0],
                "options": source[1],
                "sigma": actor.prior.sigma,
                "chunk": actor.prior.chunk_length,
                "nfe": config.nfe,
                "delta": training.decoder.delta,
                "seed": seed,
            }
            results.add(*(evaluated(facts, point) for point in training.curve))
        complete = [row for row in results.rows if (*agent_of(row), row["seed"]) not in diverged]
        if complete:
            name = with_space(f"{problem['task']} {problem['style']}", problem)
            title = f"{name}, NFE {recipe.evaluation.nfe[0]}"
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
