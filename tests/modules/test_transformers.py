"""The transformers: what each action may see, and the modulated one beside a reference by hand."""

import math

import pytest
import torch
from torch import nn
from torch.nn import functional

from tests.errors import raises
from tests.toy_env import stirred
from warmprior import AdaLNTransformer, ChiTransformer


def tiny(length=4, steps=2, kind=ChiTransformer, **options):
    torch.manual_seed(0)
    return kind(2, 3, length, steps, hidden_dim=24, num_layers=2, num_heads=3, **options).eval()


@pytest.mark.parametrize("length", [1, 8])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_first_action_sees_every_observation(length, steps):
    network = tiny(length, steps)
    o = torch.randn(1, steps, 3, requires_grad=True)
    out = network(torch.tensor([0.3]), torch.randn(1, length, 2), o)
    out[0, 0].square().sum().backward()
    assert (o.grad[0].abs().sum(-1) > 1e-8).all()  # the current one is the last


@pytest.mark.parametrize("trains", [False, True])
def test_later_actions_do_not_influence_earlier_ones(trains):
    """In training and at decisions, where PyTorch may take a faster path."""
    network = tiny(6, dropout=0.0).train(trains)
    t, a, o = torch.tensor([0.3]), torch.randn(1, 6, 2), torch.randn(1, 2, 3)
    with torch.set_grad_enabled(trains):
        base = network(t, a, o)
        for changed in range(6):
            moved = a.clone()
            moved[:, changed] += 1.0
            difference = (network(t, moved, o) - base).abs().amax(-1)[0]
            assert (difference[:changed] == 0).all()
            assert (difference[changed:] > 1e-6).all()


def modulated(**options):
    return tiny(kind=AdaLNTransformer, **options)


def test_modulation_starts_without_effect():
    network, a = modulated(), torch.randn(5, 4, 2)
    expected = network.head(network.embed_action(a) + network.action_position)
    for _ in range(3):
        torch.testing.assert_close(network(torch.rand(5), a, torch.randn(5, 2, 3)), expected)


def test_modulated_block_beside_pytorch_s_attention():
    block = stirred(modulated(), by=0.3).blocks[0]
    x, condition = torch.randn(5, 4, 24), torch.randn(5, 24)
    shift, scale, gate, shift2, scale2, gate2 = block.modulate(condition).unsqueeze(1).chunk(6, -1)
    attention = nn.MultiheadAttention(24, 3, batch_first=True)
    attention.in_proj_weight, attention.in_proj_bias = block.qkv.weight, block.qkv.bias
    attention.out_proj = block.project
    seen = functional.layer_norm(x, [24]) * (1 + scale) + shift
    y = x + gate * attention(seen, seen, seen)[0]
    up, _, down = block.feed_forward
    hidden = up(functional.layer_norm(y, [24]) * (1 + scale2) + shift2)
    expected = y + gate2 * down(functional.gelu(hidden, approximate="tanh"))
    torch.testing.assert_close(block(x, condition), expected, atol=1e-5, rtol=1e-5)


def test_every_action_sees_every_other_the_observations_and_the_time():
    network = stirred(modulated(), by=0.3)
    t, a, o = torch.tensor([0.3]), torch.randn(1, 4, 2), torch.randn(1, 2, 3)
    inputs = [value.requires_grad_() for value in (t, a, o)]
    out = network(*inputs)
    for position in range(4):
        for gradient in torch.autograd.grad(out[0, position].sum(), inputs, retain_graph=True):
            assert (gradient.reshape(-1, *gradient.shape[2:]).abs() > 0).all()


def by_hand(part, x):
    (first, *rest) = [layer for layer in part.modules() if isinstance(layer, nn.Linear)]
    x = x @ first.weight.T + first.bias
    for layer in rest:
        x = (x * (1 + torch.erf(x / math.sqrt(2))) / 2) @ layer.weight.T + layer.bias
    return x


LAYERS = pytest.mark.parametrize("layers", [None, 0, 1, 2])


def options_of(layers):
    return {} if layers is None else {"observation_layers": layers}


@LAYERS
def test_observation_tokens_by_hand(layers):
    """Without hidden layers a token is of its own step; with some it is of all of them."""
    network = tiny(4, 3, **options_of(layers))
    matrices = [p for p in network.embed_observation.parameters() if p.ndim == 2]
    o, t, seen = torch.randn(5, 3, 3), torch.rand(5), []
    if layers:
        assert [tuple(p.shape) for p in matrices] == [(24, 9), *[(24, 24)] * (layers - 1), (72, 24)]
        tokens = by_hand(network.embed_observation, o.reshape(5, 9)).reshape(5, 3, 24)
    else:
        assert [tuple(p.shape) for p in matrices] == [(24, 3)]
        tokens = by_hand(network.embed_observation, o)
    memory = torch.cat([network.embed_time(t)[:, None], tokens], 1) + network.memory_position
    network.encoder.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    network(t, torch.randn(5, 4, 2), o)
    torch.testing.assert_close(seen[0], memory)


@LAYERS
def test_the_modulation_reads_the_observations_through_so_many_layers(layers):
    network = modulated(**options_of(layers))
    matrices = [p for p in network.embed_observation.parameters() if p.ndim == 2]
    assert len(matrices) == 1 + (1 if layers is None else layers)
    o, t, seen = torch.randn(5, 2, 3), torch.rand(5), []
    condition = network.embed_time(t) + by_hand(network.embed_observation, o.reshape(5, 6))
    network.blocks[0].modulate.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    network(t, torch.randn(5, 4, 2), o)
    torch.testing.assert_close(seen[0], condition * torch.sigmoid(condition))


@pytest.mark.parametrize("make", [tiny, modulated])
@pytest.mark.parametrize("options", [{}, {"time_frequency": 1e-4}])
def test_the_time_has_the_frequencies_of_the_option(make, options):
    found = make(**options).embed_time[0].frequencies
    assert found[[0, -1]].tolist() == pytest.approx([1.0, options.get("time_frequency", 100.0)])


@pytest.mark.parametrize("kind", [AdaLNTransformer, ChiTransformer])
def test_options_out_of_range(kind):
    with raises(ValueError, "num_heads", "hidden_dim", 5, 24):
        kind(2, 3, 4, hidden_dim=24, num_heads=5)
    for name, values in {"observation_layers": (-1, 1.5), "time_frequency": (0.0, math.inf)}.items():
        for value in values:
            with raises(ValueError, name, value):
                kind(2, 3, 4, **{name: value})
