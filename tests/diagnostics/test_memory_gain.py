"""Memory gain of policies whose dependence on the mean is known."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from tests.diagnostics.fields import D_A, H, batch, policy
from warmprior import (
    ForecastPrior,
    GaussianPrior,
    HistoryPrior,
    ImageEncoder,
    PastPrior,
    PreviewPrior,
    VelocityMLP,
    VisionNetwork,
    WarmPriorActor,
)
from warmprior.diagnostics import memory_gain
from warmprior.transforms import MeanObservation

N = 20_000


def windows(prior, n=50, warm=True, **extra):
    length = prior.prediction_length
    mask = torch.zeros(n, length, 1, dtype=torch.bool)
    mask[:, :H] = warm
    loc = torch.rand(n, length, D_A, generator=torch.Generator().manual_seed(2))
    found = batch(n, length).update({"prior": {"loc": loc, "warm": mask}}).update(extra)
    return MeanObservation()(found) if prior.conditions_network else found


def repeats(share):
    """One Euler step gives the share of the source; a tensor [H, 1], position by position."""
    return lambda t, a, observation: (share - 1.0) * a


@pytest.mark.parametrize("prior", [PastPrior(H, sigma=0.5), PreviewPrior(H)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0, 2.0])
def test_the_gain_is_the_share_that_is_repeated(prior, share):
    found = memory_gain(policy(repeats(share), prior), windows(prior), nfes=(1,))
    assert found == {1: pytest.approx(share, abs=1e-5)}


@pytest.mark.parametrize("nfe", [1, 3, 9])
def test_euler_steps_multiply(nfe):
    prior = PastPrior(H)
    found = memory_gain(policy(lambda t, a, o: 0.7 * a, prior), windows(prior), nfes=(nfe,))
    assert found[nfe] == pytest.approx((1 + 0.7 / nfe) ** nfe, rel=1e-4)


def test_directions_are_uniform():
    """The mean square over directions is that of the singular values."""
    prior, matrix = PastPrior(H), torch.tensor([[1.0, 2.0], [0.0, 0.5]])
    field = policy(lambda t, a, o: a @ matrix.T - a, prior)
    found = memory_gain(field, windows(prior, N), nfes=(1,))
    expected = float(torch.linalg.svdvals(matrix).square().mean().sqrt())
    assert found[1] == pytest.approx(expected, rel=0.02)


def test_any_shift_gives_the_slope_between_both_sides():
    prior = PastPrior(H, sigma=0.0)
    data = windows(prior)
    data["prior", "loc"].zero_()
    field = policy(lambda t, a, o: torch.where(a > 0, a, 0.0), prior)  # slopes 2 and 1
    for shift in (0.01, 1.0):
        assert memory_gain(field, data, nfes=(1,), shift=shift)[1] == pytest.approx(1.5, rel=1e-4)


def test_a_cold_source_has_no_memory():
    for prior in (GaussianPrior(H), PastPrior(H), PreviewPrior(H)):
        found = memory_gain(policy(repeats(0.7), prior), windows(prior, warm=False), nfes=(1, 3))
        assert found == {1: 0.0, 3: 0.0}


def test_only_executed_positions_inside_the_episode_count():
    prior = PreviewPrior(H)
    shares = torch.tensor([0.1, 0.2, 0.3, 9.0, 9.0, 9.0])[:, None]
    pad = torch.zeros(10, 2 * H, dtype=torch.bool)
    pad[0, 1:] = True
    data = windows(prior, 10, action_is_pad=pad)
    data["prior", "warm"][:] = True
    squares = [0.1**2] + 9 * [0.1**2, 0.2**2, 0.3**2]
    found = memory_gain(policy(repeats(shares), prior), data, nfes=(1,))
    assert found[1] == pytest.approx(math.sqrt(sum(squares) / len(squares)), rel=1e-4)


@pytest.mark.parametrize(("sigma", "correlation"), [(0.5, 0.0), (1.0, 0.0), (0.5, 0.5), (0.5, 1.0)])
def test_noise_lowers_the_gain_by_what_averaging_over_the_chunk_leaves(sigma, correlation):
    """Actions are one height for a chunk and for its past: E[a1 | a0] by the normal equations."""
    prior, spread = PastPrior(H, sigma=sigma, correlation=correlation), 0.3
    signal = spread**2 * torch.ones(H, H, dtype=torch.float64)
    white, common = torch.eye(H, dtype=torch.float64), torch.ones(H, H, dtype=torch.float64)
    noise = sigma**2 * ((1 - correlation) * white + correlation * common)
    best = (signal @ torch.linalg.pinv(signal + noise)).float()
    field = policy(lambda t, a, o: torch.einsum("ij,njd->nid", best, a) - a, prior)
    left = sigma**2 * (correlation + (1 - correlation) / H)
    expected = spread**2 / (spread**2 + left)
    found = memory_gain(field, windows(prior), nfes=(1,))
    assert found[1] == pytest.approx(expected, rel=1e-3)


def test_a_network_that_sees_the_mean_follows_it_as_well():
    prior = HistoryPrior(H)

    def seen(t, a, observation):
        return 0.4 * observation[:, -1, 4 : 4 + H * D_A].unflatten(-1, (H, D_A)) - a

    found = memory_gain(policy(seen, prior), windows(prior), nfes=(1,))
    assert found[1] == pytest.approx(0.4, rel=1e-4)


def test_a_network_that_sees_images_and_the_mean():
    """Against the same policy without its diagnostics: observations made anew on both sides."""
    prior, n = HistoryPrior(H), 8
    width = 4 + MeanObservation.width(prior, D_A)
    torch.manual_seed(0)
    encoder = ImageEncoder(["cam_image"], width, image_size=16, crop_size=12, backbone="small")
    network = VisionNetwork(encoder, VelocityMLP(D_A, encoder.observation_dim, H, hidden_dim=16))
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)  # the last layer begins at zero
    actor = WarmPriorActor(network, prior, nfe=1).eval()
    data = windows(GaussianPrior(H), n)
    images = torch.randint(0, 255, (n, 2, 3, 16, 16), dtype=torch.uint8)
    states = torch.randn(n, 2, 4)
    data["observation"] = TensorDict({"state": states, "cam_image": images}, [n])
    data["prior", "warm"] = torch.ones(n, H, 1, dtype=torch.bool)
    found = memory_gain(actor, MeanObservation()(data.clone()), nfes=(1,), shift=0.5)[1]

    generator = torch.Generator().manual_seed(0)
    shift = torch.nn.functional.normalize(torch.randn(n, 1, D_A, generator=generator), dim=-1) / 2
    a0 = torch.randn(n, H, D_A, generator=generator)
    chunks = []
    for sign in (1, -1):
        moved = data.clone()
        moved["prior", "loc"] += sign * shift
        moved = MeanObservation()(moved)
        with torch.no_grad():
            v = network(torch.zeros(n), a0, moved["prior", "observation"])
        chunks.append(a0 + v)
    expected = (chunks[0] - chunks[1]).square().sum(-1).mean().sqrt()
    assert found > 1e-4
    assert found == pytest.approx(float(expected), rel=1e-3)


def test_a_learned_source_is_asked_with_the_shifted_history():
    prior = ForecastPrior(H).sized(D_A, 4, 1)
    data = windows(prior)
    field = policy(lambda t, a, o: torch.zeros_like(a), prior)  # executes its source
    found = memory_gain(field, data, nfes=(1,), shift=0.05)[1]
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(50, 1, D_A, generator=generator), dim=-1)
    state, loc, warm = generator.get_state(), data["prior", "loc"], data["prior", "warm"]
    sides = []
    for sign in (1, -1):
        generator.set_state(state)
        moved = loc + sign * 0.05 * direction
        with torch.no_grad():
            sides.append(prior.sample(moved, warm, generator, data["observation"]))
    expected = float((sides[0] - sides[1]).square().sum(-1).mean().sqrt()) / 0.1
    assert found == pytest.approx(expected, rel=1e-4) and found > 0


@pytest.mark.parametrize("shift", [0.0, -1.0, math.nan, math.inf])
def test_a_shift_that_cannot_be_is_refused(shift):
    with pytest.raises(ValueError, match="shift must be a finite number > 0"):
        memory_gain(policy(repeats(1.0), PastPrior(H)), windows(PastPrior(H)), shift=shift)


def test_it_is_repeatable_and_leaves_the_policy_as_it_is():
    prior = PastPrior(H)
    field = policy(lambda t, a, o: a.sin() * o.mean((1, 2), keepdim=True), prior).train()
    data = windows(prior)
    before = data.clone()
    found = [memory_gain(field, data, nfes=(1, 3), split=size) for size in (4096, 7)]
    assert found[0] == pytest.approx(found[1])
    assert field.training and (data == before).all()
