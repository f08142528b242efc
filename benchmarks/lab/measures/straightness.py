"""The curvature of flows relative to the first policy's (Table 2), and the bounds of their branching cost."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from lab.measures.statistics import bootstrap_ratio
from lab.methods.methods import Method
from warmprior import Prior, WarmPriorActor
from warmprior.diagnostics import SharedObservations, branching_bound, curvature, encoded_windows
from warmprior.diagnostics.flow import depends_on_history
from warmprior.modules.network import device_of

# By name, the entry of `curvature` that is divided by the first policy's.
RATIOS = {
    "ratio": "kappa",
    "ratio_executed": "kappa_executed",
    "ratio_relative": "relative_executed",
    "ratio_one_step": "one_step_error_executed",
}


def bounds(prior: Prior, batch: TensorDictBase, coupled: bool) -> Tensor:
    """Return the bound of the branching cost, over all and over executed positions; NaN if there is none."""
    if not coupled:
        try:
            bound = branching_bound(batch, prior)
            return torch.stack([bound[key].nanmean().cpu() for key in ("total", "total_executed")])
        except ValueError:  # a source that is not Gaussian
            pass
    return torch.full((2,), math.nan)


def check_flows(methods: Iterable[Method]) -> None:
    """Raise ValueError if none of the methods has a flow that could be measured."""
    if not any(method.is_flow for method in methods):
        raise ValueError("none of these policies has a flow: compare gaussian, past or preview")


def straightness(
    policies: Mapping[Method, Mapping[int, WarmPriorActor]],
    observations: SharedObservations,
    *,
    draws: int = 1,
    seed: int = 0,
    **options: Any,
) -> list[dict[str, Any]]:
    """Return curvatures relative to the first policy's, with bootstrap intervals over episodes (Table 2).

    Every policy is measured with the history of its training. If it depends on the history, it is also
    measured with the history of deployment, made from its own prediction one decision earlier. There is a row
    per policy, training seed and history (`mean`), and one with `seed` None for the average over several
    seeds. Options are those of `curvature`.
    """
    check_flows(policies)
    policies = {method: actors for method, actors in policies.items() if method.is_flow}
    seeds = sorted(next(iter(policies.values())))
    # By method and history, per seed: curvatures, and bounds of the branching cost.
    measured: dict[tuple[Method, str], list[tuple[TensorDict, Tensor]]] = {}
    jobs = [(method, actors[s]) for method, actors in policies.items() for s in seeds]
    for method, actor in tqdm(jobs, desc="curvature", disable=None):
        windows = observations.windows(actor.prior, see_history=actor.sees_history)
        device = device_of(actor, windows)
        # For the earlier prediction, whose noise is independent of the next at deployment.
        earlier = torch.Generator(device).manual_seed(seed + 1)
        batches = {"training": encoded_windows(actor, windows)}
        if depends_on_history(actor, batches["training"]):
            batches["deployed"] = observations.deployed(actor, generator=earlier)
        for mean, batch in batches.items():
            # The same source noise for every policy and history.
            generator = torch.Generator(device).manual_seed(seed)
            try:
                values = curvature(actor, batch, draws=draws, generator=generator, **options).cpu()
            except FloatingPointError as error:
                raise FloatingPointError(f"{method}, {mean} mean: {error}") from error
            limits = bounds(actor.prior, batch, method.parts.coupling is not None)
            measured.setdefault((method, mean), []).append((values, limits))
    first = [values for values, _ in measured[next(iter(policies)), "training"]]
    rows = []
    for (method, mean), by_seed in measured.items():
        parts: list[Any] = [(s, *pair, base) for s, pair, base in zip(seeds, by_seed, first, strict=True)]
        if len(seeds) > 1:
            every = zip(*by_seed, strict=True)
            # NaN where any seed predicts no motion, because the others alone are no mean over the seeds.
            averages = (torch.stack(list(one)).mean(0) for one in (*every, first))
            parts.append((None, *averages))
        for s, values, limits, baseline in parts:
            rows.append(
                {
                    "policy": str(method),
                    **method.facts,
                    "mean": mean,
                    "seed": s,
                    "observations": len(observations),
                    **{key: float(value.nanmean()) for key, value in values.items()},
                    **dict(zip(("bound", "bound_executed"), limits.tolist(), strict=True)),
                    **ratios(values, baseline, observations.episodes, seed),
                }
            )
    return rows


def ratios(values: TensorDict, baseline: TensorDict, episodes: Tensor, seed: int) -> dict[str, float]:
    """Return the ratios to the first policy, with their 95% intervals."""
    result: dict[str, float] = {}
    # A field that predicts no motion has no one-step error either, so it is left out.
    still = values["kappa_executed"].isnan() | baseline["kappa_executed"].isnan()
    for name, key in RATIOS.items():
        generator = torch.Generator().manual_seed(seed)
        counted = values[key]
        if name == "ratio_one_step":
            counted = counted.masked_fill(still, math.nan)
        ends = bootstrap_ratio(counted, baseline[key], episodes, generator=generator)
        result |= zip((name, f"{name}_low", f"{name}_high"), ends, strict=True)
    return result
