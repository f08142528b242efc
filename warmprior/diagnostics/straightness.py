"""Curvature of several policies on the same observations, and the paper's Table 2 made from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from warmprior.diagnostics._figure import prior_label
from warmprior.diagnostics.branching import branching_bound
from warmprior.diagnostics.curvature import curvature
from warmprior.diagnostics.held_out import SharedObservations
from warmprior.diagnostics.paper import PAPER_CURVATURE
from warmprior.diagnostics.statistics import bootstrap_ratio
from warmprior.diagnostics.table import markdown_table
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior

__all__ = ["curvature_table", "straightness"]

RATIOS = {
    "ratio": "kappa",
    "ratio_executed": "kappa_executed",
    "ratio_relative": "relative_executed",
    "ratio_one_step": "one_step_error_executed",
}
"""Ratios to the baseline, and the entry of :func:`curvature` that each compares."""


def straightness(
    policies: Mapping[str, Sequence[WarmPriorActor]],
    observations: SharedObservations,
    *,
    n_steps: int = 100,
    draws: int = 1,
    seed: int = 0,
    description: str | None = None,
) -> list[dict[str, Any]]:
    """Curvatures relative to the first policy's, with bootstrap intervals over episodes.

    Every policy is measured at the mean of its training and, if anything of its source is warm, at the
    mean that deployment meets, made from its own prediction one decision earlier.

    Args:
        policies: by name the policies of one prior, one per training seed; the baseline first.
        observations: the observations of all of them.

    Keyword Args:
        n_steps: Euler steps.
        draws: source samples per observation.
        seed: of the source samples and of the bootstrap.
        description: of the progress bar; no bar if ``None``.

    Returns:
        One row per policy, training seed and mean, and one with ``"seed": None`` for the average over
        several seeds: ``"policy"``, ``"prior"``, ``"sigma"``, ``"chunk"``, ``"seed"``, ``"mean"``
        (``"training"`` or ``"deployed"``), ``"observations"``; the means of :func:`curvature`'s
        entries; ``"bound"`` (:func:`branching_bound` of the executed positions at this mean, where it
        applies); and per ratio of
        :data:`RATIOS` its value and 95% interval (``"ratio"``, ``"ratio_low"``, ``"ratio_high"``, and
        so on). NaN, with a warning, where a policy predicts no motion; an average is, if any seed is.

    Raises:
        ValueError: if the numbers of training seeds or the chunk lengths differ, or a policy is no flow.
        FloatingPointError: if a path becomes NaN or infinite.
    """
    counts = {name: len(actors) for name, actors in policies.items()}
    if len(set(counts.values())) != 1 or not next(iter(counts.values())):
        raise ValueError(f"every policy needs the same number of training seeds, got {counts}")
    measured: dict[tuple[str, str], list[TensorDict]] = {}
    bounds: dict[tuple[str, str], list[float]] = {}
    jobs = [(name, actor) for name, actors in policies.items() for actor in actors]
    for name, actor in tqdm(jobs, desc=description, disable=description is None):
        device = next(actor.parameters()).device
        # Of the earlier prediction: at deployment its noise and that of the next are independent.
        earlier = torch.Generator(device).manual_seed(seed + 1)
        batches = {"training": observations.windows(actor.prior)}
        if batches["training"]["prior", "warm"].any():
            batches["deployed"] = observations.deployed(actor, generator=earlier)
        for mean, batch in batches.items():
            # The same source noise for every policy and mean.
            generator = torch.Generator(device).manual_seed(seed)
            try:
                values = curvature(actor, batch, n_steps, draws=draws, generator=generator).cpu()
            except FloatingPointError as error:
                raise FloatingPointError(f"{name}, {mean} mean: {error}") from error
            measured.setdefault((name, mean), []).append(values)
            bounds.setdefault((name, mean), []).append(_bound(actor.prior, batch))
    base = next(iter(policies))
    rows = []
    for (name, mean), per_seed in measured.items():
        prior = policies[name][0].prior
        parts: list[tuple[int | None, TensorDict, TensorDict, float]] = [
            (s, values, measured[base, "training"][s], bounds[name, mean][s])
            for s, values in enumerate(per_seed)
        ]
        if len(per_seed) > 1:
            average, bases = _average(per_seed), _average(measured[base, "training"])
            parts.append((None, average, bases, math.fsum(bounds[name, mean]) / len(per_seed)))
        for s, values, baseline, bound in parts:
            row: dict[str, Any] = {
                "policy": name,
                "prior": prior.name,
                "sigma": prior.sigma,
                "chunk": prior.chunk_length,
                "seed": s,
                "mean": mean,
                "observations": len(observations),
                **{key: _mean(value) for key, value in values.items()},
                "bound": bound,
            }
            rows.append(row | _ratios(values, baseline, observations.episodes, seed))
    return rows


def _mean(values: Tensor) -> float:
    return float(values.nanmean())


def _average(per_seed: Sequence[TensorDict]) -> TensorDict:
    # NaN where any seed predicts no motion: the others alone would be no average over the seeds.
    mean = {
        key: torch.stack([values[key] for values in per_seed]).mean(0)
        for key, _ in per_seed[0].items()
    }
    return TensorDict(mean, batch_size=per_seed[0].shape)


def _bound(prior: Prior, batch: TensorDictBase) -> float:
    if not prior.is_gaussian:
        return math.nan
    return _mean(branching_bound(batch, prior)["total_executed"])


def _ratios(
    values: TensorDict, baseline: TensorDict, episodes: Tensor, seed: int
) -> dict[str, float]:
    out: dict[str, float] = {}
    # A field that predicts no motion has no error of one step either, and no merit in that.
    still = values["kappa_executed"].isnan() | baseline["kappa_executed"].isnan()
    for name, key in RATIOS.items():
        generator = torch.Generator().manual_seed(seed)
        counted = values[key]
        if name == "ratio_one_step":
            counted = counted.masked_fill(still, math.nan)
        ends = bootstrap_ratio(counted, baseline[key], episodes, generator=generator)
        out.update(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
    return out


def curvature_table(rows: Sequence[dict[str, Any]], *, task: str, data: str, source: str) -> str:
    """The layout of the paper's Table 2 in Markdown, with the paper's own numbers in a row of their own.

    The paper's are for ``H = 8`` and relative to the Gaussian source; otherwise they are left out.

    Args:
        rows: of :func:`straightness`.

    Keyword Args:
        task: short task name.
        data: ``"ph"`` or ``"mh"``.
        source: what the observations are, in words.
    """
    seeds = {row["seed"] for row in rows}
    chosen = [row for row in rows if row["seed"] == (None if None in seeds else min(seeds))]
    names = list(dict.fromkeys(row["policy"] for row in chosen))
    labels = [prior_label(row["policy"]) for row in map(_first(chosen), names)]
    title = f"{task.replace('_', '-').title()}-{data.upper()}"
    lines: list[list[str]] = []
    told = {
        "ratio": "whole prediction",
        "ratio_executed": "executed H",
        "ratio_relative": "executed H, per squared mean velocity",
        "ratio_one_step": "error of one Euler step, executed H",
    }
    for ratio, what in told.items():
        for mean in ("training", "deployed"):
            if not any(row["mean"] == mean for row in chosen):
                continue
            cells = [_cell(chosen, name, mean, ratio) for name in names]
            lines.append([f"{title}, {what}, {mean} mean", *cells])
    paper = PAPER_CURVATURE.get((task, data))
    if paper is not None and chosen[0]["prior"] == "gaussian" and chosen[0]["chunk"] == 8:
        values = {"gaussian": 1.0, **paper}
        shown = [row["prior"] for row in map(_first(chosen), names)]
        cells = [f"{values[prior]:.3f}" if prior in values else "-" for prior in shown]
        lines.append([f"{title}, paper (official data)", *cells])
    count = chosen[0]["observations"]
    several = f", averaged over {len(seeds) - 1} training seeds" if None in seeds else ", one seed"
    notes = [
        f"- {count} observations of {source}{several}; in brackets 95% bootstrap intervals over episodes.",
        "- Deployed mean: made from the policy's own prediction one decision earlier. The paper does not "
        "say which mean it uses, nor whether it counts a prediction of 2H whole.",
        "- Curvature shrinks with the length of the transport; divided by the squared mean velocity it "
        "does not.",
    ]
    return markdown_table(["curvature relative to the first column", *labels], lines, notes)


def _first(rows: Sequence[dict[str, Any]]) -> Any:
    return lambda name: next(row for row in rows if row["policy"] == name)


def _cell(rows: Sequence[dict[str, Any]], name: str, mean: str, ratio: str) -> str:
    # A policy without a mean is the same at both.
    of_policy = [row for row in rows if row["policy"] == name]
    row = next((row for row in of_policy if row["mean"] == mean), of_policy[0])
    value, low, high = row[ratio], row[f"{ratio}_low"], row[f"{ratio}_high"]
    if math.isnan(value):
        return "no motion"
    if name == rows[0]["policy"]:
        return f"{value:.3f}"
    interval = "" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]"
    return f"{value:.3f}{interval}"
