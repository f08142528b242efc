import inspect
import json
import math

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torch import nn

from tests.errors import refuses
from warmprior import AdaLNTransformer, ChiTransformer, PlainMLP, VelocityMLP, VelocityNetwork
from warmprior.modules.network import TimestepEmbedding, network_observation, velocity_field
from warmprior.modules.registry import from_config


class Linear(VelocityNetwork):
    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps=2, *, k=3):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        self.k = k
        self.position = nn.Parameter(torch.zeros(1, prediction_length, action_dim))
        self.layer = nn.Linear(action_dim, action_dim)
        self.norm = nn.LayerNorm(action_dim)

    def forward(self, t, a, observation):
        self.check_shapes(a, observation)
        return self.norm(self.layer(a + self.position))


SMALL = {"hidden_dim": 12, "num_layers": 1, "num_heads": 3}


@pytest.mark.parametrize(
    "network",
    [
        Linear(2, 3, 4, k=5),
        VelocityMLP(2, 3, 4, 1, hidden_dim=16, num_blocks=2, timestep_embedding_dim=8),
        PlainMLP(2, 3, 4, 1, hidden_dim=16),
        ChiTransformer(2, 3, 4, **SMALL, dropout=0.0),
        ChiTransformer(2, 3, 4, **SMALL, observation_layers=2, time_frequency=1e-4),
        AdaLNTransformer(2, 3, 4, **SMALL),
        AdaLNTransformer(2, 3, 4, **SMALL, observation_layers=2, time_frequency=1e-4),
    ],
    ids=lambda network: type(network).__name__,
)
def test_config_survives_json(network):
    config = json.loads(json.dumps(network.config()))
    again = from_config(VelocityNetwork, config)
    assert type(again) is type(network) and again.config() == network.config()
    again.load_state_dict(network.state_dict())
    inputs = torch.rand(3), torch.randn(3, 4, 2), torch.randn(3, network.observation_steps, 3)
    assert torch.equal(network.eval()(*inputs), again.eval()(*inputs))


def test_groups_of_a_user_s_network():
    network = Linear(2, 3, 4)
    decay, rest = network.parameter_groups(0.1)
    assert decay["weight_decay"] == 0.1 and rest["weight_decay"] == 0.0
    assert [id(p) for p in decay["params"]] == [id(network.layer.weight)]
    expected = {network.position, network.layer.bias, network.norm.weight, network.norm.bias}
    assert set(rest["params"]) == expected


def test_plain_mlp_is_four_layers_by_hand():
    network = PlainMLP(2, 3, 4, 1, hidden_dim=16).double()
    t, a, observation = (torch.randn(*shape).double() for shape in ((5,), (5, 4, 2), (5, 1, 3)))
    x = torch.cat([t[:, None], a.reshape(5, 8), observation.reshape(5, 3)], 1)
    weights = list(network.parameters())
    assert len(weights) == 8  # four matrices and their biases
    for weight, bias in zip(weights[:6:2], weights[1:6:2], strict=True):
        x = x @ weight.T + bias
        x = x * (1 + torch.erf(x / math.sqrt(2))) / 2
    torch.testing.assert_close(network(t, a, observation), (x @ weights[6].T + weights[7]).reshape(5, 4, 2))


SIZES = {VelocityMLP: "hidden_dim num_blocks", PlainMLP: "hidden_dim"}
SIZES |= dict.fromkeys([AdaLNTransformer, ChiTransformer], "hidden_dim num_layers num_heads")


@pytest.mark.parametrize(
    ("kind", "size"), [(k, size) for k, names in SIZES.items() for size in names.split()]
)
@pytest.mark.parametrize("value", [0, -3, 1.5])
def test_a_size_that_cannot_work_is_named(kind, size, value):
    refuses(lambda: kind(2, 3, 4, **{size: value}), ValueError, size, value)


NUMBERS = [
    (kind, parameter.name)
    for kind in SIZES
    for parameter in inspect.signature(kind).parameters.values()
    if isinstance(parameter.default, (int, float))
]


@pytest.mark.parametrize(("kind", "option"), NUMBERS)
@pytest.mark.parametrize("value", [True, math.nan, "3", [1], -1])
def test_an_option_that_is_no_number_of_its_range_is_named(kind, option, value):
    sizes = dict.fromkeys(["action_dim", "observation_dim", "prediction_length"], 2)
    refuses(lambda: kind(**sizes | {option: value}), ValueError, option)


@pytest.mark.parametrize("dim", [4, 8, 128])
@pytest.mark.parametrize("last", [{}, {"last": 100.0}, {"last": 1e-4}, {"last": 7.0}])
def test_timestep_embedding_closed_form(dim, last):
    times, rows, half = [0.0, 0.1, 0.5, 1.0], [], dim // 2
    for t in times:
        angles = [t * last.get("last", 100.0) ** (i / (half - 1)) for i in range(half)]
        rows.append([math.sin(x) for x in angles] + [math.cos(x) for x in angles])
    found = TimestepEmbedding(dim, **last)(torch.tensor(times))
    torch.testing.assert_close(found, torch.tensor(rows), atol=2e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.bool])
def test_vectors_of_whole_numbers_are_read_as_floats(dtype):
    network, observation = VelocityMLP(2, 3, 4, hidden_dim=8), torch.randint(2, (5, 2, 3)).to(dtype)
    t, a = torch.rand(5), torch.randn(5, 4, 2)
    expected = velocity_field(network, observation.float())(t, a)
    assert torch.equal(velocity_field(network, observation)(t, a), expected)
    if dtype == torch.int64:  # an encoder of one's own reads them as they are
        network.encodes, table = True, torch.nn.Embedding(2, 1)
        network.encode = lambda observation: table(observation).squeeze(-1)
        assert velocity_field(network, observation)(t, a).shape == (5, 4, 2)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0, 3)])
def test_observations_are_flattened_whatever_dimensions_their_group_has(batch):
    rows, state = math.prod(batch), torch.randn(*batch, 2, 5)
    expected = state.reshape(rows, 2, 5)
    assert torch.equal(network_observation(state, torch.Size(batch)), expected)
    for shape in (batch, (*batch, 2)):
        group = TensorDict({"state": state}, shape)
        for seen in (group, lazy_stack(list(group.unbind(0))) if rows and shape else group):
            assert torch.equal(network_observation(seen, torch.Size(batch))["state"], expected)
