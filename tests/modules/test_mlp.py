import pytest
import torch

from tests.errors import raises
from tests.toy_env import stirred
from warmprior import VelocityMLP


def test_modulation_starts_from_no_effect():
    torch.manual_seed(0)
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    a, o = torch.randn(1, 4, 2).expand(5, 4, 2), torch.randn(1, 2, 3).expand(5, 2, 3)
    velocity = network(torch.linspace(0, 1, 5), a, o)
    torch.testing.assert_close(velocity, velocity[:1].expand_as(velocity))
    velocity = stirred(network)(torch.linspace(0, 1, 5), a, o)
    assert (velocity.diff(dim=0).abs() > 1e-4).flatten(1).any(1).all()


def test_every_input_matters():
    torch.manual_seed(0)
    network = stirred(VelocityMLP(2, 3, 4, hidden_dim=16))
    inputs = [torch.randn(1, *shape, requires_grad=True) for shape in ((), (4, 2), (2, 3))]
    network(*inputs).square().sum().backward()
    assert all((value.grad.abs() > 0).all() for value in inputs)


def test_blocks_by_hand():
    """Adaptive layer norm: x + f(scale norm(x) + shift), with numbers of its own."""
    torch.manual_seed(0)
    network = stirred(VelocityMLP(2, 3, 4, hidden_dim=16, num_blocks=1))
    block, time, x = network.blocks[0], torch.randn(5, 32), torch.randn(5, 16)
    scale, shift = (time @ m.weight.T + m.bias for m in (block.scale, block.shift))
    norm = (x - x.mean(1, keepdim=True)) / (x.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    torch.testing.assert_close(block(x, time), x + block.layers(norm * scale + shift))


@pytest.mark.parametrize("shape", [(5, 3, 2), (5, 4, 3), (5, 8)])
def test_wrong_chunk(shape):
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    with raises(ValueError, "VelocityMLP", "(4, 2)"):
        network(torch.rand(5), torch.randn(shape), torch.randn(5, 2, 3))
