"""The presets that options start from: quick, cpu, paper and much-ado, and their forms for images."""

from __future__ import annotations

from typing import Any

from lab.demonstrations.data_options import DataOptions, is_simulated
from lab.options.options import Evaluation, Options, with_parts
from warmprior.options.training import PAPER, PRETRAINED, NetworkOptions, TrainingConfig

PRESETS: dict[str, Options] = {
    # A first table: one seed, a small network and a short training, in a setting where the source matters.
    "quick": Options(
        data=DataOptions(task=("can",), demonstrations=(25,)),
        training=TrainingConfig(iterations=5_000),
        evaluation=Evaluation(episodes=30, nfe=(9, 1)),
    ),
    # Three seeds, with twice the training and the episodes.
    "cpu": Options(data=DataOptions(demonstrations=(150, 300)), evaluation=Evaluation(seeds=3, episodes=50)),
    # The paper's experiment: 20M parameters, 200k iterations.
    "paper": Options(
        data=DataOptions(demonstrations=(200, 300)),
        network=NetworkOptions(network="chi_transformer", precondition=False),
        training=PAPER,
        evaluation=Evaluation(seeds=3, episodes=200, top_k=3),
    ),
}
# The same, with the details of the public code that the paper may build on, Much Ado About Noising, where
# they differ (docs/notes/paper_readings.md). That code clips the gradient of a tenth of the loss to a norm of
# 10, so the norm here is 100.
PRESETS["much-ado"] = with_parts(
    PRESETS["paper"],
    data={"actions": "absolute"},
    network={"network": "chi_transformer,observation_layers=2,time_frequency=0.0001"},
    training={"warmup_ratio": 0.0, "max_grad_norm": 100.0, "count_padding": True},
    evaluation={"temperature": (0.0,)},
)

WHY_QUICK = (
    "Why can with 25 demonstrations: here the source matters. At one evaluation WP-Past has solved more "
    "than the Gaussian source in each training so far (docs/notes/evidence.md). In most settings the "
    "difference is smaller, and in some it is reversed (docs/which_source.md)."
)
"""What the report says of the setting of the quick preset."""

# Changes of a preset for policies that see images. Small images and networks, on a task that they solve: 15
# minutes on two cores.
SMALL_IMAGES: dict[str, dict[str, Any]] = {
    "data": {"image_size": 48, "fast_rendering": True},
    "network": {"network": "mlp,hidden_dim=256", "encoder": "small", "crop_size": 42},
    "training": {"iterations": 3_000, "batch_size": 64},
}
IMAGES: dict[str, dict[str, dict[str, Any]]] = {
    "quick": {**SMALL_IMAGES, "evaluation": {"nfe": (3, 1), "episodes": 25}},
    "cpu": SMALL_IMAGES,
    "paper": {"data": {"image_size": 84}, "training": {"batch_size": 256}},
    "much-ado": {
        "data": {"actions": "delta", "image_size": 84},  # image policies support no other actions
        "network": {"encoder": "resnet18"},
        "training": {"batch_size": 256},
    },
}


def adapted[O: Options](preset: O, typed: Options) -> O:
    """Return a preset for the demonstrations and observations that were asked for.

    A file of demonstrations names its task. If ImageNet's weights cannot be downloaded, an encoder that the
    preset starts from them starts from random weights.
    """
    if typed.data.dataset is not None and all(map(is_simulated, preset.data.task)):
        preset = with_parts(preset, data={"task": ()})
    if not (typed.data.sees_images or preset.data.sees_images):
        return preset
    if not preset.data.sees_images:
        changes = {part: dict(values) for part, values in IMAGES[typed.preset].items()}
        changes["data"] = {**changes.get("data", {}), "obs": "image"}
        if typed.preset == "quick" and preset.data.task == PRESETS["quick"].data.task:
            changes["data"] |= {"task": ("lift",), "demonstrations": (100,)}
        preset = with_parts(preset, **changes)
    if preset.network.encoder == typed.network.encoder == PRETRAINED:
        from warmprior.modules.encoder import imagenet_weights

        try:
            imagenet_weights()
        except (OSError, ImportError) as error:
            print(f"{error}. The encoder starts from random weights.", flush=True)
            return with_parts(preset, network={"encoder": "resnet18"})
    return preset


def study[O: Options](kind: type[O], preset: Options, **parts: Any) -> O:
    """Return a preset of a study: the comparison's preset with some parts replaced or added."""
    return kind(**vars(preset) | parts)
