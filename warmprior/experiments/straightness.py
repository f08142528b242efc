"""Curvature of several policies on the same observations, relative to the first (Table 2)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from warmprior.diagnostics.branching import branching_bound
from warmprior.diagnostics.coverage import source_coverage
from warmprior.diagnostics.curvature import curvature
from warmprior.diagnostics.flow import encoded_windows
from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.diagnostics.statistics import bootstrap_ratio
from warmprior.experiments.results import Row
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior

__all__ = ["RATIOS", "flow_measures", "straightness"]

RATIOS = {
    "ratio": ("kappa", "whole prediction"),
    "ratio_executed": ("kappa_executed", "executed H"),
    "ratio_relative": ("relative_executed", "executed H, per squared mean velocity"),
    "ratio_one_step": ("one_step_error_executed", "error of one Euler step, executed H"),
}
"""Ratios to the baseline: the entry of :func:`curvature` that each compares, and what it is in words."""


def flow_measures(
    policy: WarmPriorActor,
    batch: TensorDictBase,
    *,
    n_steps: int = 100,
    generator: torch.Generator | None = None,
) -> dict[str, float]:
    """How far a policy's source is from its targets and how straight the flow between them.

    Over the executed positions.

    Args:
        policy: the policy.
        batch: windows ``[*B]`` of its prior, see :meth:`SharedObservations.met`.

    Keyword Args:
        n_steps: Euler steps.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        ``"kappa"`` and ``"relative_curvature"``, see :func:`~warmprior.diagnostics.curvature`; NaN where the
        field does not move or is no flow. ``"bound"``, see
        :func:`~warmprior.diagnostics.branching_bound`, and ``"coverage"``, see
        :func:`~warmprior.diagnostics.source_coverage`; NaN where they do not apply.
    """
    measured = dict.fromkeys(("kappa", "relative_curvature"), math.nan)
    if policy.prior.is_flow:
        with warnings.catch_warnings():  # that something does not move is told by its NaN
            warnings.simplefilter("ignore")
            found = curvature(policy, batch, n_steps, generator=generator)
        for name, key in (("kappa", "kappa_executed"), ("relative_curvature", "relative_executed")):
            measured[name] = float(found[key].nanmean())
    bound, coverage = _bounds(policy.prior, batch)[1], source_coverage(policy, batch)
    return measured | {"bound": float(bound), "coverage": coverage}


def straightness(
    policies: Mapping[str, Mapping[int, WarmPriorActor]],
    observations: SharedObservations,
    *,
    n_steps: int = 100,
    draws: int = 1,
    seed: int = 0,
    description: str | None = None,
) -> list[Row]:
    """Curvatures relative to the first policy's, with bootstrap intervals over episodes.

    Every policy is measured at the mean of its training and, if anything of its source is warm, at the
    mean that deployment meets, made from its own prediction one decision earlier.

    Args:
        policies: by name the policies of one prior, by training seed; the baseline first. Those without a
            flow are left out.
        observations: the observations of all of them.

    Keyword Args:
        n_steps: Euler steps.
        draws: source samples per observation.
        seed: of the source samples and of the bootstrap.
        description: of the progress bar; no bar if ``None``.

    Returns:
        One row per policy, training seed and mean, and one with ``seed = None`` for the average over
        several seeds. Facts: ``policy``, ``prior``, ``options``, ``sigma``, ``chunk``, ``seed``, ``mean``
        (``"training"`` or ``"deployed"``). Measures: ``observations``; the means of :func:`curvature`'s
        entries; ``bound`` and ``bound_executed`` (:func:`branching_bound` at this mean, where it
        applies); and per ratio of :data:`RATIOS` its value and 95% interval (``ratio``, ``ratio_low``,
        ``ratio_high``, and so on). ``None``, with a warning, where a policy predicts no motion; an
        average is, if any seed is.

    Raises:
        ValueError: if the training seeds or the chunk lengths differ, or no policy is a flow.
        FloatingPointError: if a path becomes NaN or infinite.

    Examples:
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP
        >>> from warmprior.envs import navigation_demonstrations
        >>> def untrained(prior):
        ...     network = VelocityMLP(1, 9, prior.prediction_length, observation_steps=1, hidden_dim=8)
        ...     return {0: WarmPriorActor(network, prior)}
        >>> policies = {"base": untrained(GaussianPrior(4)), "past": untrained(PastPrior(4))}
        >>> shared = SharedObservations(navigation_demonstrations(), 4, observation_steps=1, count=20)
        >>> with warnings.catch_warnings(action="ignore"):  # that an untrained field does not move
        ...     rows = straightness(policies, shared, n_steps=4)
        >>> [(row["policy"], row["mean"], row["ratio"]) for row in rows]
        [('base', 'training', None), ('past', 'training', None), ('past', 'deployed', None)]
    """
    priors = {name: next(iter(actors.values())).prior for name, actors in policies.items()}
    policies = {name: actors for name, actors in policies.items() if priors[name].is_flow}
    counts = {name: sorted(actors) for name, actors in policies.items()}
    if not counts:
        raise ValueError("none of these policies has a flow: compare gaussian, past or preview")
    seeds = next(iter(counts.values()))
    if any(other != seeds for other in counts.values()):
        raise ValueError(f"every policy needs the same training seeds, got {counts}")
    measured: dict[tuple[str, str], list[TensorDict]] = {}
    bounds: dict[tuple[str, str], list[Tensor]] = {}
    jobs = [(name, actors[s]) for name, actors in policies.items() for s in seeds]
    for name, actor in tqdm(jobs, desc=description, disable=description is None):
        device = next(actor.parameters()).device
        # Of the earlier prediction: at deployment its noise and that of the next are independent.
        earlier = torch.Generator(device).manual_seed(seed + 1)
        batches = {"training": encoded_windows(actor, observations.windows(actor.prior))}
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
            bounds.setdefault((name, mean), []).append(_bounds(actor.prior, batch))
    base = next(iter(policies))
    rows = []
    for (name, mean), per_seed in measured.items():
        prior = priors[name]
        facts: dict[str, Any] = {"policy": name, "prior": prior.name, "options": prior.options}
        facts |= {"sigma": float(prior.sigma), "chunk": prior.chunk_length, "mean": mean}
        parts: list[tuple[int | None, TensorDict, TensorDict, Tensor]] = [
            (s, *part)
            for s, *part in zip(
                seeds, per_seed, measured[base, "training"], bounds[name, mean], strict=True
            )
        ]
        if len(per_seed) > 1:
            average, bases = _average(per_seed), _average(measured[base, "training"])
            parts.append((None, average, bases, torch.stack(bounds[name, mean]).mean(0)))
        for s, values, baseline, bound in parts:
            measures = {
                "observations": len(observations),
                **{key: float(value.nanmean()) for key, value in values.items()},
                **dict(zip(("bound", "bound_executed"), bound.tolist(), strict=True)),
                **_ratios(values, baseline, observations.episodes, seed),
            }
            rows.append(Row(facts | {"seed": s}, measures))
    return rows


def pooled(rows: Sequence[Row]) -> list[Row]:
    """The averages over training seeds where there are several, else the rows of the only one."""
    seeds = {row["seed"] for row in rows}
    chosen = None if None in seeds else min(seeds, default=None)
    return [row for row in rows if row["seed"] == chosen]


def _average(per_seed: Sequence[TensorDict]) -> TensorDict:
    # NaN where any seed predicts no motion: the others alone would be no average over the seeds.
    mean = {
        key: torch.stack([values[key] for values in per_seed]).mean(0)
        for key, _ in per_seed[0].items()
    }
    return TensorDict(mean, batch_size=per_seed[0].shape)


def _bounds(prior: Prior, batch: TensorDictBase) -> Tensor:
    if not prior.is_gaussian:
        return torch.full((2,), math.nan)
    bound = branching_bound(batch, prior)
    return torch.stack([bound[name].nanmean().cpu() for name in ("total", "total_executed")])


def _ratios(
    values: TensorDict, baseline: TensorDict, episodes: Tensor, seed: int
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    # A field that predicts no motion has no error of one step either, and no merit in that.
    still = values["kappa_executed"].isnan() | baseline["kappa_executed"].isnan()
    for name, (key, _) in RATIOS.items():
        generator = torch.Generator().manual_seed(seed)
        counted = values[key]
        if name == "ratio_one_step":
            counted = counted.masked_fill(still, math.nan)
        ends = bootstrap_ratio(counted, baseline[key], episodes, generator=generator)
        out.update(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
    return out
