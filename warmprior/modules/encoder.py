"""Encoders of observations with images, and velocity networks that use them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from http.client import HTTPException
from pickle import UnpicklingError
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ConvNet

from warmprior import keys
from warmprior.checks import (
    check_between,
    check_choice,
    check_distinct,
    check_keys,
    check_shape,
    check_whole_numbers,
)
from warmprior.io.extras import require
from warmprior.io.files import as_json
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.registry import from_config, kept_arguments
from warmprior.options.data import IMAGE_SIZE, IMAGE_SIZES, Resize

Backbone = Literal["resnet18", "small"]

_CHANNEL_MEAN = (0.485, 0.456, 0.406)
_CHANNEL_DEVIATION = (0.229, 0.224, 0.225)
"""The statistics of ImageNet's pixels in [0, 1], which its weights expect."""

_SMALL_FEATURES = 64

_CROPPED = 76 / IMAGE_SIZE
"""The share of an image's side that its crop has in the paper (Table 3)."""


def _resnet18() -> tuple[nn.Module, int]:
    torchvision: Any = require("torchvision.models", "vision")
    # As in Diffusion Policy: the running statistics of batch norm do not fit averaged weights.
    network = torchvision.resnet18(norm_layer=lambda width: nn.GroupNorm(width // 16, width))
    width = network.fc.in_features
    network.fc = nn.Identity()
    return network, width


def _small(crop_size: int) -> tuple[nn.Module, int]:
    side = math.ceil(crop_size / 8)  # every convolution halves it, and rounds up
    convolutions = ConvNet(
        in_features=3, num_cells=[32, 64, 64], strides=2, paddings=1, activation_class=nn.ReLU
    )
    # This keeps the positions of features, which pooling would lose at this size.
    return nn.Sequential(convolutions, nn.Linear(64 * side * side, _SMALL_FEATURES)), _SMALL_FEATURES


class ImageEncoder(nn.Module):
    """An encoder of images and a vector into one vector per observation step.

    Every camera has its own network, ResNet-18 with group norm as in the paper (Table 3), whose features are
    appended to the vector. In training mode it sees a random crop of the image, the same one for all ``To``
    images of a camera and drawn by PyTorch's global generator; otherwise the central one. Pixels are scaled
    by ImageNet's statistics.

    Args:
        cameras: names of the images in the observation.
        state_dim: width of the observation's vector ``"state"``; 0 if there is none.
        image_size: side of the images in pixels.
        crop_size: side of the crop in pixels; by default 76 of 84, in proportion, but at least 8.
        backbone: ``"resnet18"``, or ``"small"``: three convolutions and a linear layer, for small budgets.
        share: True uses one network for all cameras.
        resize: how cameras' images of another size were resized, and are on a robot, see
            :func:`~warmprior.modules.resize.resized`.

    Raises:
        ValueError: if there are no cameras, one is named twice, or an option is out of range.
        ImportError: if the backbone is ResNet-18 and torchvision is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder
        >>> encoder = ImageEncoder(["agentview_image"], 9, image_size=32, crop_size=28, backbone="small")
        >>> images = torch.zeros(4, 2, 3, 32, 32, dtype=torch.uint8)
        >>> observation = TensorDict({"state": torch.zeros(4, 2, 9), "agentview_image": images}, [4])
        >>> encoder(observation).shape, encoder.observation_dim
        (torch.Size([4, 2, 73]), 73)
    """

    def __init__(
        self,
        cameras: Sequence[str],
        state_dim: int,
        *,
        image_size: int = IMAGE_SIZE,
        crop_size: int | None = None,
        backbone: Backbone = "resnet18",
        share: bool = False,
        resize: Resize = "squeeze",
    ) -> None:
        super().__init__()
        cameras = tuple(cameras)
        check_distinct("cameras of an image encoder", cameras)
        check_whole_numbers(0, state_dim=state_dim)
        check_whole_numbers(image_size=image_size)
        check_between(*IMAGE_SIZES, image_size=image_size)
        crop_size = max(IMAGE_SIZES[0], round(_CROPPED * image_size)) if crop_size is None else crop_size
        check_between(IMAGE_SIZES[0], image_size, crop_size=crop_size)
        check_choice("backbone", backbone, get_args(Backbone))
        check_choice("resize", resize, get_args(Resize))
        self.cameras, self.state_dim = cameras, state_dim
        self.image_size, self.crop_size = image_size, crop_size
        self.backbone, self.share, self.resize = backbone, share, resize
        made = [
            _resnet18() if backbone == "resnet18" else _small(crop_size)
            for _ in (cameras[:1] if share else cameras)
        ]
        self.networks = nn.ModuleList(network for network, _ in made)
        #: Width of what :meth:`forward` returns.
        self.observation_dim = state_dim + len(cameras) * made[0][1]
        statistics = torch.tensor([_CHANNEL_MEAN, _CHANNEL_DEVIATION]).view(2, 3, 1, 1)
        self._mean, self._deviation = (nn.Buffer(values, persistent=False) for values in statistics)

    def config(self) -> dict[str, Any]:
        """Return the constructor arguments as JSON holds them."""
        return as_json(kept_arguments(self))

    def forward(self, observation: TensorDictBase) -> Tensor:
        """Return the vector followed by the cameras' features in order, ``[*B, To, observation_dim]``.

        The observation ``[*B]`` has ``"state"`` ``[*B, To, state_dim]`` and images uint8
        ``[*B, To, 3, image_size, image_size]`` under the names of the cameras.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if an entry has another shape, or an image is not uint8.
        """
        self._check(observation)
        parts = [observation[keys.STATE]] if self.state_dim else []
        dtype = next(self.networks.parameters()).dtype
        for number, camera in enumerate(self.cameras):
            images = observation[camera]
            *batch, _, _, _ = images.shape
            pixels = self._cropped(images.flatten(0, -5) if len(batch) > 1 else images[None])
            pixels = pixels.flatten(0, 1).to(dtype) / 255
            network = self.networks[0 if self.share else number]
            parts.append(network((pixels - self._mean) / self._deviation).unflatten(0, batch))
        return torch.cat(parts, -1)

    def _cropped(self, images: Tensor) -> Tensor:
        """Return crops of images ``[B, To, 3, h, w]``."""
        size, room = self.crop_size, self.image_size - self.crop_size
        if not self.training:
            return images[..., room // 2 : room // 2 + size, room // 2 : room // 2 + size]
        if room == 0:
            return images
        number = torch.arange(len(images), device=images.device)
        top, left = torch.randint(room + 1, (2, len(images)), device=images.device)
        return images.unfold(-2, size, 1).unfold(-2, size, 1)[number, :, :, top, left]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of one step's entries, in the order in which they are encoded."""
        vector: dict[str, tuple[int, ...]] = {keys.STATE: (self.state_dim,)} if self.state_dim else {}
        return vector | dict.fromkeys(self.cameras, (3, self.image_size, self.image_size))

    def _check(self, observation: TensorDictBase) -> None:
        shapes = self.shapes
        check_keys(observation, shapes, "the encoder", f"; there are {sorted(map(str, observation.keys()))}")
        for name, shape in shapes.items():
            value = observation[name]
            batch = value.shape[: value.ndim - len(shape)]
            check_shape(name, value, (*batch, *shape))
            if name in self.cameras and value.dtype != torch.uint8:
                raise ValueError(f"the image {name!r} is {value.dtype}, and the encoder takes uint8")


def imagenet_weights() -> dict[str, Tensor]:
    """Return ImageNet's weights for ResNet-18, which torchvision downloads once.

    Raises:
        OSError: if the weights are not stored here and cannot be downloaded, or the stored file is damaged.
        ImportError: if torchvision is missing.

    Examples:
        >>> from warmprior.modules import imagenet_weights
        >>> imagenet_weights()["conv1.weight"].shape  # doctest: +SKIP
        torch.Size([64, 3, 7, 7])
    """
    torchvision: Any = require("torchvision.models", "vision")
    weights = torchvision.ResNet18_Weights.IMAGENET1K_V1
    try:
        # weights_only, because a pickled file could hold code, which would run.
        return weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
    # Raised for an interrupted or wrong download, and a stored file that is cut, empty or no weights.
    except (OSError, HTTPException, RuntimeError, UnpicklingError, EOFError) as error:
        reason = str(error).partition("\n")[0].rstrip(". ") or type(error).__name__
        raise OSError(
            f"ImageNet's weights of ResNet-18 cannot be loaded ({reason}): connect once, put an intact "
            f"{weights.url.rpartition('/')[2]} into {torch.hub.get_dir()}/checkpoints, or start from random "
            "weights (encoder='resnet18')"
        ) from error


def load_imagenet(encoder: ImageEncoder) -> None:
    """Load ImageNet's weights into the ResNets of an encoder, in place; group norm keeps its initial values.

    Raises:
        ValueError: if the encoder has another backbone.
        OSError: see :func:`imagenet_weights`.

    Examples:
        >>> from warmprior import ImageEncoder
        >>> from warmprior.modules import load_imagenet
        >>> load_imagenet(ImageEncoder(["agentview_image"], 9, backbone="small"))
        Traceback (most recent call last):
            ...
        ValueError: ImageNet's weights are for resnet18, not for 'small'
    """
    if encoder.backbone != "resnet18":
        raise ValueError(f"ImageNet's weights are for resnet18, not for {encoder.backbone!r}")
    weights = imagenet_weights()
    for network in encoder.networks:
        state = network.state_dict()
        # Convolutions only: batch norm's weights have the same names as group norm's.
        convolutions = {name: weights[name] for name in state if state[name].ndim == 4}
        network.load_state_dict(state | convolutions)


class VisionNetwork(VelocityNetwork):
    """A velocity network that sees observations with images through an encoder.

    The encoder runs once per decision, not once per integration step: samplers and losses call :meth:`encode`
    first and pass the result on.

    Args:
        encoder: encoder of observations, or its ``config()``.
        network: velocity network, built for ``encoder.observation_dim``, or its ``config()``.

    Raises:
        ValueError: if the network was built for observations of another width.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder, VelocityMLP, VisionNetwork
        >>> encoder = ImageEncoder(["agentview_image"], 9, image_size=32, crop_size=28, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(7, encoder.observation_dim, 8))
        >>> images = torch.zeros(4, 2, 3, 32, 32, dtype=torch.uint8)
        >>> observation = TensorDict({"state": torch.zeros(4, 2, 9), "agentview_image": images}, [4])
        >>> network(torch.rand(4), torch.randn(4, 8, 7), observation).shape
        torch.Size([4, 8, 7])
    """

    encodes = True

    def __init__(
        self, encoder: ImageEncoder | dict[str, Any], network: VelocityNetwork | dict[str, Any]
    ) -> None:
        if isinstance(encoder, dict):
            encoder = ImageEncoder(**encoder)
        if isinstance(network, dict):
            network = from_config(VelocityNetwork, network)
        if (read := network.observation_dim) != (made := encoder.observation_dim):
            raise ValueError(f"the network has observation_dim={read}, but the encoder {made}")
        super().__init__(
            network.action_dim, network.observation_dim, network.prediction_length, network.observation_steps
        )
        self.encoder, self.network = encoder, network

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """Return the encoded observation ``[B, To, d_o]``; an encoded one is returned unchanged."""
        return self.encoder(observation) if isinstance(observation, TensorDictBase) else observation

    def forward(self, t: Tensor, a: Tensor, observation: Tensor | TensorDictBase) -> Tensor:
        """Return the velocity ``[B, P, d_a]`` at times ``t`` ``[B]`` and points ``a`` ``[B, P, d_a]``."""
        return self.network(t, a, self.encode(observation))
