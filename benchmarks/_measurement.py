"""Options and data of measurements on held-out observations."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from warmprior.data import RobomimicExperienceReplay
from warmprior.diagnostics import SharedObservations
from warmprior.modules import Normalizer
from warmprior.training.demonstrations import Demonstrations
from warmprior.training.policies import task_of


def add_observation_options(parser: argparse.ArgumentParser, *, observations: int) -> None:
    """Add the options that say what to measure on."""
    add = parser.add_argument
    add(
        "--validation",
        type=Path,
        help="robomimic HDF5 file of held-out demonstrations (default: newly generated ones)",
    )
    add(
        "--observations",
        type=int,
        default=observations,
        help="held-out observations to measure on (%(default)s; the paper's curvature: 2000)",
    )


def add_options(parser: argparse.ArgumentParser, *, observations: int) -> None:
    """Add the options of curvature on held-out observations."""
    add_observation_options(parser, observations=observations)
    add = parser.add_argument
    add("--steps", type=int, default=100, help="Euler steps (%(default)s, the paper's)")
    add("--draws", type=int, default=1, help="source samples per observation (%(default)s)")


def check(args: argparse.Namespace) -> None:
    """Refuse options that cannot work, before anything is generated or trained."""
    for option, least in (("observations", 1), ("steps", 2), ("draws", 1)):
        if getattr(args, option, least) < least:
            raise ValueError(f"--{option} must be at least {least}, got {getattr(args, option)}")
    if args.validation is not None and not args.validation.is_file():
        raise FileNotFoundError(f"--validation {args.validation}: no such file")


def held_out(
    args: argparse.Namespace, meta: Mapping[str, Any], chunk_length: int
) -> tuple[Demonstrations, str]:
    """The demonstrations to measure on, and what they are in words."""
    if args.validation is not None:
        found = Demonstrations(args.validation, "file", meta["style"])
        if found.sha256 == meta["data"]["sha256"]:
            return found, "the TRAINING demonstrations (not held out)"
        return found, f"{args.validation.name}"
    if meta["data_source"] != "scripted":
        raise ValueError(
            "these policies are trained on all demonstrations of "
            f"{meta['data']['file']}: add --validation FILE with others (or with the same file, to "
            "measure on the training data)"
        )
    # As many as the training demonstrations suggest, with room to spare.
    mean_steps = meta["data"]["steps"] / meta["data"]["demonstrations"]
    usable = max(1.0, min(50.0, 0.8 * (mean_steps - chunk_length)))
    n = max(20, int(-(-args.observations // usable)))
    found = Demonstrations.held_out(meta["task"], meta["style"], n)
    return found, f"{n} newly generated demonstrations"


def observe(
    args: argparse.Namespace,
    meta: Mapping[str, Any],
    normalizer: Normalizer,
    *,
    chunk_length: int,
    observation_steps: int,
) -> tuple[SharedObservations, str]:
    """Draw the observations, normalised as the policies are trained, and say what they are."""
    demonstrations, source = held_out(args, meta, chunk_length)
    dataset = RobomimicExperienceReplay(demonstrations.path)
    if task_of(dataset) != meta["task"]:
        raise ValueError(
            f"--validation {args.validation} holds demonstrations of {task_of(dataset)}, but these "
            f"policies are for {meta['task']}"
        )
    # A copy: the data are normalised on the CPU, the policy may live elsewhere.
    normalizer = copy.deepcopy(normalizer).to("cpu")
    observations = SharedObservations(
        normalizer.normalize(dataset.data.exclude("next")).to(args.device),
        chunk_length,
        observation_steps=observation_steps,
        count=args.observations,
        generator=torch.Generator().manual_seed(0),
    )
    return observations, source
