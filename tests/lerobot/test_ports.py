"""Losses and chunks of LeRobot's own classes against flow matching written by hand."""

import pytest
import torch

from tests.errors import raises, refuses
from tests.lerobot.seen import at_times, watch
from tests.lerobot.tiny import ACTION, LENGTH, MAKERS, N15, STEPS, observations, width, windows
from warmprior import GaussianPrior, PastPrior
from warmprior.lerobot import WarmPriorAdapter
from warmprior.lerobot.ports import port_for

FAMILIES = list(MAKERS)
NOISE_AT_ONE = ("smolvla", "pi0", "pi05", "xvla")
"""Families whose time runs from data to noise."""


def lead(family):
    return 1 if family == "multi_task_dit" else 0


def adapter_of(family, policy, sigma=0.0, seed=0):
    prior = PastPrior(LENGTH - lead(family), sigma=sigma)
    return WarmPriorAdapter(policy, prior, generator=torch.Generator().manual_seed(seed))


def training_window(family, size=3):
    """A batch, and by hand its history and target ``[size, *, ACTION]``."""
    history = LENGTH - lead(family)
    batch = windows(family, size, history, lead(family))
    if family == "groot":
        return batch, batch["action_history"], batch["action"][..., :ACTION]
    return batch, batch["action"][:, :history], batch["action"][:, -LENGTH:]


@pytest.mark.parametrize("family", FAMILIES)
def test_shapes(family, policy):
    port, made = port_for(policy(family)), policy(family)
    assert port.length(made) == LENGTH
    assert port.width(made) == width(family)
    assert port.lead(made) == lead(family)
    last = LENGTH - lead(family)  # H before the current step, and what the chunk has from there on
    assert adapter_of(family, made).action_indices == list(range(-last, last))


@pytest.mark.parametrize("family", [f for f in FAMILIES if f != "xvla"])
def test_the_loss_is_that_of_flow_matching_from_this_source(family, policy):
    made = policy(family).train()
    batch, history, target = training_window(family)
    t = torch.tensor([0.2, 0.5, 0.9])
    with watch(family, made) as seen, at_times(family, made, t):
        loss, _ = adapter_of(family, made).loss(batch)
    (x,), (velocity,) = seen.x, seen.out
    positions = slice(lead(family), None)
    # Sigma is 0: on the action's dimensions of the warm positions the source is the history itself.
    time = t[:, None, None]
    to_data = (1 - time) if family in NOISE_AT_ONE else time
    a1 = target[:, positions]
    expected = to_data * a1 + (1 - to_data) * history
    torch.testing.assert_close(x[:, positions, :ACTION], expected)
    # What is not the prior's is standard normal noise, which the network's input tells.
    full = torch.zeros_like(x)
    full[..., :ACTION] = target
    a0 = (x - to_data * full) / (1 - to_data)
    direction = (a0 - full) if family in NOISE_AT_ONE else (full - a0)
    by_hand = (velocity - direction)[..., :ACTION].square().mean()
    torch.testing.assert_close(loss, by_hand, rtol=1e-4, atol=1e-5)


def test_the_loss_of_xvla_is_that_of_its_denoiser(policy):
    made = policy("xvla").train()
    batch, history, target = training_window("xvla")
    with watch("xvla", made) as seen:
        loss, _ = adapter_of("xvla", made).loss(batch)
    (x,), (predicted,), (t,) = seen.x, seen.out, seen.t
    time = t[:, None, None]
    torch.testing.assert_close(x[..., :ACTION], time * history + (1 - time) * target)
    by_hand = (predicted[..., :ACTION] - target).square().mean()
    torch.testing.assert_close(loss, by_hand)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_chunk_is_integrated_from_this_source(family, policy):
    made = policy(family)
    adapter = adapter_of(family, made)
    start = observations(family, 2)
    if family == "multi_task_dit":  # it stacks by itself
        start["observation.state"] = start["observation.state"][:, -1]
        executed = torch.stack([adapter.select_action(dict(start)) for _ in range(8)], 1)
        made.reset()  # its queue alone: the next call decides
        with watch(family, made) as seen:
            adapter.select_action(dict(start))
        expected = executed[:, -(LENGTH - 1) :]
    else:
        executed = adapter.predict_action_chunk(dict(start))
        with watch(family, made) as seen:
            chunk = adapter.predict_action_chunk(dict(start), executed_steps=LENGTH)
        expected = executed
    positions = slice(lead(family), None)
    assert len(seen.x) == STEPS
    torch.testing.assert_close(seen.x[0][:, positions, :ACTION], expected)
    if family == "xvla":  # its source is mixed in anew at each step
        for step, x in enumerate(seen.x[1:], start=1):
            t = 1 - step / STEPS
            mixed = t * seen.x[0] + (1 - t) * seen.out[step - 1]
            torch.testing.assert_close(x, mixed)
        torch.testing.assert_close(chunk, seen.out[-1][..., :ACTION])
        return
    sign = -1 if family in NOISE_AT_ONE else 1
    path = [seen.x[0]]
    for velocity in seen.out:
        path.append(path[-1] + sign * velocity / STEPS)
    for x, by_hand in zip(seen.x, path, strict=False):
        torch.testing.assert_close(x, by_hand, rtol=1e-4, atol=1e-5)
    if family != "multi_task_dit":
        end = path[-1][..., :ACTION]
        if family == "groot" and not N15:  # its postprocessors clamp what is executed
            assert end.abs().max() > 1
            end = end.clamp(-1, 1)
        torch.testing.assert_close(chunk, end, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
def test_cold_chunks_and_padding_are_standard_normal(family, policy):
    """The policy's own noise and the adapter's have the same distribution: that of the first chunk."""
    made = policy(family)
    start = observations(family, 64)
    port = port_for(made)
    adapter = adapter_of(family, made)
    given = []

    def source(shape, dtype, device):
        given.append(adapter._source(shape, dtype, device))
        return given[-1]

    with port.sampling(made, source, lambda chunk: None, 1):
        port.predict(made, start)
    (a0,) = given
    assert a0.shape == (64, LENGTH, width(family))
    for part in (a0[..., :ACTION], a0[..., ACTION:]):
        if part.numel():
            assert abs(part.mean()) < 4 / part.numel() ** 0.5
            assert abs(part.std() - 1) < 3 / part.numel() ** 0.5


@pytest.mark.parametrize("family", FAMILIES)
def test_a_policy_is_left_as_it_was(family, policy):
    made = policy(family)
    before = [set(vars(part)) for part in made.modules()]
    batch, *_ = training_window(family)
    adapter = adapter_of(family, made)
    adapter.loss(batch)
    with port_for(made).sampling(made, adapter._source, adapter._record, 1):
        port_for(made).predict(made, observations(family, 2))
    assert [set(vars(part)) for part in made.modules()] == before
    # Its own noise again: two chunks differ.
    chunks = []
    for _ in range(2):
        with port_for(made).sampling(made, lambda s, dtype, device: torch.randn(s), chunks.append, None):
            port_for(made).predict(made, observations(family, 2))
    assert not torch.equal(*chunks)


class Other:
    name = "act"


class Pi0:
    name, config = "pi0", None


def test_what_is_not_supported(policy, monkeypatch):
    refuses(lambda: port_for(Other()), ValueError, "Other", "smolvla")
    refuses(lambda: port_for(policy("smolvla", adapt_to_pi_aloha=True)), ValueError, "adapt_to_pi_aloha")
    with raises(ValueError, "objective='diffusion'"):
        WarmPriorAdapter(policy("multi_task_dit", objective="diffusion"), GaussianPrior(4))
    for release in ("0.7.0", "0.5.10"):
        monkeypatch.setattr("warmprior.lerobot.ports.version", lambda name, release=release: release)
        refuses(lambda: port_for(Pi0()), ImportError, release, "0.6: pi0", "0.5.1: groot")
