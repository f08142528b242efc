"""Policies trained by LeRobot, for :class:`warmprior.deploy.AsyncExecutor`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep
from torch import Tensor

from lerobot_policy_warmprior.modeling_warm_flow import WarmFlowPolicy
from warmprior import Normalizer, WarmPriorActor, keys
from warmprior.lerobot import LeRobotActor
from warmprior.lerobot.names import entry_names
from warmprior.modules.encoder import ImageEncoder


def load_actor(place: str | Path, *, task: str = "", device: str = "cpu") -> WarmPriorActor | LeRobotActor:
    """Load a saved policy of the plugin that acts on raw observations, in the units of the demonstrations.

    It includes the processors that LeRobot saved with it. Cameras have the last part of LeRobot's names:
    ``"front"`` for ``observation.images.front``. The ``"state"`` of a ``warm_flow`` policy is the
    concatenation of its vectors, ``observation.environment_state`` before ``observation.state``. For such a
    policy the executor takes the dataset's own names as well, and its rate alone.

    Args:
        place: a folder, such as ``run/checkpoints/last/pretrained_model``, or a repository of the hub.

    Keyword Args:
        task: the instruction, for policies that read language.
        device: device of the policy.

    Raises:
        ValueError: if a ``warm_flow`` policy has another normalisation than MIN_MAX.
    """
    config = PreTrainedConfig.from_pretrained(str(place))
    config.device = device
    policy = _policy(str(place), config).to(device).eval()
    before, after = make_pre_post_processors(
        config, pretrained_path=str(place), preprocessor_overrides={"device_processor": {"device": device}}
    )
    if isinstance(policy, WarmFlowPolicy):
        return _flow_actor(policy, before)

    def preprocess(batch: dict[str, Any]) -> dict[str, Any]:
        return before({**batch, "task": [task] * len(next(iter(batch.values())))})

    return LeRobotActor(policy, preprocess=preprocess, postprocess=after)


def _policy(place: str, config: Any) -> Any:
    """Return a saved policy; of a fine-tuning with ``--peft``, the base policy with its adapters."""
    kind = get_policy_class(config.type)
    if not config.use_peft:
        return kind.from_pretrained(place, config=config)
    from peft import PeftConfig, PeftModel

    base = PeftConfig.from_pretrained(place)
    policy: Any = kind.from_pretrained(base.base_model_name_or_path, config=config, revision=base.revision)
    return PeftModel.from_pretrained(policy, place, config=base).get_base_model()


def _flow_actor(policy: WarmFlowPolicy, preprocessor: Any) -> WarmPriorActor:
    """Return the actor of averaged weights, with LeRobot's saved extremes as its normaliser."""
    config = policy.config
    modes = {config.normalization_mapping.get(kind) for kind in ("STATE", "ENV", "ACTION")}
    if modes != {NormalizationMode.MIN_MAX}:
        raise ValueError(
            f"load_actor needs the normalisation MIN_MAX, and the policy has {config.normalization_mapping}"
        )
    stats = next(step for step in preprocessor.steps if isinstance(step, NormalizerProcessorStep)).stats
    state = (keys.OBSERVATION, keys.STATE) if config.image_features else keys.OBSERVATION
    bounds = [_bounds(stats[name]) for name in config.observed]
    low, high = (torch.cat(ends) for ends in zip(*bounds, strict=True))
    least, most = _bounds(stats[keys.ACTION])
    actor = policy.acting
    entries = {feature: name for name, feature in entry_names(config.input_features).items()}
    for part in actor.network.modules():
        if isinstance(part, ImageEncoder):
            part.cameras = tuple(entries[name] for name in part.cameras)
    normalizer = Normalizer({state: low, keys.ACTION: least}, {state: high, keys.ACTION: most})
    for key, (start, end) in {state: (low, high), keys.ACTION: (least, most)}.items():
        # As LeRobot scales, also where the range is so small that a normaliser only shifts.
        normalizer.loc(key).copy_((start + end) / 2)
        normalizer.scale(key).copy_((end - start) / 2)
    recording = actor.recording
    if recording is not None:
        names = {name: feature for feature, name in entries.items() if feature in config.image_features}
        kept = recording.sizes
        sizes = {name: kept[feature] for name, feature in names.items() if feature in kept}
        recording = replace(recording, names=names, sizes=sizes)
    return actor.replace(normalizer=normalizer, recording=recording)


def _bounds(stats: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Return minimum and maximum; constant dimensions get a range, whose low end LeRobot maps to -1."""
    low, high = (torch.as_tensor(stats[name], dtype=torch.float32).flatten() for name in ("min", "max"))
    return low, torch.where(high > low, high, low + 2.5e-5 * low.abs().clamp_min(1.0))
