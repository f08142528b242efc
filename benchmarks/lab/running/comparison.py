"""The jobs of a comparison of sources: train, measure and play its policies."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import pandas as pd

from lab.demonstrations.loading import title_of
from lab.io.errors import PartialFailure
from lab.io.leader import go_on_alone
from lab.methods.methods import Method
from lab.options.options import Evaluation, Options
from lab.reporting.rows import PLAYED, RESULTS, read_rows, write_rows
from lab.running.jobs import Job, Jobs
from lab.running.measuring import measure, row
from lab.running.policies import Cell, Policy, facts_of, play, train
from warmprior.evaluation import Episode
from warmprior.io.distributed import from_leader, rank, world_size
from warmprior.io.files import check_writable, write_atomic

EPISODES_PER_JOB = 5  # few keep all cores busy to the end, many load policies less often


def compare(
    options: Options,
    policies: Sequence[Policy],
    conditions: Callable[[Method], Sequence[Cell]] = lambda method: [Cell(0, 0)],
    films: Mapping[str, Callable[[], str | None]] | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """Train, measure and play what is missing; return the rows of the run, and its failures.

    Rows depend neither on the process that computes them nor on their order. `conditions` returns, for a
    method, delays and guidances to play it with; each gives a row. `films` are further calls by the name of
    the policy that they need; what they return is printed.

    Raises:
        ValueError: if the folder has rows of another run.
        PartialFailure: if no row could be computed.
    """
    evaluation, places = options.evaluation, {p.name: i for i, p in enumerate(policies)}
    for policy in {policy.place: policy for policy in policies}.values():
        # Before the training, so that a task that cannot be played costs no hours.
        from_leader(partial(policy.task().check_environment, **evaluation.environment))

    def order(row: Mapping[str, Any]) -> tuple[Any, ...]:
        delays = row.get("delay") or 0, row.get("guidance") or ""
        return places[row["policy"]], row["checkpoint"], -row["nfe"], -row["temperature"], *delays

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        rows.sort(key=order)
        write_rows(path, rows)

    path = options.run.folder / RESULTS
    rows = read_rows(path, PLAYED) if path.exists() else []
    if others := {row["policy"] for row in rows} - places.keys():
        raise ValueError(
            f"{path} has rows of {min(others)}: it was begun with other versions or data. Finish it "
            "with those, or choose another --out"
        )
    cells = {
        policy.name: [
            replace(condition, checkpoint=checkpoint, nfe=nfe, temperature=temperature)
            for checkpoint, nfe, temperature, condition in product(
                policy.training.checkpoint_iterations,
                policy.method.nfes(evaluation.nfe),
                policy.method.temperatures(evaluation.temperature),
                conditions(policy.method),
            )
        ]
        for policy in policies
    }
    played = {p.name: {c: (p.facts | c.facts()).items() for c in cells[p.name]} for p in policies}
    for number, stored in enumerate(rows, 1):
        facts_of_cells = played[stored["policy"]].values()
        matches = any(facts <= stored.items() for facts in facts_of_cells)
        matches &= stored.get("first_episode") == evaluation.starts(stored["seed"]).start
        if stored["episodes"] != evaluation.episodes or not matches:
            raise ValueError(
                f"{path}, line {number} is no row of this run: remove that line, and continue with --resume"
            )
    failures = begin(options, policies)
    with Jobs(options.run) as jobs:

        def explain(why_not: str | None) -> None:
            if why_not is not None:
                jobs.say(why_not)

        for policy in sorted(policies, key=lambda policy: policy.training.seed):
            facts = played[policy.name]
            missing = [c for c in cells[policy.name] if not any(facts[c] <= row.items() for row in rows)]
            if str(policy) not in failures:
                trained = submit(jobs, policy, missing, evaluation, add)
                if (film := (films or {}).get(policy.name)) is not None:
                    jobs.submit(f"film {policy}", film, after=trained, then=explain)
        failures |= jobs.wait()
    reasons = [f"{policy}: {reason}" for policy, reason in failures.items()]
    if not rows:
        raise PartialFailure("; ".join(reasons))
    return pd.DataFrame(rows), reasons


def train_all(options: Options, policies: Sequence[Policy]) -> None:
    """Train the policies that are not trained yet; raise PartialFailure if one fails."""
    failures = begin(options, policies)
    with Jobs(options.run) as jobs:
        for policy in policies:
            jobs.submit(str(policy), train, policy, training=True, status=policy.status)
        if failures := failures or jobs.wait():
            raise PartialFailure("; ".join(f"{name}: {why}" for name, why in failures.items()))


def begin(options: Options, policies: Sequence[Policy]) -> dict[str, str]:
    """Write `tasks.json`, and under torchrun train every policy in all processes; return failures by policy.

    Afterwards the first process goes on alone.
    """
    check_writable(options.run.policies)
    tasks = {policy.place: policy.task() for policy in policies}.values()
    text = json.dumps([facts_of(task) for task in tasks], indent=1) + "\n"
    if not rank():
        write_atomic(options.run.folder / "tasks.json", lambda path: path.write_text(text))
        for task in tasks if not all(policy.is_trained for policy in policies) else ():
            print(f"{title_of(task)}:\n{task.recording.text('--{}')}", flush=True)

    failures = {}
    for policy in policies if world_size() > 1 else ():
        try:
            train(policy)
        except (FloatingPointError, ValueError) as error:  # raised in all processes
            failures[str(policy)] = str(error)
            print(f"FAILED {policy}: {error}", flush=True)
    go_on_alone()
    return failures


def submit(
    jobs: Jobs,
    policy: Policy,
    cells: Sequence[Cell],
    evaluation: Evaluation,
    add: Callable[[dict[str, Any]], None],
) -> Job:
    """Submit the jobs that train, measure and play a policy; `add` gets the row of each complete cell.

    The first job, which is returned, trains it.
    """
    last, was_trained = policy.training.iterations, policy.is_trained
    episodes: dict[Cell, list[Episode]] = {cell: [] for cell in cells}
    # Of the last checkpoint, by temperature and NFE; earlier ones are only played.
    measures: dict[float, dict[int, dict[str, Any]]] = {}

    def trained(result: None) -> None:
        jobs.say(f"{'found' if was_trained else 'trained'} {policy}, {last} iterations")

    def measured(temperature: float, by_nfe: dict[int, dict[str, Any]]) -> None:
        measures[temperature] = by_nfe
        for cell in [c for c in cells if c.checkpoint == last and c.temperature == temperature]:
            played(cell, [])

    def played(cell: Cell, new_episodes: list[Episode]) -> None:
        episodes[cell] += new_episodes
        count, at_end = len(episodes[cell]), cell.checkpoint == last
        if count == evaluation.episodes and (cell.temperature in measures or not at_end):
            measured_at_end = measures[cell.temperature].get(cell.nfe, {}) if at_end else {}
            complete = row(policy, cell, episodes[cell], measured_at_end)
            add(complete)
            jobs.say(f"played {policy}, {cell}: {complete['successes']} of {count} episodes solved")

    group = str(policy)
    training: dict[str, Any] = {"training": True, "status": policy.status, "then": trained, "group": group}
    first = jobs.submit(f"train {policy}", train, policy, **training)
    after: dict[str, Any] = {"after": first, "group": group}
    for temperature in dict.fromkeys(cell.temperature for cell in cells if cell.checkpoint == last):
        job_name, then = f"measure {policy}, temperature {temperature}", partial(measured, temperature)
        jobs.submit(job_name, measure, policy, evaluation.nfe, temperature, then=then, **after)
    seeds = evaluation.starts(policy.training.seed)
    for cell, i in product(cells, range(0, len(seeds), EPISODES_PER_JOB)):
        job_options, job_seeds = {"then": partial(played, cell), **after}, seeds[i : i + EPISODES_PER_JOB]
        jobs.submit(f"play {policy}, {cell}", play, policy, cell, evaluation, job_seeds, **job_options)
    return first
