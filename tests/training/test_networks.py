"""Networks of a user's own, by the place of their class."""

import pytest
from torch import nn

from tests.errors import raises
from warmprior import VelocityNetwork
from warmprior.training import NetworkOptions, make_network


class Affine(VelocityNetwork):
    """A velocity that is affine in the actions, behind a layer of a width of its own."""

    name = "affine-of-the-tests"

    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps, *, width=3):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        self.width = width
        self.layers = nn.Sequential(nn.Linear(action_dim, width), nn.Linear(width, action_dim))

    def forward(self, t, a, observation):
        self.check_shapes(a, observation)
        return self.layers(a)


class Forgetful(VelocityNetwork):
    name = "forgetful-network-of-the-tests"

    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps, width=3):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)


class Short(VelocityNetwork):
    name = "short-network-of-the-tests"

    def __init__(self, action_dim):
        self.action_dim = action_dim


class Swapped(Affine):
    name = "swapped-network-of-the-tests"

    def __init__(self, observation_dim, action_dim, prediction_length, observation_steps):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)


def test_a_network_of_ones_own_is_built_with_the_sizes_and_its_options():
    options = NetworkOptions(f"{__name__}:Affine,width=5", observation_steps=1)
    sizes = {"action_dim": 2, "prediction_length": 4, "observation_steps": 1}
    expected = {"name": "affine-of-the-tests", **sizes, "observation_dim": 3, "width": 5}
    assert make_network(options, 2, 3, 4).config() == expected
    seeing = NetworkOptions(f"{__name__}:Affine", encoder="small", crop_size=8)
    network = make_network(seeing, 2, 3, 4, {"camera": 10})  # behind an encoder of images
    inner = network.network
    assert isinstance(inner, Affine) and inner.width == 3 and inner.observation_steps == 2
    assert inner.observation_dim == network.encoder.observation_dim > 3


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("Missing", ["velocity network", "Missing"]),
        ("test_networks_that_cannot_be", ["velocity network"]),
        ("Affine,height=3", ["Affine", "height=3", "width"]),
        ("Short", ["Short", "action_dim"]),
        ("Swapped", ["Swapped", "action_dim", "(2, 3, 4, 2)"]),
        ("Forgetful", ["Forgetful", "'width'"]),  # it could not be saved
    ],
)
def test_networks_that_cannot_be(name, facts):
    with raises(ValueError, *facts):
        make_network(NetworkOptions(f"{__name__}:{name}"), 2, 3, 4)
