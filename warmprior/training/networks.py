"""The networks that options of training runs name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from warmprior.checks import given
from warmprior.modules import (
    AdaLNTransformer,
    ChiTransformer,
    ImageEncoder,
    PlainMLP,
    VelocityMLP,
    VelocityNetwork,
    VisionNetwork,
)
from warmprior.modules.encoder import load_imagenet
from warmprior.options.data import Resize
from warmprior.options.training import OF_IMAGES, PRETRAINED, NetworkOptions
from warmprior.training.option_text import find, make

_NETWORKS: dict[str, tuple[type[VelocityNetwork], str]] = {
    "mlp": (VelocityMLP, "hidden_dim"),
    "plain_mlp": (PlainMLP, "hidden_dim"),
    "chi_transformer": (ChiTransformer, "embedding_dim"),
    "adaln_transformer": (AdaLNTransformer, "embedding_dim"),
}
"""The class and the option of width of every ``Network``, a name in ``warmprior/options/training.py``."""


def own_network(options: NetworkOptions) -> type[VelocityNetwork] | None:
    """Import a user's network, and return its class; return ``None`` for others.

    A saved policy that has one is then loaded. Raises ValueError if there is no such network.
    """
    return find(VelocityNetwork, options.network.partition(",")[0]) if options.is_own else None


def make_network(
    options: NetworkOptions,
    action_dim: int,
    observation_dim: int,
    prediction_length: int,
    images: Mapping[str, int] | None = None,
    resize: Resize = "squeeze",
) -> VelocityNetwork:
    """Return a network with fresh weights for widths ``d_a`` and ``d_o`` and images' sides in pixels.

    With images, ``d_o`` is the width of the vector, and ``resize`` how the images got their size. Raises
    ValueError for options of images without any, and for a network of the user's that cannot be built.

    Examples:
        >>> import torch
        >>> from warmprior.training import NetworkOptions, make_network
        >>> options = NetworkOptions(network="chi_transformer", hidden_dim=48)
        >>> network = make_network(options, action_dim=7, observation_dim=23, prediction_length=8)
        >>> network(torch.zeros(1), torch.zeros(1, 8, 7), torch.zeros(1, options.observation_steps, 23)).shape
        torch.Size([1, 8, 7])
    """
    encoder = None
    unused = [name for name in OF_IMAGES if getattr(options, name) != getattr(NetworkOptions, name)]
    if unused and not images:
        raise ValueError(f"{', '.join(unused)} would change nothing without image keys")
    if images:
        encoder = ImageEncoder(
            list(images),
            observation_dim,
            image_size=next(iter(images.values())),
            crop_size=options.crop_size,
            backbone="small" if options.encoder == "small" else "resnet18",
            share=options.share_encoder,
            resize=resize,
        )
        if options.encoder == PRETRAINED:
            load_imagenet(encoder)
        observation_dim = encoder.observation_dim
    sizes = (action_dim, observation_dim, prediction_length, options.observation_steps)
    if options.is_own:
        network = make(VelocityNetwork, options.network, *sizes)
        network.check_sizes(*sizes)  # a constructor may take them in another order
    else:
        kind, width = _NETWORKS[options.network]
        arguments: Any = options.of_transformers | given(**{width: options.hidden_dim})
        network = kind(*sizes, **arguments)
    return network if encoder is None else VisionNetwork(encoder, network)
