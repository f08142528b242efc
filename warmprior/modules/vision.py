"""A velocity network behind an encoder of images."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from warmprior.modules.encoder import ImageEncoder
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.registry import from_config

__all__ = ["VisionNetwork"]


class VisionNetwork(VelocityNetwork):
    """A velocity network that sees observations with images through an encoder.

    The encoder runs once per decision, not once per integration step: samplers and losses call :meth:`encode`
    first and pass the result on.

    Args:
        encoder: of observations; or its ``config()``.
        network: of the velocity, built for ``encoder.observation_dim``; or its ``config()``.

    Raises:
        ValueError: if the network was built for other observations.

    See Also:
        - :class:`~warmprior.ImageEncoder`: the encoder.
        - :class:`~warmprior.ChiTransformer`: a network to put behind it.
        - :class:`~warmprior.CameraImages`: renders an environment's images.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder, VelocityMLP, VisionNetwork
        >>> encoder = ImageEncoder(["agentview_image"], 9, image_size=32, crop_size=28, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(7, encoder.observation_dim, 8))
        >>> observation = TensorDict({
        ...     "state": torch.zeros(4, 2, 9),
        ...     "agentview_image": torch.zeros(4, 2, 3, 32, 32, dtype=torch.uint8),
        ... }, [4])
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
        if network.observation_dim != encoder.observation_dim:
            raise ValueError(
                f"the network was built for observation_dim={network.observation_dim}, but the encoder "
                f"gives {encoder.observation_dim}"
            )
        super().__init__(
            network.action_dim, network.observation_dim, network.prediction_length, network.observation_steps
        )
        self.encoder, self.network = encoder, network

    def encode(self, observation: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        """The encoded observation, ``[B, To, d_o]``; an encoded one is returned as it is."""
        return self.encoder(observation) if isinstance(observation, TensorDictBase) else observation

    def forward(self, t: Tensor, a: Tensor, observation: Tensor | TensorDictBase) -> Tensor:
        """Velocity ``[B, P, d_a]`` at times ``t`` ``[B]``, points ``a`` ``[B, P, d_a]``."""
        return self.network(t, a, self.encode(observation))
