"""The model card of a policy: its parts, its training and its measured success."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

from warmprior.diagnostics.statistics import success_posterior
from warmprior.io.extras import require
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.saved import policy_config


def model_card(
    actor: WarmPriorActor,
    results: Sequence[Mapping[str, Any]] = (),
    *,
    repository: str = "user/name",
    licence: str | None = None,
) -> str:
    """Write the card of a policy, ``README.md`` of its repository at the hub.

    Args:
        actor: the policy.
        results: a row per evaluation, with ``task``, ``data``, ``seed``, ``checkpoint``, ``iterations``,
            ``nfe``, ``episodes``, ``successes``, and ``demonstrations``, facts about the data.

    Keyword Args:
        repository: the repository that will hold the policy, such as ``"user/name"``.
        licence: the hub's name of its licence, such as ``"mit"``.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.training import model_card
        >>> card = model_card(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), licence="mit")
        >>> "license: mit" in card, "`PastPrior(chunk_length=4, sigma=0.5, correlation=0.0)`" in card
        (True, True)
    """
    data = require("huggingface_hub", "sim").ModelCardData(
        library_name="warmprior",
        pipeline_tag="robotics",
        license=licence,
        tags=["robotics", "imitation-learning", "flow-matching", "torchrl", "warmprior"],
    )
    from warmprior.envs.description import environment_name

    task = results[0]["task"] if results else environment_name(actor)
    parts = [
        f"---\n{data.to_yaml()}\n---",
        f"# {actor.prior.name}{f' on {task}' if task else ''}",
        "A flow carries a sample of the source named below to each chunk of actions, after "
        "[WarmPrior](https://sinnnj.github.io/WarmPrior/).",
        _table(("", ""), _facts(actor, results).items()),
        "## Success",
        _success(results),
        "## Use",
        _use(actor, repository),
    ]
    return "\n\n".join(parts) + "\n"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


def _code(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return f"`{text.replace('|', '/').replace('`', '')}`"


def _facts(actor: WarmPriorActor, results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    config = policy_config(actor)
    count = sum(p.numel() for p in actor.network.parameters())
    facts = {
        "source": _code(repr(actor.prior)),
        "network": f"{count:,} parameters: {_code(config['network'])}",
        "sampler": _code(config["actor"]),
        "normaliser": "kept" if actor.normalizer is not None else "none",
        "environment": _code(config["environment"]) if actor.environment else "not known",
    }
    if results:
        row = results[0]
        steps = f"{row['checkpoint']:,} of {row['iterations']:,} iterations, seed {row['seed']}"
        facts["training"] = f"{row['task']}, data {row['data']}: {steps}"
        facts["demonstrations"] = _code(row.get("demonstrations", "not known"))
    return facts | {"uploaded by": f"warmprior {version('warmprior')}"}


def _success(results: Sequence[Mapping[str, Any]]) -> str:
    if not results:
        return "Not measured, or not known when this card was written."
    conditions = [n for n in ("nfe", "delay", "guidance") if n in results[0]]
    shown = []
    for row in results:
        low, high = success_posterior(row["successes"], row["episodes"]).interval(0.95)
        cells = [str(row[name]) for name in (*conditions, "episodes", "successes")]
        shown.append([*cells, f"{100 * low:.1f}% to {100 * high:.1f}%"])
    words = (
        "NFE is the number of network evaluations per chunk. The interval is from a Beta posterior under a "
        "uniform prior: it reflects the number of episodes, but not the variation between training seeds."
    )
    if results[0].get("demonstrations", {}).get("source") == "scripted":
        words += " A scripted expert recorded the data: do not compare these with published numbers."
    return f"{_table((*conditions, 'episodes', 'solved', '95% of the posterior'), shown)}\n\n{words}"


def _use(actor: WarmPriorActor, repository: str) -> str:
    from warmprior.envs.description import environment_name

    own = [
        f"{type(part).__name__} of {type(part).__module__}"
        for part in (actor.prior, actor.network)
        if not type(part).__module__.startswith("warmprior.")
    ]
    words = f"It needs classes of its author: import {' and '.join(own)} first.\n\n" if own else ""
    lines = ["from warmprior.training import load_policy", "", f'actor = load_policy("{repository}")']
    if environment_name(actor) is not None:
        lines.insert(1, "from warmprior.envs import environment_of")
        lines.append("environment_of(actor).rollout(100, actor)")
    return f"{words}```python\n" + "\n".join(lines) + "\n```"
