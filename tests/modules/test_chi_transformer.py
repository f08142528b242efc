"""ChiTransformer: what each action may see, its parameters and its errors."""

from __future__ import annotations

import pytest
import torch

from warmprior import ChiTransformer
from warmprior.training.optim import make_optimizer


def tiny(length=4, steps=2, **options):
    torch.manual_seed(0)
    options = {"embedding_dim": 24, "num_layers": 2, "num_heads": 3, **options}
    return ChiTransformer(2, 3, length, steps, **options).eval()


@pytest.mark.parametrize("length", [1, 8])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_first_action_sees_every_observation(length, steps):
    network = tiny(length, steps)
    o = torch.randn(1, steps, 3, requires_grad=True)
    out = network(torch.tensor([0.3]), torch.randn(1, length, 2), o)
    out[0, 0].square().sum().backward()
    assert (o.grad[0].abs().sum(-1) > 1e-8).all()  # the current one is the last


def test_every_action_sees_time_and_the_current_observation():
    network = tiny(8)
    t, o = torch.tensor([0.3]), torch.randn(1, 2, 3)
    a = torch.randn(1, 8, 2)
    base = network(t, a, o)
    moved = o.clone()
    moved[:, -1] += 1.0
    assert ((network(t, a, moved) - base).abs().amax(-1) > 1e-6).all()
    assert ((network(t + 0.2, a, o) - base).abs().amax(-1) > 1e-6).all()


def test_later_actions_do_not_influence_earlier_ones():
    network = tiny(6)
    t, a, o = torch.tensor([0.3]), torch.randn(1, 6, 2), torch.randn(1, 2, 3)
    base = network(t, a, o)
    for changed in range(6):
        moved = a.clone()
        moved[:, changed] += 1.0
        difference = (network(t, moved, o) - base).abs().amax(-1)[0]
        assert (difference[:changed] == 0).all()
        assert (difference[changed:] > 1e-6).all()


def test_training_mode_is_causal_too():
    """The fast path of evaluation and the path with gradients use the same masks."""
    network = tiny(6, dropout=0.0).train()
    a = torch.randn(1, 6, 2, requires_grad=True)
    out = network(torch.tensor([0.3]), a, torch.randn(1, 2, 3))
    for position in range(6):
        (gradient,) = torch.autograd.grad(out[0, position].sum(), a, retain_graph=True)
        assert (gradient[0, position + 1 :] == 0).all()
        assert (gradient[0, : position + 1].abs().sum(-1) > 0).all()


def count(d_a, d_o, length, steps, width, layers, t_dim):
    """Parameters of the architecture, written down layer by layer."""

    def linear(n, m):
        return n * m + m

    attention = linear(width, 3 * width) + linear(width, width)
    feed_forward = linear(width, 4 * width) + linear(4 * width, width)
    layer = 2 * attention + feed_forward + 3 * 2 * width
    return (
        linear(t_dim, width)
        + linear(d_a, width)
        + linear(d_o, width)
        + length * width
        + (1 + steps) * width
        + feed_forward  # the memory's encoder has the same two layers
        + layers * layer
        + 2 * width
        + linear(width, d_a)
    )


@pytest.mark.parametrize(
    ("sizes", "options"),
    [
        ((7, 23, 8, 2), {}),
        ((14, 59, 16, 2), {}),
        ((2, 3, 4, 1), {"embedding_dim": 24, "num_layers": 3, "num_heads": 2}),
    ],
)
def test_parameter_count(sizes, options):
    network = ChiTransformer(*sizes, **options)
    width, layers = options.get("embedding_dim", 384), options.get("num_layers", 8)
    assert sum(p.numel() for p in network.parameters()) == count(*sizes, width, layers, 128)


def test_every_parameter_is_in_exactly_one_group():
    network = tiny()
    optimizer = make_optimizer(network, weight_decay=0.1)
    seen = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert len(seen) == len(set(seen))
    assert set(seen) == {id(p) for p in network.parameters()}


def test_only_matrices_decay():
    network = tiny()
    decay, rest = network.parameter_groups(0.1)
    names = {id(p): name for name, p in network.named_parameters()}
    decayed = {names[id(p)] for p in decay["params"]}
    kept = {names[id(p)] for p in rest["params"]}
    assert all(name.endswith("weight") for name in decayed)
    assert not any("norm" in name for name in decayed)
    assert {"action_position", "memory_position", "head.0.weight", "head.1.bias"} <= kept
    assert "decoder.layers.0.self_attn.in_proj_weight" in decayed


def test_every_parameter_gets_a_gradient():
    network = tiny().train()
    out = network(torch.rand(3), torch.randn(3, 4, 2), torch.randn(3, 2, 3))
    out.square().sum().backward()
    without = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert not without


def test_evaluation_is_deterministic_and_training_is_not():
    network = tiny(dropout=0.5)
    inputs = torch.rand(3), torch.randn(3, 4, 2), torch.randn(3, 2, 3)
    assert torch.equal(network(*inputs), network(*inputs))
    network.train()
    assert not torch.equal(network(*inputs), network(*inputs))


def test_layers_start_differently():
    network = tiny()
    first, second = (layer.linear1.weight for layer in network.decoder.layers)
    assert not torch.equal(first, second)


@pytest.mark.parametrize("shape", [(3, 8, 2), (3, 3, 2), (3, 4, 7)])
def test_wrong_chunk(shape):
    with pytest.raises(ValueError, match=r"ChiTransformer was built for chunks .* \(4, 2\)"):
        tiny()(torch.rand(3), torch.randn(shape), torch.randn(3, 2, 3))


@pytest.mark.parametrize("shape", [(3, 1, 3), (3, 2, 5)])
def test_wrong_observation(shape):
    with pytest.raises(ValueError, match=r"observations .* \(2, 3\)"):
        tiny()(torch.rand(3), torch.randn(3, 4, 2), torch.randn(shape))


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="num_heads must divide embedding_dim, got 5 and 24"):
        tiny(num_heads=5)


@pytest.mark.parametrize("training", [False, True])
def test_modulation_starts_as_the_paper_s_network(training):
    """With the same weights it is the same function, until the modulation learns."""
    plain = tiny(6, dropout=0.0).train(training)
    modulated = tiny(6, dropout=0.0, time_modulation=True).train(training)
    missing = modulated.load_state_dict(plain.state_dict(), strict=False)
    assert not missing.unexpected_keys
    assert all("modulation" in key for key in missing.missing_keys)
    t, a, o = torch.rand(5), torch.randn(5, 6, 2), torch.randn(5, 2, 3)
    torch.testing.assert_close(modulated(t, a, o), plain(t, a, o))
    plain(t, a, o).sum().backward()
    modulated(t, a, o).sum().backward()
    for name, parameter in plain.named_parameters():
        torch.testing.assert_close(parameter.grad, modulated.get_parameter(name).grad)


def test_modulated_layer_by_hand():
    """Scale, shift and gate of both sub-layers, from the time token alone, with numbers of their own."""
    layer = tiny(3, dropout=0.0, time_modulation=True).decoder.layers[0]
    with torch.no_grad():
        layer.modulation.weight.normal_(std=0.2)
    x, memory = torch.randn(2, 3, 24), torch.randn(2, 3, 24)
    mask = torch.nn.Transformer.generate_square_subsequent_mask(3)
    m = memory[:, :1] @ layer.modulation.weight.T + layer.modulation.bias
    scale, shift, gate, scale_2, shift_2, gate_2 = m.split(24, dim=-1)
    inner = layer.norm1(x) * (1 + scale) + shift
    expected = x + (1 + gate) * layer.self_attn(inner, inner, inner, attn_mask=mask)[0]
    expected = expected + layer.multihead_attn(layer.norm2(expected), memory, memory)[0]
    inner = layer.norm3(expected) * (1 + scale_2) + shift_2
    fed = layer.linear2(torch.nn.functional.gelu(layer.linear1(inner)))
    torch.testing.assert_close(layer(x, memory, tgt_mask=mask), expected + (1 + gate_2) * fed)


def test_modulated_network_is_causal_and_sees_the_time():
    network = tiny(6, dropout=0.0, time_modulation=True).train()
    with torch.no_grad():
        for layer in network.decoder.layers:
            layer.modulation.weight.normal_(std=0.1)
    a, t = torch.randn(1, 6, 2, requires_grad=True), torch.tensor([0.3], requires_grad=True)
    out = network(t, a, torch.randn(1, 2, 3))
    for position in range(6):
        gradient, time = torch.autograd.grad(out[0, position].sum(), (a, t), retain_graph=True)
        assert (gradient[0, position + 1 :] == 0).all() and time.abs() > 1e-6
        assert (gradient[0, : position + 1].abs().sum(-1) > 0).all()
