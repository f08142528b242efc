"""The networks that options of training runs name."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import torch

from warmprior.modules import ImageEncoder, VelocityNetwork, VisionNetwork
from warmprior.modules.encoder import load_imagenet
from warmprior.options.data import Resize
from warmprior.options.training import OF_IMAGES, PRETRAINED, NetworkOptions
from warmprior.training.option_text import find, make, options_of


def network_class(options: NetworkOptions) -> type[VelocityNetwork]:
    """Return the class of the network; a user's own is imported, and saved policies with it can be loaded.

    Raises ValueError if there is no such class.
    """
    return find(VelocityNetwork, options.network.partition(",")[0])


def check_network(options: NetworkOptions) -> None:
    """Raise ValueError if there is no such network, or if it does not take its options.

    A user's own is not built, since it may need the sizes of data: only the names of its options are checked.
    """
    kind, sizes = network_class(options), (1, 1, 1, options.observation_steps)
    if kind.__module__.startswith("warmprior."):
        with torch.device("meta"):  # nothing is computed
            _make(options, *sizes)
        return
    try:
        inspect.signature(kind).bind(*sizes, **options_of(options.network))
    except TypeError as error:
        raise ValueError(f"{options.network} cannot be built: {error}") from error


def _make(options: NetworkOptions, *sizes: int) -> VelocityNetwork:
    network = make(VelocityNetwork, options.network, *sizes)
    network.check_sizes(*sizes)  # a constructor may take them in another order
    return network


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
    ValueError for options of images without any, and for a network that cannot be built.

    Examples:
        >>> import torch
        >>> from warmprior.training import NetworkOptions, make_network
        >>> options = NetworkOptions("chi_transformer,hidden_dim=48")
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
    network = _make(options, action_dim, observation_dim, prediction_length, options.observation_steps)
    return network if encoder is None else VisionNetwork(encoder, network)
