"""Policies with known velocity fields, and batches for them."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import nn

from warmprior import GaussianPrior, ImageEncoder, VelocityMLP, VisionNetwork, WarmPriorActor

H, D_A = 3, 2


class Field(nn.Module):
    """A velocity network from a function of time, point and observation."""

    def __init__(self, function):
        super().__init__()
        self.function = function
        self.anchor = nn.Parameter(torch.zeros(()))  # gives the policy a device

    def forward(self, t, a, observation):
        return self.function(t.view(-1, 1, 1), a, observation)


def policy(function, prior=None, seed=0):
    prior = GaussianPrior(H) if prior is None else prior
    return WarmPriorActor(Field(function), prior, generator=torch.Generator().manual_seed(seed))


def batch(n=5, length=H, d_a=D_A, **extra):
    torch.manual_seed(1)
    data = TensorDict(
        {
            "observation": torch.randn(n, 1, 4),
            "prior": {
                "loc": torch.zeros(n, length, d_a),
                "warm": torch.zeros(n, length, 1, dtype=torch.bool),
            },
        },
        [n],
    )
    return data.update(extra)


def seeing_network(d_a, state_dim, length):
    """A small network that sees one camera, with weights of which none is zero."""
    torch.manual_seed(0)
    encoder = ImageEncoder(["cam_image"], state_dim, image_size=16, crop_size=12, backbone="small")
    velocity = VelocityMLP(d_a, encoder.observation_dim, length, hidden_dim=16)
    network = VisionNetwork(encoder, velocity)
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)  # the last layer begins at zero
    return network


def leftover(n=5):
    """What real-time chunking reads of the old chunk, one action of which is still played."""
    return TensorDict(
        {
            "leftover": torch.rand(n, H, D_A, generator=torch.Generator().manual_seed(4)),
            "valid": torch.ones(n, H, 1, dtype=torch.bool),
            "delay": torch.ones(n, 1, dtype=torch.int64),
        },
        [n],
    )
