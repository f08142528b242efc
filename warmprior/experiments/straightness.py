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
from warmprior.diagnostics.flow import depends_on_history, encoded_windows, sees_history
from warmprior.diagnostics.shared_observations import SharedObservations
from warmprior.diagnostics.statistics import bootstrap_ratio
from warmprior.experiments.methods import Method
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
    coupled: bool = False,
    generator: torch.Generator | None = None,
) -> dict[str, float]:
    """How far a policy's source is from its targets and how straight the flow between them.

    Over the executed positions.

    Args:
        policy: the policy.
        batch: windows ``[*B]`` of its prior, see :meth:`SharedObservations.met`.

    Keyword Args:
        n_steps: Euler steps.
        coupled: whether the training pairs sources and targets: the bound does not apply then.
        generator: source of randomness on the policy's device; the policy's own by default.

    Returns:
        ``"kappa"`` and ``"relative_curvature"``, see :func:`~warmprior.diagnostics.curvature`; NaN where the
        field does not move or is no flow. ``"bound"``, see
        :func:`~warmprior.diagnostics.branching_bound`, and ``"coverage"``, see
        :func:`~warmprior.diagnostics.source_coverage`; NaN where they do not apply.
    """
    measured = dict.fromkeys(("kappa", "relative_curvature"), math.nan)
    if policy.ode.max_nfe is None:
        with warnings.catch_warnings():  # that something does not move is told by its NaN
            warnings.simplefilter("ignore")
            found = curvature(policy, batch, n_steps, generator=generator)
        for name, key in (("kappa", "kappa_executed"), ("relative_curvature", "relative_executed")):
            measured[name] = float(found[key].nanmean())
    bound, coverage = _bounds(policy.prior, batch, coupled)[1], source_coverage(policy, batch)
    return measured | {"bound": float(bound), "coverage": coverage}


def straightness(
    policies: Mapping[Method, Mapping[int, WarmPriorActor]],
    observations: SharedObservations,
    *,
    n_steps: int = 100,
    draws: int = 1,
    seed: int = 0,
    description: str | None = None,
) -> list[Row]:
    """Curvatures relative to the first policy's, with bootstrap intervals over episodes.

    Every policy is measured at the history of its training and, if it depends on that, at the one
    that deployment meets, made from its own prediction one decision earlier.

    Args:
        policies: by method and training seed; the baseline first. Those without a flow are left out.
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
        >>> from warmprior import VelocityMLP
        >>> from warmprior.experiments import Method
        >>> from warmprior.envs import navigation_demonstrations
        >>> def untrained(prior):
        ...     network = VelocityMLP(1, 9, prior.prediction_length, observation_steps=1, hidden_dim=8)
        ...     return {0: WarmPriorActor(network, prior)}
        >>> methods = [Method("gaussian", 4), Method("past", 4)]
        >>> policies = {method: untrained(method.prior()) for method in methods}
        >>> shared = SharedObservations(navigation_demonstrations(), 4, observation_steps=1, count=20)
        >>> with warnings.catch_warnings(action="ignore"):  # that an untrained field does not move
        ...     rows = straightness(policies, shared, n_steps=4)
        >>> [(row["policy"], row["mean"], row["ratio"]) for row in rows]
        [('gaussian, sigma 1, H 4', 'training', None), ('past, sigma 0.5, H 4', 'training', None),
         ('past, sigma 0.5, H 4', 'deployed', None)]
    """
    policies = {method: actors for method, actors in policies.items() if method.is_flow}
    counts = {method: sorted(actors) for method, actors in policies.items()}
    if not counts:
        raise ValueError("none of these policies has a flow: compare gaussian, past or preview")
    seeds = next(iter(counts.values()))
    if any(other != seeds for other in counts.values()):
        raise ValueError(f"every policy needs the same training seeds, got {list(counts.values())}")
    measured: dict[tuple[Method, str], list[TensorDict]] = {}
    bounds: dict[tuple[Method, str], list[Tensor]] = {}
    jobs = [(method, actors[s]) for method, actors in policies.items() for s in seeds]
    for method, actor in tqdm(jobs, desc=description, disable=description is None):
        device = next(actor.parameters()).device
        # Of the earlier prediction: at deployment its noise and that of the next are independent.
        earlier = torch.Generator(device).manual_seed(seed + 1)
        windows = observations.windows(actor.prior, see_history=sees_history(actor))
        batches = {"training": encoded_windows(actor, windows)}
        if depends_on_history(actor, batches["training"]):
            batches["deployed"] = observations.deployed(actor, generator=earlier)
        for mean, batch in batches.items():
            # The same source noise for every policy and mean.
            generator = torch.Generator(device).manual_seed(seed)
            try:
                values = curvature(actor, batch, n_steps, draws=draws, generator=generator).cpu()
            except FloatingPointError as error:
                raise FloatingPointError(f"{method}, {mean} mean: {error}") from error
            measured.setdefault((method, mean), []).append(values)
            coupled = method.composition.coupling is not None
            bounds.setdefault((method, mean), []).append(_bounds(actor.prior, batch, coupled))
    base = next(iter(policies))
    rows = []
    for (method, mean), per_seed in measured.items():
        facts: dict[str, Any] = {
            "policy": str(method),
            "prior": method.name,
            "options": method.options,
        }
        facts |= {"sigma": method.sigma, "chunk": method.chunk_length, "mean": mean}
        parts: list[tuple[int | None, TensorDict, TensorDict, Tensor]] = [
            (s, *part)
            for s, *part in zip(
                seeds, per_seed, measured[base, "training"], bounds[method, mean], strict=True
            )
        ]
        if len(per_seed) > 1:
            average, bases = _average(per_seed), _average(measured[base, "training"])
            parts.append((None, average, bases, torch.stack(bounds[method, mean]).mean(0)))
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


def _bounds(prior: Prior, batch: TensorDictBase, coupled: bool) -> Tensor:
    try:
        bound = branching_bound(batch, prior)
    except ValueError:  # a source that is not Gaussian
        coupled = True
    if coupled:
        return torch.full((2,), math.nan)
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
