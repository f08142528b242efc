"""This module writes a benchmark policy's training and measured success for its model card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from warmprior.diagnostics import success_posterior
from warmprior.saving.card import code, table


def measured(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return task, facts and success of :func:`~warmprior.saving.model_card` from a policy's rows.

    Examples:
        >>> from lab.reporting.cards import measured
        >>> row = {"task": "lift", "data": "ph", "seed": 0, "checkpoint": 20, "iterations": 20,
        ...        "nfe": 1, "episodes": 4, "successes": 2}
        >>> measured([row])["success"].splitlines()[2]
        '| 1 | 4 | 2 | 14.7% to 85.3% |'
    """
    first = results[0]
    steps = f"{first['checkpoint']:,} of {first['iterations']:,} iterations, seed {first['seed']}"
    facts = {
        "training": f"{first['task']}, data {first['data']}: {steps}",
        "demonstrations": code(first.get("demonstrations", "not known")),
    }
    conditions = [n for n in ("nfe", "temperature", "delay", "guidance") if n in first]
    shown = []
    for row in results:
        low, high = success_posterior(row["successes"], row["episodes"]).interval(0.95)
        cells = [str(row[name]) for name in (*conditions, "episodes", "successes")]
        shown.append([*cells, f"{100 * low:.1f}% to {100 * high:.1f}%"])
    words = (
        "NFE is the number of network evaluations per chunk. The interval is from a Beta posterior under a "
        "uniform prior: it reflects the number of episodes, but not the variation between training seeds."
    )
    if first.get("demonstrations", {}).get("source") == "scripted":
        words += " A scripted expert recorded the data: do not compare these with published numbers."
    success = f"{table((*conditions, 'episodes', 'solved', '95% of the posterior'), shown)}\n\n{words}"
    return {"task": first["task"], "facts": facts, "success": success}
