"""This module says what a training of warm_flow uses of a dataset, and what it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from warmprior.keys import ACTION
from warmprior.lerobot.names import number_names, unseen_tasks
from warmprior.modules.recording import AS_RECORDED, Recording, image_words

OF_IMAGES = ("encoder", "image_size", "resize", "crop_size")
"""The options that have no effect without images."""


def check_used(config: WarmFlowConfig) -> None:
    """Raise ValueError for options of images that were changed although the policy sees none."""
    usual = {field.name: field.default for field in fields(config)}
    unused = [f"--policy.{name}" for name in OF_IMAGES if getattr(config, name) != usual[name]]
    if unused and not config.image_features:
        raise ValueError(
            f"{', '.join(unused)} would change nothing without images: leave it out, or use a dataset with "
            "cameras"
        )


def recording_of(config: WarmFlowConfig, dataset_meta: Any, episodes: Sequence[int] | None) -> Recording:
    """Return what a policy sees of a dataset's episodes (all if ``None``), and what is left out."""
    lengths, described = list(dataset_meta.episodes["length"]), dataset_meta.features
    chosen = range(len(lengths)) if episodes is None else episodes
    seen = {*config.observed, *config.image_features}
    others = [name for name in described if name.startswith("observation") and name not in seen]
    named = "tasks" in dataset_meta.episodes.column_names  # LeRobot trains without them
    tasks = dataset_meta.episodes["tasks"] if named else [None] * len(lengths)
    left_out = {"input_features": others, "": unseen_tasks(tasks[number] for number in chosen)}
    numbers = {name: number_names(described[name]) for name in (*config.observed, ACTION)}
    meaning = f", absolute targets of {config.joints}" if config.joints not in ("", "auto") else AS_RECORDED
    sized = config.image_size, config.resize
    return Recording(
        dataset_meta.repo_id,
        len(chosen),
        sum(lengths[number] for number in chosen),
        f"[{config.action_feature.shape[0]}]{meaning}",
        {name: config.input_features[name].shape[0] for name in config.observed},
        {name: image_words(entry.shape[1:], *sized) for name, entry in config.image_features.items()},
        left_out={taken_by: names for taken_by, names in left_out.items() if names},
        rate=dataset_meta.fps,
        numbers={name: names for name, names in numbers.items() if names},
        sizes={name: entry.shape[1:] for name, entry in config.image_features.items()},
    )
