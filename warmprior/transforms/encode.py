"""Features of a frozen policy's encoder in place of images."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDictBase
from tensordict.utils import unravel_key
from torchrl.data import Composite, Unbounded

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import encoded, network_observation
from warmprior.transforms.inner_step import EnvTransform

__all__ = ["EncodeObservation"]


class EncodeObservation(EnvTransform):
    """Writes the features ``[*B, To, d_o]`` that a frozen policy's encoder extracts from images.

    Agents in the policy's source space and their critics read the features, so the encoder runs once per
    decision and replay buffers hold vectors. The policy behind the agent reads them too:
    ``actor.replace(observation_key=keys.FEATURES)``. Append it after :func:`policy_transforms`, and outside
    batched environments: inside, every worker would hold a copy of the encoder.

    Args:
        actor: the policy; its network is copied and stays as it is.

    Raises:
        ValueError: if the network has no encoder (:attr:`VelocityNetwork.encodes`).
        KeyError: if the environment lacks the policy's observation.

    Examples:
        >>> from warmprior import EncodeObservation
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder, PastPrior, VelocityMLP, VisionNetwork, WarmPriorActor
        >>> encoder = ImageEncoder(["cam"], 3, image_size=32, crop_size=28, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(2, encoder.observation_dim, 4))
        >>> transform = EncodeObservation(WarmPriorActor(network, PastPrior(4)))
        >>> images = torch.zeros(5, 2, 3, 32, 32, dtype=torch.uint8)
        >>> data = TensorDict({"observation": {"state": torch.zeros(5, 2, 3), "cam": images}}, [5])
        >>> transform(data)["features"].shape
        torch.Size([5, 2, 67])
    """

    def __init__(self, actor: WarmPriorActor) -> None:
        observation_key = unravel_key(actor.in_keys[0])
        super().__init__(in_keys=[observation_key], out_keys=[keys.FEATURES])
        if not getattr(actor.network, "encodes", False):
            raise ValueError(
                f"{type(actor.network).__name__} takes observations as they are: there is nothing to encode"
            )
        self.network = copy.deepcopy(actor.network).eval().requires_grad_(False)

    def train(self, mode: bool = True) -> EncodeObservation:
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the features."""
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None:
            raise KeyError(f"EncodeObservation found no {self.in_keys[0]!r}")
        batch, device = tensordict.batch_size, next(self.network.parameters()).device
        seen = network_observation(observation, batch)
        features = encoded(self.network, seen.to(device))
        assert isinstance(features, torch.Tensor)
        features = features.reshape(*batch, *features.shape[1:])
        return tensordict.set(self.out_keys[0], features.to(tensordict.device or device))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the features."""
        network = self.network
        shape = (*observation_spec.shape, network.observation_steps, network.observation_dim)
        device = observation_spec.device
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=device)
        return observation_spec
