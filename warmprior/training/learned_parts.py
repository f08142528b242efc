"""Sources and start points that learn before the flow: once per run, kept in its folder, then frozen."""

from __future__ import annotations

import copy
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from warmprior import keys
from warmprior.checks import check_finite
from warmprior.io.distributed import leader_first
from warmprior.io.files import exclusive
from warmprior.modules.actor import StartPoint
from warmprior.modules.prior import Prior
from warmprior.modules.registry import from_config
from warmprior.options.training import TrainingConfig
from warmprior.saving.policies import NoLargerThan
from warmprior.saving.training_state import (
    check_identity,
    load_state,
    module_tensors,
    restore_module,
    restoring,
    run_identity,
    save_state,
)
from warmprior.transforms.window import window_replay_buffer, without_images

SHARE = 0.25
"""The gradient steps of a part that learns before the flow, per gradient step of the flow."""

BATCH_SIZE, HELD_OUT_BATCH_SIZE = 256, 4_096


def learns_first(part: Any) -> bool:
    """Return True if a part learns before the flow: its class overrides :meth:`Prior.fit`."""
    return getattr(type(part), "fit", Prior.fit) is not Prior.fit


def learned(
    part: Any,
    lengths: Prior,
    data: TensorDictBase,
    training: TrainingConfig,
    directory: str | Path,
    *,
    observation_steps: int,
) -> Any:
    """Return a copy of a part that has learnt (:meth:`Prior.fit`) and is frozen.

    It is kept in the folder, where a run that continues finds it.

    Args:
        part: the source or start point.
        lengths: the source, whose lengths the windows have.
        data: contiguous normalised steps. Every tenth episode is held out, or the second of fewer than ten.
        training: the recipe of the flow.
        directory: the folder of the run.

    Keyword Args:
        observation_steps: ``To``.

    Raises:
        FloatingPointError: if its weights become NaN or infinite.
        ValueError: if it refuses the data, or the folder has one of another run.
    """
    is_prior = isinstance(part, Prior)
    path = Path(directory) / f"{'prior' if is_prior else 'start'}.safetensors"
    data = without_images(data)
    steps = max(1, round(SHARE * training.iterations))
    options = {
        "iterations": steps,
        "seed": training.seed,
        "cold_probability": training.cold_probability,
        "observation_steps": observation_steps,
        "lengths": [lengths.chunk_length, lengths.prediction_length, lengths.history_length],
    }
    seen = data.select(keys.OBSERVATION, keys.ACTION, keys.EPISODE)
    identity = run_identity(seen, options, part=part.config())
    with torch.random.fork_rng([]):
        with leader_first():  # other processes find the file
            if not path.exists():
                with exclusive(path.parent):
                    fresh = copy.deepcopy(part)
                    _fit(fresh, lengths, data, training, steps, observation_steps)
                    tensors = module_tensors(fresh) if isinstance(fresh, nn.Module) else {}
                    save_state(path, tensors, {"identity": identity, "config": fresh.config()})
        tensors, facts = load_state(path)
        check_identity(path, facts.get("identity"), identity)
        with restoring(path):
            with NoLargerThan(tensors):
                kept: Any = from_config(Prior if is_prior else StartPoint, facts["config"])
            if isinstance(kept, nn.Module):
                kept.to(data.device or "cpu")
                restore_module(kept, tensors)
                kept.requires_grad_(False).eval()
    return kept


def _fit(
    part: Any,
    lengths: Prior,
    data: TensorDictBase,
    training: TrainingConfig,
    iterations: int,
    observation_steps: int,
) -> None:
    """Let a part learn in place."""
    number = data[keys.EPISODE].flatten().unique(return_inverse=True)[1]
    is_held_out = number % 10 == 9 if int(number.max()) >= 9 else number == 1
    generator = torch.Generator(data.device or "cpu").manual_seed(training.seed)
    buffer = partial(
        window_replay_buffer,
        prior=lengths,
        observation_steps=observation_steps,
        withhold=training.cold_probability,
        generator=generator,
    )
    windows = buffer(data[~is_held_out], batch_size=BATCH_SIZE)
    held_out = buffer(data[is_held_out] if is_held_out.any() else data, batch_size=HELD_OUT_BATCH_SIZE)
    torch.manual_seed(training.seed)
    part.fit(windows, held_out, iterations=iterations, generator=generator)
    if isinstance(part, nn.Module):
        cause = f"what {type(part).__name__} learns before the flow has diverged; check the data"
        check_finite(module_tensors(part), cause)
