"""ChiTransformer: what each action may see, its parameters and its errors."""

from __future__ import annotations

import pytest
import torch

from warmprior import ChiTransformer


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
