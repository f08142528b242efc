"""The model card of a policy: its parts, what is known of its training and success, and its use."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

from warmprior.io.extras import require
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.registry import Registered
from warmprior.saving.policies import policy_config


def model_card(
    actor: WarmPriorActor,
    *,
    task: str | None = None,
    facts: Mapping[str, str] | None = None,
    success: str = "Not measured, or not known when this card was written.",
    repository: str = "user/name",
    license: str | None = None,
) -> str:
    """Write the card of a policy, ``README.md`` of its repository at the hub.

    Args:
        actor: the policy.

    Keyword Args:
        task: name of the task; by default that of the environment that the policy keeps.
        facts: further rows of the first table, such as those of the training.
        success: the section about success.
        repository: the repository that will hold the policy, such as ``"user/name"``.
        license: the hub's name of its licence, such as ``"mit"``.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.saving import model_card
        >>> card = model_card(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), license="mit")
        >>> "license: mit" in card, "`PastPrior(chunk_length=4, sigma=0.5, correlation=0.0)`" in card
        (True, True)
    """
    data = require("huggingface_hub", "sim").ModelCardData(
        library_name="warmprior",
        pipeline_tag="robotics",
        license=license,
        tags=["robotics", "imitation-learning", "flow-matching", "torchrl", "warmprior"],
    )
    from warmprior.envs.description import environment_name

    name = environment_name(actor)
    task = task or name
    rows = {**_facts(actor), **(facts or {}), "uploaded by": f"warmprior {version('warmprior')}"}
    parts = [
        f"---\n{data.to_yaml()}\n---",
        f"# {actor.prior.name}{f' on {task}' if task else ''}",
        "A flow carries a sample of the source named below to each chunk of actions, after "
        "[WarmPrior](https://sinnnj.github.io/WarmPrior/).",
        table(("", ""), rows.items()),
        "## Success",
        success,
        "## Use",
        _usage(actor, repository, playable=name is not None),
    ]
    return "\n\n".join(parts) + "\n"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    head = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


def code(value: Any) -> str:
    """Return a value as code in a table of Markdown."""
    text = value if isinstance(value, str) else json.dumps(value)
    return f"`{text.replace('|', '/').replace('`', '')}`"


def _facts(actor: WarmPriorActor) -> dict[str, str]:
    config = policy_config(actor)
    count = sum(p.numel() for p in actor.network.parameters())
    return {
        "source": code(repr(actor.prior)),
        "network": f"{count:,} parameters: {code(config['network'])}",
        "sampler": code(config["actor"]),
        "normaliser": "kept" if actor.normalizer is not None else "none",
        "environment": code(config["environment"]) if actor.environment else "not known",
    }


def _usage(actor: WarmPriorActor, repository: str, playable: bool) -> str:
    path = getattr(actor.network, "interpolant", None)
    starts = [] if actor.start is None else actor.start.modules()
    own = dict.fromkeys(
        f"{type(part).__name__} of {type(part).__module__}"
        for part in (actor.prior, *starts, path, *actor.network.modules())
        if isinstance(part, Registered) and not type(part).__module__.startswith("warmprior.")
    )
    words = f"It needs classes of its author: import {' and '.join(own)} first.\n\n" if own else ""
    lines = ["from warmprior.saving import load_policy", "", f'actor = load_policy("{repository}")']
    if playable:
        lines.insert(1, "from warmprior.envs import environment_of")
        lines.append("environment_of(actor).rollout(100, actor)")
    return f"{words}```python\n" + "\n".join(lines) + "\n```"
