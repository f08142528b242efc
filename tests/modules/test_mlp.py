"""VelocityMLP: shapes, its residual form and its errors."""

from __future__ import annotations

import pytest
import torch

from warmprior import VelocityMLP


@pytest.mark.parametrize(
    ("action", "observation", "length", "steps"), [(1, 1, 1, 1), (7, 23, 16, 3)]
)
def test_shapes(action, observation, length, steps):
    network = VelocityMLP(action, observation, length, steps, hidden_dim=16)
    out = network(torch.rand(5), torch.randn(5, length, action), torch.randn(5, steps, observation))
    assert out.shape == (5, length, action)


def test_predicts_a_residual():
    """With zeroed output weights the velocity is exactly minus the point."""
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    with torch.no_grad():
        network.head[-1].weight.zero_()
        network.head[-1].bias.zero_()
    a = torch.randn(5, 4, 2)
    assert torch.equal(network(torch.rand(5), a, torch.randn(5, 2, 3)), -a)


def test_every_input_matters():
    torch.manual_seed(0)
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    t, a, o = torch.rand(1), torch.randn(1, 4, 2), torch.randn(1, 2, 3)
    for value in (t, a, o):
        value.requires_grad_()
    network(t, a, o).square().sum().backward()
    for value in (t, a, o):
        assert (value.grad.abs() > 0).all()


@pytest.mark.parametrize("blocks", [0, 1, 3])
def test_parameter_count(blocks):
    h, dim = 24, 8
    chunk, observation = 4 * 2, 2 * 3
    network = VelocityMLP(2, 3, 4, 2, hidden_dim=h, num_blocks=blocks, timestep_embedding_dim=dim)
    expected = (chunk + dim) * h + h  # chunk and time
    expected += observation * h + h + h * h + h  # observation encoder
    expected += blocks * (2 * h + 2 * (h * h + h))  # norm and two layers
    expected += 2 * h + h * chunk + chunk  # head
    assert sum(p.numel() for p in network.parameters()) == expected


@pytest.mark.parametrize("shape", [(5, 3, 2), (5, 4, 3), (5, 8)])
def test_wrong_chunk(shape):
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    with pytest.raises(ValueError, match=r"VelocityMLP was built for chunks .* \(4, 2\), got"):
        network(torch.rand(5), torch.randn(shape), torch.randn(5, 2, 3))


@pytest.mark.parametrize("shape", [(5, 1, 3), (5, 2, 4), (5, 3)])
def test_wrong_observation(shape):
    network = VelocityMLP(2, 3, 4, hidden_dim=16)
    with pytest.raises(ValueError, match=r"built for observations .* \(2, 3\), got"):
        network(torch.rand(5), torch.randn(5, 4, 2), torch.randn(shape))
