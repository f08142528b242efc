"""This module measures policies: on their training data, on data that they have not seen, and at play."""

from __future__ import annotations

import copy
import hashlib
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from lab.demonstrations.loading import place_of, read_like
from lab.demonstrations.scripted.generate import generate_demonstrations
from lab.measures.memory_gain import memory_gain
from lab.measures.source_errors import mean_error, mean_revision, source_coverage
from lab.measures.straightness import bounds
from lab.options.options import MeasuredOptions
from lab.running.policies import Cell, Policy
from warmprior.diagnostics import (
    SharedObservations,
    curvature,
    encoded_windows,
    smoothness,
    source_leak,
)
from warmprior.diagnostics.flow import allowed_nfes
from warmprior.evaluation import Episode
from warmprior.keys import EPISODE, OBSERVATION, STATE

MEASURED_WINDOWS = 512  # observations of the training data on which every policy is measured
HELD_OUT_SEED = 50  # seed of generated held-out demonstrations; training data have seed 0

TRAINED_ON = "the TRAINING demonstrations (not held out)"


def measure(
    trained: Policy, nfe: Sequence[int], temperature: float = 1.0
) -> dict[int, dict[str, float | None]]:
    """Return the measures of a policy on its training data, by NFE; all policies get the same draws."""
    policy, data, method = trained.load(), trained.task().data.to("cpu"), trained.method
    policy = policy.replace(temperature=temperature)
    nfes, observation_steps = method.nfes(nfe), trained.network.observation_steps
    shared = SharedObservations(data, method.chunk_length, observation_steps=observation_steps)
    drawn = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
    shared = shared.subset(drawn[:MEASURED_WINDOWS].sort()[0])
    windows = shared.windows(policy.prior, see_history=policy.sees_history)
    encoded = encoded_windows(policy, windows)
    leaks: Mapping[int, Any] = {}
    if len(shared.episodes.unique()) > 1:  # two episodes with steps to compare
        leaks = source_leak(policy, encoded, nfes=nfes, episodes=shared.episodes)
    generator = torch.Generator().manual_seed(0)
    deployed = shared.deployed(policy, generator=generator)
    allowed = allowed_nfes(policy, nfes)
    means = {nfe: mean_error(policy, deployed, nfe=nfe) for nfe in allowed}
    gains = memory_gain(policy, windows if policy.sees_history else encoded, nfes=nfes)
    # The curvature of the flow between source and targets, over the executed positions.
    kappa, relative = math.nan, math.nan
    if policy.sampling.max_nfe is None:
        with warnings.catch_warnings():  # NaN marks a field that does not move
            warnings.simplefilter("ignore")
            values = curvature(policy, deployed, generator=generator)
        kappa, relative = (float(values[key].nanmean()) for key in ("kappa_executed", "relative_executed"))
    flow = {
        "kappa": kappa,
        "relative_curvature": relative,
        "bound": float(bounds(policy.prior, deployed, method.parts.coupling is not None)[1]),
        "coverage": source_coverage(policy, deployed),
    }
    return {
        nfe: {
            "mean_error": means[nfe].target,
            "mean_revision_data": means[nfe].revision,
            "source_leak": leaks[nfe].leak if nfe in leaks else None,
            "inner_step_ratio": leaks[nfe].inner_step_ratio if nfe in leaks else None,
            "memory_gain": gains[nfe],
            **flow,
        }
        for nfe in allowed
    }


def row(
    policy: Policy, cell: Cell, episodes: Iterable[Episode], measures: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the row of a cell in `results.jsonl`: the policy, how it was played, and the results."""
    # Sums depend on the order, so episodes are sorted by their seeds.
    episodes = sorted(episodes, key=lambda episode: episode.seed)
    decisions = torch.cat([episode.decisions for episode in episodes])
    # Episodes of a single decision have no boundary between chunks.
    several = any(len(episode.decisions) > 1 for episode in episodes)
    smooth = smoothness(decisions) if several else None
    solved = [episode.success for episode in episodes]
    values_by_measure = {
        name: [episode.measures[name] for episode in episodes] for name in episodes[0].measures
    }
    return {
        **policy.facts,
        **cell.facts(),
        "first_episode": episodes[0].seed,
        "episodes": len(solved),
        "successes": sum(solved),
        "success_rate": sum(solved) / len(solved),
        "mean_steps": sum(episode.steps for episode in episodes) / len(solved),
        "boundary_jump": None if smooth is None else smooth.boundary_jump,
        "inner_jump": None if smooth is None else smooth.inner_jump,
        "mean_revision": mean_revision(decisions),
        # The prefix keeps a task's measures apart from other columns.
        **{f"episode_{name}": sum(values) / len(values) for name, values in values_by_measure.items()},
        **measures,
        "training_seconds": policy.seconds,
        "outcomes": "".join("01"[solved] for solved in solved),
    }


def held_out(options: MeasuredOptions, policy: Policy) -> tuple[SharedObservations, str]:
    """Return held-out observations of a policy's task, and a description of them.

    For the toy and for tasks outside robosuite they are the training data.

    Raises:
        ValueError: if there are no held-out data, or some of them were trained on (masks may overlap, and
            files may have demonstrations in common).
    """
    place: Path | str
    task, chunk_length = policy.task(), policy.method.chunk_length
    facts, device, count = task.facts, options.run.device, options.measured
    validation, mask = options.validation, None
    generator = torch.Generator().manual_seed(0)
    shape: dict[str, Any] = {"observation_steps": policy.network.observation_steps}
    if task.normalizer is None or "sha256" not in facts:
        if validation is not None:
            raise ValueError(f"--validation is for robosuite's tasks: leave it out with {task.name}")
        shared = SharedObservations(task.data.to(device), chunk_length, **shape)
        if len(shared) > count:
            shared = shared.subset(torch.randperm(len(shared), generator=generator)[:count])
        return shared, TRAINED_ON
    if validation is not None:
        place, words = validation, ""
    elif policy.data.mask == "train":
        place, words, mask = place_of(policy.data, task.name, task.style)[0], "", "valid"
    elif facts.get("source") != "scripted":
        raise ValueError(
            f"the policies are trained on all of {facts['file']}: train them with --mask train, to measure "
            "on the file's mask valid, or add --validation FILE with other demonstrations (or with the same "
            "file, to measure on the training data)"
        )
    else:
        # Enough demonstrations for the observations, judged by the length of the training demonstrations.
        usable = 0.8 * (facts["steps"] / facts["demonstrations"] - chunk_length)
        episodes = max(20, int(-(-count // max(1.0, min(50.0, usable)))))
        place = generate_demonstrations(task.name, task.style, episodes, HELD_OUT_SEED)
        words = f"{episodes} newly generated demonstrations"
    data, called = read_like(place, task.name, facts, mask)
    # A copy, because the data are normalised on the CPU and the policy may be on another device.
    data = copy.deepcopy(task.normalizer).to("cpu").normalize(data)
    trained, measured = (set(_episodes(part)) for part in (task.data, data))
    if common := measured & trained:
        if validation is None or common != measured:
            raise ValueError(
                f"{called} has {len(common)} of {len(measured)} demonstrations in common with the training "
                f"data, {facts['file']}: choose masks, or a --validation, without them"
            )
        words = TRAINED_ON
    shared = SharedObservations(data.to(device), chunk_length, **shape)
    if count > len(shared):
        have = f"{len(shared)} of the {len(data)} steps of {called} have {chunk_length} before them"
        raise ValueError(f"--measured {count}, but {have}: measure fewer")
    return shared.subset(torch.randperm(len(shared), generator=generator)[:count].sort()[0]), words or called


def _episodes(data: TensorDictBase) -> list[str]:
    """Return a digest of the observations of every demonstration."""
    observation = data[OBSERVATION]
    vector = observation[STATE] if isinstance(observation, TensorDictBase) else observation
    lengths = [n for n in data[EPISODE].flatten().bincount().tolist() if n]
    parts = vector.cpu().contiguous().split(lengths)
    return [hashlib.sha256(part.numpy().tobytes()).hexdigest() for part in parts]
