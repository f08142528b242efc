"""The card of a policy that others are to use: what it is, how it was trained and what was measured of it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from warmprior.diagnostics.statistics import success_posterior
from warmprior.envs.description import environment_name
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.files import read_json, read_lines
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.saved import policy_config

__all__ = ["PolicyResults", "model_card", "policy_results"]

TAGS = ("robotics", "imitation-learning", "flow-matching", "torchrl", "warmprior")


@dataclass(frozen=True)
class PolicyResults:
    """What the results of a run say of one of its policies.

    Attributes:
        training: task, data, prior, options, seed and iterations of the training.
        checkpoint: after how many iterations the policy was kept.
        data: facts of the demonstrations.
        versions: of the packages that trained and played it.
        rows: what was measured of it; none if this checkpoint was not played.
        others: the same, of policies that differ in their training seed alone.
        grid: of the integration, in all rows.

    See Also:
        - :func:`~warmprior.training.policy_results`: reads them.
        - :func:`~warmprior.training.model_card`: writes them.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> played = {"nfe": 1, "episodes": 10, "successes": 9, "success_rate": 0.9}
        >>> results = PolicyResults(
        ...     training={"task": "lift", "data": "ph", "seed": 0, "iterations": 5000}, checkpoint=5000,
        ...     data={}, versions={}, rows=(played,))
        >>> card = model_card(WarmPriorActor(VelocityMLP(7, 19, 8), PastPrior(8)), results)
        >>> [line for line in card.splitlines() if "90.0%" in line]
        ['| 1 | 10 | 9 | 90.0% | 58.7% to 97.7% | - |']
    """

    training: Mapping[str, Any]
    checkpoint: int
    data: Mapping[str, Any]
    versions: Mapping[str, str]
    rows: tuple[Mapping[str, Any], ...]
    others: tuple[Mapping[str, Any], ...] = ()
    grid: str = "uniform"


TRAINING = ("task", "data", "actions", "obs", "prior", "options", "sigma", "chunk", "iterations")
"""What rows of the same training, but for its seed, have in common."""


def policy_results(run: str | Path, policy: str | Path) -> PolicyResults:
    """What the results of a run say of one of its policies.

    Args:
        run: folder of a benchmark, with its ``results.jsonl``.
        policy: folder of the policy, such as ``.../policies/square-ph-past-seed0-.../policy_005000``.

    Raises:
        FileNotFoundError: if there are no results.
        ValueError: if they are damaged, or of other policies.

    See Also:
        :func:`~warmprior.training.model_card`: writes them for the hub.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> row = {"task": "lift", "data": "ph", "prior": "past", "seed": 0, "iterations": 20,
        ...        "policy": "lift-ph-past", "checkpoint": 20, "nfe": 1, "success_rate": 0.5}
        >>> with TemporaryDirectory() as folder:
        ...     run, policies = Path(folder) / "run", Path(folder) / "policies"
        ...     run.mkdir()
        ...     _ = (run / "results.jsonl").write_text(json.dumps(row))
        ...     found = policy_results(run, policies / "lift-ph-past" / "policy_000020")
        >>> found.checkpoint, found.rows[0]["success_rate"]
        (20, 0.5)
    """
    path, folder = Path(run) / "results.jsonl", Path(policy).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"{run} has no results.jsonl: name the folder of a finished run")
    rows = [row for row in read_lines(path) if "success_rate" in row]
    mine = [row for row in rows if row.get("policy") == folder.parent.name]
    if not mine:
        raise ValueError(
            f"{path} has no row of a policy in {folder.parent.name}: name the run that trained it, and the "
            "policy where that run keeps it"
        )
    training = {name: mine[0][name] for name in (*TRAINING, "seed") if name in mine[0]}
    number = folder.name.rpartition("_")[2]
    checkpoint = int(number) if number.isdecimal() else 0
    if policy_path(folder.parent, checkpoint) != folder:
        raise ValueError(
            f"{folder} is none of the policies that its training kept: name it like "
            f"{policy_path(folder.parent, training['iterations'])}"
        )
    alike = [
        row
        for row in rows
        if row["checkpoint"] == checkpoint and all(row.get(k) == mine[0].get(k) for k in TRAINING)
    ]
    described = {name: Path(run) / f"{name}.json" for name in ("options", "tasks")}
    known = {name: read_json(file) for name, file in described.items() if file.is_file()}
    start, tasks = known.get("options", {}), known.get("tasks", [])
    same = (t for t in tasks if (t["task"], t["data"]) == (training["task"], training["data"]))
    return PolicyResults(
        training=training,
        checkpoint=checkpoint,
        data={k: v for k, v in next(same, {}).items() if k not in ("task", "data")},
        versions=start.get("versions", {}),
        rows=tuple(row for row in alike if row["seed"] == training["seed"]),
        others=tuple(row for row in alike if row["seed"] != training["seed"]),
        grid=start.get("options", {}).get("evaluation", {}).get("grid", "uniform"),
    )


def model_card(
    actor: WarmPriorActor,
    results: PolicyResults | None = None,
    *,
    repository: str = "user/name",
    licence: str | None = None,
) -> str:
    """Write the card of a policy, ``README.md`` of its repository at the hub.

    What is not known is said.

    Args:
        actor: the policy.
        results: what a run says of it, see :func:`policy_results`.

    Keyword Args:
        repository: where the policy will lie.
        licence: the hub's name of its licence, such as ``"mit"``.

    Raises:
        TypeError: if the policy cannot be saved, see :func:`~warmprior.training.check_saveable`.
        ImportError: if there are results, and scipy is not installed.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> card = model_card(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), licence="mit")
        >>> print(card.partition("tags:")[0])
        ---
        library_name: warmprior
        pipeline_tag: robotics
        license: "mit"
    """
    names = results.training if results else {}
    label = ", ".join(
        filter(None, (names.get("prior", actor.prior.name), names.get("options", "")))
    )
    task = results.training["task"] if results else environment_name(actor)
    front = ["library_name: warmprior", "pipeline_tag: robotics"]
    front += [] if licence is None else [f"license: {json.dumps(licence)}"]
    front += ["tags:", *(f"- {tag}" for tag in TAGS)]
    parts = [
        "\n".join(["---", *front, "---"]),
        f"# {label}{f' on {task}' if task else ''}",
        f"A policy of the library warmprior: {_source_words(actor)}",
        _table(("", ""), _facts(actor, results)),
        "## Success",
        _success(results),
        "## Use",
        _use(actor, repository),
        "## What is not known",
        "\n".join(f"- {line}" for line in _unknown(actor, results, licence)),
    ]
    return "\n\n".join(parts) + "\n"


def _source_words(actor: WarmPriorActor) -> str:
    if actor.ode.max_nfe == 1:
        return "it predicts each chunk of actions in one step."
    return (
        "a flow carries a sample of the source named below to each chunk of actions, after "
        "[WarmPrior](https://sinnnj.github.io/WarmPrior/)."
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _code(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return f"`{text.replace('|', '/').replace('`', '')}`"


def _facts(actor: WarmPriorActor, results: PolicyResults | None) -> list[tuple[str, str]]:
    """What it is, in pairs."""
    config, prior = policy_config(actor), actor.prior
    network = dict(config["network"])
    count = sum(p.numel() for p in actor.network.parameters())
    sampler = {k: v for k, v in config["actor"].items() if not k.endswith("_key")}
    found = [
        ("source", f"{_code(prior.name)}: {_code(repr(prior))}"),
        ("sigma, in units of the normaliser", f"{float(prior.sigma):g}"),
        ("chunk length", str(prior.chunk_length)),
        ("network", f"{_code(network.pop('name'))}, {count:,} parameters: {_code(network)}"),
        ("sampler", _code(sampler)),
        ("normaliser", "kept" if actor.normalizer is not None else "none"),
    ]
    name, environment = environment_name(actor), actor.environment or {}
    if name is not None:
        words = [f"{name} of robosuite", f"style {environment['robosuite']['style']}"]
        words += [f"{environment['actions']} actions"] if "actions" in environment else []
        if "images" in environment:
            seen = environment["images"]
            words.append(f"cameras {', '.join(seen['cameras'])} of {seen['size']} pixels")
        found.insert(0, ("environment", ", ".join(words)))
    elif actor.environment is not None:
        found.insert(0, ("environment", _code(actor.environment)))
    mine, versions = version("warmprior"), ""
    if results is not None:
        training, data = results.training, results.data
        found.insert(0, ("task", f"{training['task']}, data {training['data']}"))
        words = [f"{k} {_code(v)}" for k, v in data.items()]
        found.append(("demonstrations", "; ".join(words) or "not known"))
        iterations = f"{results.checkpoint:,} of {training['iterations']:,} iterations"
        found.append(("training", f"{iterations}, seed {training['seed']}"))
        versions = ", ".join(f"{name} {number}" for name, number in results.versions.items())
        versions = f"trained and played with {versions}; "
    found.append(("versions", f"{versions}uploaded by warmprior {mine}"))
    return found


def _success(results: PolicyResults | None) -> str:
    if results is None:
        return "Not measured, or not known when this card was written."
    if not results.rows:
        return f"The policy of iteration {results.checkpoint:,} was not played."
    conditions = [n for n in ("delay", "guidance") if any(n in r for r in results.rows)]
    shown, last = [], EVALUATION_SEED - 1
    for row in results.rows:
        low, high = success_posterior(row["successes"], row["episodes"]).interval(0.95)
        last = max(last, EVALUATION_SEED + row["episodes"] - 1)
        cells = [row[name] for name in ("nfe", *conditions, "episodes", "successes")]
        rates = [f"{100 * row['success_rate']:.1f}%", f"{100 * low:.1f}% to {100 * high:.1f}%"]
        others = [
            f"{100 * other['success_rate']:.1f}% (seed {other['seed']})"
            for other in results.others
            if all(other.get(name) == row.get(name) for name in ("nfe", *conditions))
        ]
        shown.append([*map(str, cells), *rates, ", ".join(others) or "-"])
    head = ("NFE", *conditions, "episodes", "solved", "success", "95% of the posterior")
    words = [
        f"NFE is the number of network evaluations per chunk. The policy is of training seed "
        f"{results.training['seed']}; episodes begin from the simulator's seeds {EVALUATION_SEED} to {last}.",
        "The interval is of a Beta posterior under a uniform prior: it tells how few the episodes are, "
        "and not how training seeds differ.",
    ]
    if results.grid != "uniform":
        words.append(f"Integrated on the grid {_code(results.grid)}.")
    return f"{_table((*head, 'other training seeds'), shown)}\n\n{' '.join(words)}"


def _use(actor: WarmPriorActor, repository: str) -> str:
    own = [
        f"{type(part).__name__} of {type(part).__module__}"
        for part in (actor.prior, actor.network)
        if not type(part).__module__.startswith("warmprior.")
    ]
    words = f"It needs classes of its author: import {' and '.join(own)} first.\n\n" if own else ""
    lines = ["from warmprior.training import load_policy"]
    play = f"actor = load_policy({json.dumps(repository)})"
    if environment_name(actor) is None:
        lines += ["", play]
        command = f"python -m warmprior info {repository}"
    else:
        lines += ["from warmprior.envs import environment_of", "", play]
        lines += ["environment_of(actor).rollout(100, actor)"]
        command = f"python -m warmprior evaluate {repository} --episodes 50"
    code = "\n".join(lines)
    return f"{words}```python\n{code}\n```\n\n```console\n{command}\n```"


def _unknown(
    actor: WarmPriorActor, results: PolicyResults | None, licence: str | None
) -> list[str]:
    """What a reader might look for in vain."""
    found = []
    if actor.environment is None:
        found.append("The environment: the policy keeps no description of it.")
    if results is None:
        found.append("Demonstrations, iterations, seed and versions of the training.")
        found.append("Any success rate.")
    else:
        if not results.rows:
            found.append("Any success rate of this checkpoint.")
        if not results.others:
            found.append("How far success differs between training seeds: one was played.")
        if results.data.get("source") == "scripted":
            found.append(
                "Success after human demonstrations: a scripted expert recorded these, and the numbers must "
                "not be set beside published ones."
            )
    if licence is None:
        found.append("A licence: ask whoever uploaded it.")
    found.append("Behaviour on a robot, or in any environment but the one named above.")
    return found
