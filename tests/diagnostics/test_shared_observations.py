"""Observations shared by policies of different priors, against a loop over the data."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.diagnostics.fields import policy
from tests.errors import raises, refuses
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import SharedObservations

H = 3


def steps(lengths, d_a=1):
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    numbers = torch.arange(float(len(episode)))[:, None]
    data = {"observation": numbers.repeat(1, 4), "action": numbers.repeat(1, d_a), "episode": episode}
    return TensorDict(data, episode.shape)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_frames_are_those_with_a_full_history(lengths, horizon):
    expected, start = [], 0
    for length in lengths:
        expected += list(range(start + horizon, start + length))
        start += length
    shared = SharedObservations(steps(lengths), horizon)
    assert shared.frames.tolist() == expected
    assert len(shared) == len(expected)


def test_windows_hold_the_same_observations_and_each_priors_own_history():
    data = steps([10, 3, 8])
    shared = SharedObservations(data, H)
    frames = shared.frames
    past = shared.windows(PastPrior(H))
    assert (past["history", "steps"] == H).all()
    expected = frames[:, None] + torch.arange(-H, 0)
    assert torch.equal(past["history", "actions"][..., 0], expected.float())
    preview = shared.windows(PreviewPrior(H))
    base = shared.windows(GaussianPrior(H))
    assert torch.equal(preview["history", "forecast"][:, :H, 0], preview["vla_action", "chunk"][:, :H, 0])
    assert not base["history", "forecast_steps"].any()
    for windows in (past, preview, base):
        assert torch.equal(windows["observation"][:, 0, 0], frames.float())
    assert torch.equal(shared.windows(PastPrior(H), offset=2)["observation"][:, 0, 0], frames - 2.0)
    part = shared.subset(torch.tensor([1, 4]))
    assert torch.equal(part.windows(GaussianPrior(H))["observation"], base["observation"][[1, 4]])
    assert torch.equal(part.episodes, data["episode"][frames[[1, 4]]])


def test_the_deployed_mean_is_the_policys_own_prediction():
    """A field that carries every source to the number of the observation's step plus 0, 1, 2, ..."""
    prior = PreviewPrior(H)

    def field(t, a, observation):
        goal = observation[:, -1:, :1] + torch.arange(2.0 * H).view(1, -1, 1)
        return (goal - a) / (1 - t).clamp_min(1e-6)

    shared = SharedObservations(steps([12, 9]), H)
    actor = policy(field, prior)
    deployed = shared.deployed(actor)
    # Predicted H steps earlier, the chunk's second half forecasts exactly the current one.
    expected = shared.frames[:, None] + torch.arange(H)
    torch.testing.assert_close(deployed["history", "forecast"][:, :H, 0], expected.float(), atol=1e-4, rtol=0)
    assert (deployed["history", "steps"] == H).all()
    assert torch.equal(deployed["vla_action", "chunk"], shared.windows(prior)["vla_action", "chunk"])


def test_bad_input_is_named():
    data = steps([5, 4])
    refuses(lambda: SharedObservations(data, H).windows(PastPrior(H + 1)), ValueError, "chunk length")
    for offset in (-1, H + 1):
        with raises(ValueError, "offset", 0, H):
            SharedObservations(data, H).windows(PastPrior(H), offset=offset)
    refuses(lambda: SharedObservations(data.exclude("episode"), H), KeyError, "episode")
