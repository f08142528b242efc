"""The transformers: what each action may see, and the modulated one beside a reference by hand."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from warmprior import AdaLNTransformer, ChiTransformer


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


def modulated(length=4, steps=2, **options):
    torch.manual_seed(0)
    network = AdaLNTransformer(2, 3, length, steps, embedding_dim=24, num_layers=2, num_heads=3, **options)
    return network.eval()


def stirred(network):
    """The same with modulations that do something, as after a training."""
    for block in network.blocks:
        nn.init.normal_(block.modulate.weight, std=0.3)
        nn.init.normal_(block.modulate.bias, std=0.3)
    return network


def test_modulation_starts_without_effect():
    network, a = modulated(), torch.randn(5, 4, 2)
    expected = network.head(network.embed_action(a) + network.action_position)
    for _ in range(3):
        torch.testing.assert_close(network(torch.rand(5), a, torch.randn(5, 2, 3)), expected)


def test_modulated_block_beside_pytorch_s_attention():
    block = stirred(modulated()).blocks[0]
    x, condition = torch.randn(5, 4, 24), torch.randn(5, 24)
    shift, scale, gate, shift2, scale2, gate2 = block.modulate(condition).unsqueeze(1).chunk(6, -1)
    attention = nn.MultiheadAttention(24, 3, batch_first=True)
    attention.load_state_dict(
        {
            "in_proj_weight": block.qkv.weight,
            "in_proj_bias": block.qkv.bias,
            "out_proj.weight": block.project.weight,
            "out_proj.bias": block.project.bias,
        }
    )

    def norm(x):
        return (x - x.mean(-1, keepdim=True)) / (x.var(-1, correction=0, keepdim=True) + 1e-5).sqrt()

    seen = norm(x) * (1 + scale) + shift
    y = x + gate * attention(seen, seen, seen)[0]
    up, _, down = block.feed_forward
    hidden = up(norm(y) * (1 + scale2) + shift2)
    hidden = 0.5 * hidden * (1 + torch.tanh((2 / torch.pi) ** 0.5 * (hidden + 0.044715 * hidden**3)))
    expected = y + gate2 * down(hidden)
    torch.testing.assert_close(block(x, condition), expected, atol=1e-5, rtol=1e-5)


def test_every_action_sees_every_other_the_observations_and_the_time():
    network = stirred(modulated())
    t, a, o = torch.tensor([0.3]), torch.randn(1, 4, 2), torch.randn(1, 2, 3)
    inputs = [value.requires_grad_() for value in (t, a, o)]
    out = network(*inputs)
    for position in range(4):
        for gradient in torch.autograd.grad(out[0, position].sum(), inputs, retain_graph=True):
            assert (gradient.reshape(-1, *gradient.shape[2:]).abs() > 0).all()


@pytest.mark.parametrize("kind", [AdaLNTransformer, ChiTransformer])
def test_heads_divide_the_width(kind):
    with pytest.raises(ValueError, match="num_heads must divide embedding_dim, got 5 and 24"):
        kind(2, 3, 4, embedding_dim=24, num_heads=5)
