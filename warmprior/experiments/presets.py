"""Budgets that a comparison of sources starts from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from warmprior.experiments.recipe import (
    GENERATED,
    PRETRAINED,
    DataOptions,
    EvaluationOptions,
    NetworkOptions,
    Recipe,
)
from warmprior.modules import imagenet_weights
from warmprior.training.training_config import TrainingConfig

__all__ = ["PRESETS", "comparison_preset"]

# Chosen from success against iterations on square (docs/evidence.md, "Training budget"). Half the batch at
# twice the iterations is as good.
_SMALL = TrainingConfig(
    iterations=10_000,
    batch_size=128,
    learning_rate=1e-3,
    warmup_ratio=0.1,
    checkpoints=1,
    weighting="standardised",
)

PRESETS: dict[str, Recipe] = {
    # One seed, small network: a first table within 15 minutes on two cores.
    "quick": Recipe(
        data=DataOptions(demonstrations=(GENERATED,)),
        network=NetworkOptions(hidden_dim=384),
        training=_SMALL,
    ),
    # The same policies with three seeds and twice the episodes: a table with seeds.
    "cpu": Recipe(
        data=DataOptions(demonstrations=(150, 300)),
        network=NetworkOptions(hidden_dim=384),
        training=_SMALL,
        evaluation=EvaluationOptions(seeds=3, episodes=50),
    ),
    # The paper's (Table 4): 20M parameters, 200k iterations.
    "paper": Recipe(
        data=DataOptions(demonstrations=(200, 300)),
        network=NetworkOptions(network="chi_transformer", precondition=False),
        evaluation=EvaluationOptions(seeds=3, episodes=200, top_k=3),
    ),
}
"""Budgets of comparisons of sources."""

_IMAGES: dict[str, dict[str, dict[str, Any]]] = {
    # Small images and networks, on a task that is solved from them: 15 minutes on two cores.
    "quick": {
        "data": {
            "task": ("lift",),
            "demonstrations": (100,),
            "image_size": 48,
            "fast_rendering": True,
        },
        "network": {"hidden_dim": 256, "encoder": "small", "crop_size": 42},
        "training": {"iterations": 3_000, "batch_size": 64},
        "evaluation": {"nfe": (3, 1)},
    },
    "cpu": {
        "data": {"image_size": 48, "fast_rendering": True},
        "network": {"hidden_dim": 256, "encoder": "small", "crop_size": 42},
        "training": {"iterations": 3_000, "batch_size": 64},
    },
    "paper": {"training": {"batch_size": 256}},
}
"""What a preset does differently where policies see images."""


def comparison_preset(asked: Recipe, presets: Mapping[str, Recipe] | None = None) -> Recipe:
    """The preset that is asked for, for what policies are to see.

    Where ImageNet's weights cannot be had, an encoder that would start from them starts from random ones.

    Args:
        asked: names both.
        presets: by name; :data:`PRESETS` by default.

    See Also:
        - :data:`~warmprior.experiments.PRESETS`: the budgets.
        - :func:`~warmprior.experiments.parse`: applies the other options to it.

    Examples:
        >>> comparison_preset(Recipe(data=DataOptions(obs="image"))).network.encoder
        'small'
    """
    preset = (PRESETS if presets is None else presets)[asked.run.preset]
    if "image" not in (asked.data.obs, preset.data.obs):
        return preset
    if preset.data.obs == "state":
        changed = {part: dict(values) for part, values in _IMAGES[asked.run.preset].items()}
        data = changed.setdefault("data", {})
        if preset.data.task:  # it is of certain demonstrations
            data = {name: v for name, v in data.items() if name not in ("task", "demonstrations")}
        changed["data"] = data | {"obs": "image"}
        made = {part: replace(getattr(preset, part), **values) for part, values in changed.items()}
        preset = replace(preset, **made)
    if preset.network.encoder == asked.network.encoder == PRETRAINED:
        try:
            imagenet_weights()
        except (OSError, ImportError) as error:
            print(f"{error}. The encoder starts from random weights.", flush=True)
            return replace(preset, network=replace(preset.network, encoder="resnet18"))
    return preset
