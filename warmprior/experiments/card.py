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
from warmprior.experiments.labels import prior_label
from warmprior.experiments.results import Row, read_results
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.behaviour_cloning import policy_path
from warmprior.training.saved import policy_config

__all__ = ["PolicyResults", "model_card", "policy_results"]

TAGS = ("robotics", "imitation-learning", "flow-matching", "torchrl", "warmprior")


@dataclass(frozen=True)
class PolicyResults:
    """What the results of a run tell of one of its policies.

    Attributes:
        training: task, data, seed and the iterations of the training.
        checkpoint: after how many of them the policy was kept.
        data: facts of the demonstrations.
        versions: of the packages that trained and played it.
        rows: what was measured of it; none if this checkpoint was not played.
        others: the same, of policies that differ in their training seed alone.
        grid: of the integration, in all rows.

    See Also:
        - :func:`~warmprior.experiments.policy_results`: reads them.
        - :func:`~warmprior.experiments.model_card`: writes them.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> from warmprior.experiments.results import played
        >>> results = PolicyResults(
        ...     training={"task": "lift", "data": "ph", "seed": 0, "iterations": 5000}, checkpoint=5000,
        ...     data={}, versions={}, rows=(played({"nfe": 1}, [True] * 9 + [False]),))
        >>> card = model_card(WarmPriorActor(VelocityMLP(7, 19, 8), PastPrior(8)), results)
        >>> [line for line in card.splitlines() if "90.0%" in line]
        ['| 1 | 10 | 9 | 90.0% | 58.7% to 97.7% | - |']
    """

    training: Mapping[str, Any]
    checkpoint: int
    data: Mapping[str, Any]
    versions: Mapping[str, str]
    rows: tuple[Row, ...]
    others: tuple[Row, ...] = ()
    grid: str = "uniform"


def policy_results(run: str | Path, policy: str | Path) -> PolicyResults:
    """What the results of a run tell of one of its policies.

    Args:
        run: folder of a comparison, with its ``results.json``.
        policy: folder of the policy, such as ``.../policies/square-ph-past-seed0-.../policy_005000``.

    Raises:
        FileNotFoundError: if there are no results.
        ValueError: if they are damaged, or of other policies.

    See Also:
        :func:`~warmprior.experiments.model_card`: writes them for the hub.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import Results
        >>> from warmprior.experiments.results import played
        >>> facts = {"task": "lift", "data": "ph", "seed": 0, "iterations": 20}
        >>> policy = facts | {"prior": "past", "folder": "lift-ph-past"}
        >>> meta = {"policies": [policy], "problems": [{"task": "lift", "style": "ph", "steps": 900}]}
        >>> with TemporaryDirectory() as folder:
        ...     run, policies = Path(folder) / "run", Path(folder) / "policies"
        ...     row = played(facts | {"prior": "past", "checkpoint": 20, "nfe": 1}, [True, False])
        ...     Results(run / "results.json", meta, {"recipe": {}}).add(row)
        ...     found = policy_results(run, policies / "lift-ph-past" / "policy_000020")
        >>> found.checkpoint, found.data, found.rows[0]["success_rate"]
        (20, {'steps': 900}, 0.5)
    """
    path, folder = Path(run) / "results.json", Path(policy).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"{run} has no results.json; name the folder of a finished run")
    meta, rows = read_results(path)
    entries = [e for e in meta.get("policies", ()) if e.get("folder") == folder.parent.name]
    if not entries:
        raise ValueError(
            f"{path} tells nothing of a policy in {folder.parent.name}: name the run that trained it, and "
            "the policy where that run keeps it"
        )
    entry = entries[0]
    facts = {k: v for k, v in entry.items() if k not in ("method", "folder")}
    number = folder.name.rpartition("_")[2]
    checkpoint = int(number) if number.isdecimal() else 0
    if policy_path(folder.parent, checkpoint) != folder:
        raise ValueError(
            f"{folder} is none of the policies that its training kept: name it like "
            f"{policy_path(folder.parent, entry['iterations'])}"
        )
    asked = entry["task"], entry["data"]
    problem: Mapping[str, Any] = next(
        (p for p in meta["problems"] if (p["task"], p["style"]) == asked), {}
    )
    recipe = facts | {"checkpoint": checkpoint}
    seed = recipe.pop("seed")
    alike = [r for r in rows if recipe.items() <= r.facts.items() and "success_rate" in r.measures]
    return PolicyResults(
        training=facts,
        checkpoint=checkpoint,
        data={k: v for k, v in problem.items() if k not in ("task", "style")},
        versions=meta.get("versions", {}),
        rows=tuple(row for row in alike if row["seed"] == seed),
        others=tuple(row for row in alike if row["seed"] != seed),
        grid=meta["identity"]["recipe"].get("evaluation", {}).get("grid", "uniform"),
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
        results: what a run tells of it, see :func:`policy_results`.

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
    prior = actor.prior
    label = prior_label(prior.name)
    if results:
        label = prior_label(
            results.training.get("prior", prior.name), results.training.get("options", "")
        )
    task = results.training["task"] if results else environment_name(actor)
    front = ["library_name: warmprior", "pipeline_tag: robotics"]
    front += [] if licence is None else [f"license: {json.dumps(licence)}"]
    front += ["tags:", *(f"- {tag}" for tag in TAGS)]
    parts = [
        "\n".join(["---", *front, "---"]),
        f"# {label}{f' on {task}' if task else ''}",
        f"A policy of the library warmprior: {_source_told(actor)}",
        _table(("", ""), _facts(actor, results)),
        "## Success",
        _success(results),
        "## Use",
        _use(actor, repository),
        "## What is not told here",
        "\n".join(f"- {line}" for line in _unknown(actor, results, licence)),
    ]
    return "\n\n".join(parts) + "\n"


def _source_told(actor: WarmPriorActor) -> str:
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
        told = [f"{name} of robosuite", f"style {environment['robosuite']['style']}"]
        told += [f"{environment['actions']} actions"] if "actions" in environment else []
        if "images" in environment:
            seen = environment["images"]
            told.append(f"cameras {', '.join(seen['cameras'])} of {seen['size']} pixels")
        found.insert(0, ("environment", ", ".join(told)))
    elif actor.environment is not None:
        found.insert(0, ("environment", _code(actor.environment)))
    mine, versions = version("warmprior"), ""
    if results is not None:
        training, data = results.training, results.data
        found.insert(0, ("task", f"{training['task']}, data {training['data']}"))
        told = [f"{k} {_code(v)}" for k, v in data.items()]
        found.append(("demonstrations", "; ".join(told) or "not told"))
        iterations = f"{results.checkpoint:,} of {training['iterations']:,} iterations"
        found.append(("training", f"{iterations}, seed {training['seed']}"))
        versions = ", ".join(f"{name} {number}" for name, number in results.versions.items())
        versions = f"trained and played with {versions}; "
    found.append(("versions", f"{versions}uploaded by warmprior {mine}"))
    return found


def _success(results: PolicyResults | None) -> str:
    if results is None:
        return "Not measured, or not told when this card was written."
    if not results.rows:
        return f"The policy of iteration {results.checkpoint:,} was not played."
    conditions = [n for n in ("delay", "guidance") if any(n in r.facts for r in results.rows)]
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
    told = [
        f"NFE is the number of network evaluations per chunk. The policy is of training seed "
        f"{results.training['seed']}; episodes begin from the simulator's seeds {EVALUATION_SEED} to {last}.",
        "The interval is of a Beta posterior under a uniform prior: it tells how few the episodes are, "
        "and not how training seeds differ.",
    ]
    if results.grid != "uniform":
        told.append(f"Integrated on the grid {_code(results.grid)}.")
    return f"{_table((*head, 'other training seeds'), shown)}\n\n{' '.join(told)}"


def _use(actor: WarmPriorActor, repository: str) -> str:
    own = [
        f"{type(part).__name__} of {type(part).__module__}"
        for part in (actor.prior, actor.network)
        if not type(part).__module__.startswith("warmprior.")
    ]
    told = f"It needs classes of its author: import {' and '.join(own)} first.\n\n" if own else ""
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
    return f"{told}```python\n{code}\n```\n\n```console\n{command}\n```"


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
