"""GR00T's processors, extended by the remembered actions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.policies.groot.processor_groot import GrootN17PackInputsStep, make_groot_pre_post_processors
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import POLICY_PREPROCESSOR_DEFAULT_NAME
from torch.nn.functional import pad

from lerobot_policy_warmprior.configuration_warm_groot import WarmGrootConfig
from lerobot_policy_warmprior.loading import saved_json
from warmprior.lerobot.adapter import HISTORY, HISTORY_IS_PAD

DATA, PAD = TransitionKey.COMPLEMENTARY_DATA, "action_is_pad"
STEP = "warm_groot_pack_inputs"


@dataclass
@ProcessorStepRegistry.register(STEP)
class WarmGrootPackInputsStep(GrootN17PackInputsStep):
    """Packs the chunk as GR00T does, and the actions before it under a key of their own."""

    history_length: int = 0

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the packed transition, with ``action_history`` if it has actions.

        Raises:
            ValueError: if the checkpoint's actions are relative, with statistics per position.
        """
        if self._uses_relative_action_groups():
            raise ValueError(
                "this checkpoint of GR00T has relative actions, and remembered ones cannot be expressed at "
                "the next state: choose an embodiment_tag whose actions are absolute"
            )
        window, data = transition.get(TransitionKey.ACTION), transition.get(DATA) or {}
        if window is None:
            return super().__call__(transition)
        length, width = self.history_length, window.shape[-1]
        # Step by step, because GR00T blanks a chunk's steps past the embodiment's horizon.
        steps = {TransitionKey.ACTION: window[:, :length].flatten(0, 1)}
        past = super().__call__(steps)[TransitionKey.ACTION][:, 0, :width]
        more: dict[str, Any] = {HISTORY: past.unflatten(0, (-1, length))}
        if PAD in data:
            more[HISTORY_IS_PAD], data[PAD] = data[PAD][:, :length], data[PAD][:, length:]
        transition[TransitionKey.ACTION] = window[:, length:]
        packed = super().__call__(transition)
        if PAD in data:  # a chunk shorter than the model's is padded, and so is its mask
            longer = packed[TransitionKey.ACTION].shape[1] - data[PAD].shape[1]
            more[PAD] = pad(torch.as_tensor(data[PAD]), (0, longer), value=True)
        packed[DATA] |= more
        return packed

    def get_config(self) -> dict[str, Any]:
        """Return the arguments that are saved."""
        return super().get_config() | {"history_length": self.history_length}


def make_warm_groot_pre_post_processors(
    config: WarmGrootConfig, dataset_stats: Any = None, dataset_meta: Any = None
) -> tuple[Any, Any]:
    """Make GR00T's processors, with a packing step for the remembered actions."""
    before, after = make_groot_pre_post_processors(config, dataset_stats, dataset_meta)
    (at,) = (i for i, step in enumerate(before.steps) if isinstance(step, GrootN17PackInputsStep))
    arguments = {f.name: getattr(before.steps[at], f.name) for f in fields(before.steps[at]) if f.init}
    pack = WarmGrootPackInputsStep(**arguments, history_length=config.make_prior().history_length)
    before.steps[at] = pack
    for step in after.steps:  # it decodes by the packed state
        if hasattr(step, "pack_step"):
            step.pack_step = pack
    return before, after


def check_pretrained(config: WarmGrootConfig, place: str, **hub: Any) -> None:
    """Check the processors of a saved policy, which LeRobot reuses.

    ``hub`` has options of the download, such as ``revision``.

    Raises:
        ValueError: if they are GR00T's own, or remember another number of actions.
    """
    # GR00T's own checkpoints have no such step.
    steps = saved_json(place, f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", **hub).get("steps", [])
    packs = [step["config"]["history_length"] for step in steps if step.get("registry_name") == STEP]
    length = config.make_prior().history_length
    if not packs:
        raise ValueError(
            f"{place} is no policy of warm_groot: give a checkpoint of GR00T as --policy.base_model_path"
        )
    if packs != [length]:
        raise ValueError(
            f"{place} remembers {packs[0]} actions, and prior={config.prior!r} {length}: keep its "
            "--policy.prior and --policy.prior_chunk, or start from --policy.base_model_path"
        )
