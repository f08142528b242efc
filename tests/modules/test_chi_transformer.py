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
