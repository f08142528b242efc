"""The presets that options start from: quick, cpu, paper and much-ado, and their forms for images."""

from __future__ import annotations

from typing import Any

from lab.options import Evaluation, Options, with_parts
from lab.tasks import DataOptions
from warmprior.modules import imagenet_weights
from warmprior.training import NetworkOptions, TrainingConfig
from warmprior.training.options import PAPER, PRETRAINED

PRESETS: dict[str, Options] = {
    # One seed, a small network and half of the training that the tables have: a first table.
    "quick": Options(data=DataOptions(demonstrations=(100,)), training=TrainingConfig(iterations=5_000)),
    # Twice the training and the episodes, three seeds.
    "cpu": Options(data=DataOptions(demonstrations=(150, 300)), evaluation=Evaluation(seeds=3, episodes=50)),
    # The paper's: 20M parameters, 200k iterations.
    "paper": Options(
        data=DataOptions(demonstrations=(200, 300)),
        network=NetworkOptions(network="chi_transformer", precondition=False),
        training=PAPER,
        evaluation=Evaluation(seeds=3, episodes=200, top_k=3),
    ),
}
# The same with the answers of the public code that the paper may stand on, Much Ado About Noising, where it
# has others (docs/notes/paper_readings.md). It clips a tenth of the loss's gradient to a norm of 10.
PRESETS["much-ado"] = with_parts(
    PRESETS["paper"],
    data={"actions": "absolute"},
    network={"observation_layers": 2, "time_frequency": 1e-4},
    training={"warmup_ratio": 0.0, "max_grad_norm": 100.0, "count_padding": True},
    evaluation={"temperature": (0.0,)},
)

# What a preset does differently where policies see images. Small images and networks, and a task that is
# solved from them: 15 minutes on two cores.
SMALL_IMAGES: dict[str, dict[str, Any]] = {
    "data": {"image_size": 48, "fast_rendering": True},
    "network": {"hidden_dim": 256, "encoder": "small", "crop_size": 42},
    "training": {"iterations": 3_000, "batch_size": 64},
}
IMAGES: dict[str, dict[str, dict[str, Any]]] = {
    "quick": {**SMALL_IMAGES, "evaluation": {"nfe": (3, 1)}},
    "cpu": SMALL_IMAGES,
    "paper": {"training": {"batch_size": 256}},
    "much-ado": {
        "data": {"actions": "delta"},  # images go with no others
        "network": {"encoder": "resnet18"},
        "training": {"batch_size": 256},
    },
}


def adapted[O: Options](preset: O, typed: Options) -> O:
    """A preset for what policies are to see.

    Where ImageNet's weights cannot be had, an encoder that would start from them starts from random ones.
    """
    if "image" not in (typed.data.obs, preset.data.obs):
        return preset
    if preset.data.obs == "state":
        changed = {part: dict(values) for part, values in IMAGES[typed.run.preset].items()}
        changed["data"] = {**changed.get("data", {}), "obs": "image"}
        if typed.run.preset == "quick" and not preset.data.task:
            changed["data"] |= {"task": ("lift",), "demonstrations": (100,)}
        preset = with_parts(preset, **changed)
    if preset.network.encoder == typed.network.encoder == PRETRAINED:
        try:
            imagenet_weights()
        except (OSError, ImportError) as error:
            print(f"{error}. The encoder starts from random weights.", flush=True)
            return with_parts(preset, network={"encoder": "resnet18"})
    return preset


def study[O: Options](kind: type[O], preset: Options, **parts: Any) -> O:
    """A preset of a study: that of the comparison, with further parts or others."""
    return kind(**vars(preset) | parts)
