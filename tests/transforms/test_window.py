"""Training windows against loops in plain Python and against TorchRL's own sequence sampler."""

import logging
import warnings

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage

from tests.errors import raises, refuses
from warmprior import (
    ActionWindow,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    WithheldHistory,
    window_replay_buffer,
    window_transforms,
)
from warmprior.checks import check_finite_steps


def steps(lengths, numbers=None):
    numbers = range(len(lengths)) if numbers is None else numbers
    rows = [(e, i) for e, n in zip(numbers, lengths, strict=True) for i in range(n)]
    code = torch.tensor([100.0 * e + i + 1 for e, i in rows])
    return TensorDict(
        {
            "observation": torch.stack([code, -code, code / 7], -1),
            "action": torch.stack([code / 1000, torch.sin(code)], -1),
            "episode": torch.tensor([e for e, _ in rows]),
        },
        [len(rows)],
    )


def reference(data, window, i):
    """Section 3 for one step, with Python's own lists."""
    episode = data["episode"].tolist()
    inside = [j for j in range(len(data)) if episode[j] == episode[i]]
    first, last = inside[0], inside[-1]
    seen, remembered, length = window.observation_steps, window.history_length, window.prediction_length
    known = length - window.chunk_length
    action = data["action"]
    shown = {k: v for k, v in data.items(True, True) if str(k).strip("('").startswith("observation")}
    target = [action[min(j, last)] for j in range(i, i + length)]
    before = [action[j] if j >= first else torch.zeros(2) for j in range(i - remembered, i)]
    forecast = target[:known] + [torch.zeros(2)] * window.chunk_length  # nothing else of the target
    return {
        **{k: torch.stack([v[max(i - n, first)] for n in reversed(range(seen))]) for k, v in shown.items()},
        ("vla_action", "chunk"): torch.stack(target),
        "action_is_pad": torch.tensor([j > last for j in range(i, i + length)]),
        ("history", "actions"): torch.stack(before),
        ("history", "steps"): torch.tensor([min(i - first, remembered)]),
        ("history", "forecast"): torch.stack(forecast),
        ("history", "forecast_steps"): torch.tensor([known]),
    }


def check(batch, data, window):
    for row in batch:
        for key, expected in reference(data, window, int(row["frame"])).items():
            assert row[key].dtype == expected.dtype and torch.equal(row[key], expected), key


def held(data, place):
    """The same in memory, memory-mapped, or with images among the observations."""
    if place == "memory":
        return data
    vector = data["observation"]
    images = (vector[:, :, None, None] % 251).abs().to(torch.uint8).expand(-1, 3, 2, 2)
    seen = TensorDict({"state": vector, "camera": images.contiguous()}, [len(data)])
    data = data.copy().set("observation", seen)
    return data if place == "images" else data.memmap()


class Sized(GaussianPrior):
    """A prior of any lengths."""

    name = "sized-of-the-tests"
    prediction_length = history_length = 0

    def __init__(self, chunk_length, prediction_length, history_length):
        super().__init__(chunk_length)
        self.prediction_length, self.history_length = prediction_length, history_length


def every_step(data):
    return TensorDict({"frame": torch.arange(len(data))}, [len(data)])


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 17), min_size=1, max_size=6),
    horizon=st.integers(1, 8),
    further=st.integers(0, 8),
    longer=st.integers(0, 3),
    observation_steps=st.integers(1, 4),
    numbers=st.permutations(range(6)),
    place=st.sampled_from(["memory", "images", "memory-mapped"]),
)
def test_random_episodes(lengths, horizon, further, longer, observation_steps, numbers, place):
    data = held(steps(lengths, numbers[: len(lengths)]), place)
    sizes = {"prediction_length": horizon + further, "history_length": horizon + longer}
    window = ActionWindow(data, horizon, observation_steps=observation_steps, **sizes)
    check(batch := window(every_step(data)), data, window)
    buffer = window_replay_buffer(
        data, Sized(horizon, **sizes), batch_size=5, observation_steps=observation_steps
    )
    assert (buffer[: len(data)] == batch).all()


@pytest.mark.parametrize("place", ["memory", "images", "memory-mapped"])
def test_a_buffer_of_ones_own_samples_the_same(place):
    data, prior = held(steps([9, 20, 3]), place), PreviewPrior(3)
    options = {"batch_size": 16, "writer": ImmutableDatasetWriter()}
    transforms = window_transforms(data, prior, withhold=0.5, generator=torch.Generator().manual_seed(1))
    own = TensorDictReplayBuffer(
        storage=TensorStorage(every_step(data)),
        transform=transforms,
        generator=torch.Generator().manual_seed(0),
        **options,
    )
    ours = window_replay_buffer(data, prior, batch_size=16, generator=torch.Generator().manual_seed(0))
    ours.append_transform(WithheldHistory(0.5, generator=torch.Generator().manual_seed(1)))
    for _ in range(3):
        one, two = own.sample(), ours.sample()
        assert set(one.keys(True, True)) == set(two.keys(True, True)) and (one == two).all()
        assert one.device == two.device


def test_steps_are_read_in_any_shape_and_by_any_index():
    data, prior = steps([9, 20, 3]), PreviewPrior(3)
    window, buffer = (
        ActionWindow(data, 3, prediction_length=6),
        window_replay_buffer(data, prior, batch_size=4),
    )
    whole = window(every_step(data))
    for index in (3, -1, slice(2, 9, 3), torch.tensor([5, -2]), [4, 1]):
        assert (buffer[index] == whole[index]).all()
    frames = torch.randint(32, (2, 3, 5))
    for dtype in (torch.int32, torch.int64):
        batch = window(TensorDict({"frame": frames.to(dtype)}, frames.shape))
        assert (
            batch["frame"].dtype == dtype and (batch.exclude("frame") == whole[frames].exclude("frame")).all()
        )
    kept = TensorDict(
        {"frame": torch.tensor([[3], [4]]), "observation": torch.ones(2), "mine": torch.ones(2)}, [2]
    )
    batch = window(kept)
    assert batch is kept and torch.equal(batch["mine"], torch.ones(2)) and batch["frame"].shape == (2, 1)
    assert torch.equal(batch["observation"], whole["observation"][3:5])
    for wrong in (-1, 32):
        with raises(IndexError, "'frame'", wrong, "0 to 31"):
            window(TensorDict({"frame": torch.tensor([3, wrong])}, [2]))


def test_episodes_that_are_too_short_for_a_warm_source_are_named():
    """The field would be trained from cold sources alone, and meet warm ones where it acts."""
    with pytest.warns(UserWarning, match="more than 4 steps.*never warm") as warned:
        warnings.simplefilter("default")
        window_replay_buffer(steps([3, 4]), PastPrior(4), batch_size=2)
        window_replay_buffer(steps([3, 4]), PastPrior(4), batch_size=3)  # as a training's second one
    assert len(warned) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert window_replay_buffer(steps([3, 5]), PastPrior(4), batch_size=2)
        assert window_replay_buffer(steps([3, 4]), PreviewPrior(4), batch_size=2)


def test_a_buffer_says_nothing_where_a_script_prints(caplog, monkeypatch):
    """TorchRL writes there which transforms have lost what held them."""
    monkeypatch.setattr(logging.getLogger("torchrl"), "propagate", True)
    window_replay_buffer(steps([20]), PastPrior(2), batch_size=4, see_history=True, withhold=0.5).sample()
    assert not caplog.messages


def test_without_withholding_nothing_is_drawn_but_the_steps():
    """The generator's stream is that of Algorithm 1."""
    streams = []
    for withhold in (0.0, 0.5):
        generator = torch.Generator().manual_seed(0)
        options = {"batch_size": 9, "withhold": withhold, "generator": generator}
        frames = window_replay_buffer(steps([20]), PastPrior(2), **options).sample()["frame"]
        streams.append((frames, generator.get_state()))
    frames = torch.randint(0, 20, (9,), generator=(g := torch.Generator().manual_seed(0)))
    assert torch.equal(streams[0][0], frames) and torch.equal(streams[0][1], g.get_state())
    assert not torch.equal(streams[1][1], g.get_state())


def test_withholding_takes_whole_histories():
    """Of a share of the windows, all four entries; targets and observations stay."""
    data, share = steps([60] * 5), 0.25
    generator = torch.Generator().manual_seed(0)
    buffer = window_replay_buffer(
        data, PreviewPrior(4), batch_size=10_000, withhold=share, generator=generator
    )
    batch, window = buffer.sample(), ActionWindow(data, 4, prediction_length=8)
    cold = batch["history", "forecast_steps"].squeeze(-1) == 0
    assert all(not value[cold].any() for value in batch["history"].values())
    assert abs(cold.float().mean() - share) < 0.025  # five standard errors
    check(batch[~cold][:300], data, window)
    twin = window(batch[cold].select("frame"))
    assert torch.equal(batch["vla_action", "chunk"][cold], twin["vla_action", "chunk"])
    assert torch.equal(batch["observation"][cold], twin["observation"])


def test_data_that_cannot_be():
    data, folded = steps([3, 4]), steps([3, 3]).reshape(2, 3)
    pieces = data.clone().set("episode", torch.tensor([0, 0, 1, 1, 0, 2, 2]))
    for wrong, error, fact in (
        (data.exclude("action"), KeyError, "'action'"),
        (pieces, ValueError, "episode 0"),
        (data[:0], ValueError, "[N]"),
        (folded, ValueError, "[N]"),
    ):
        with raises(error, fact):
            ActionWindow(wrong, 2)
    refuses(lambda: ActionWindow(pieces, 2), ValueError, "order")


@pytest.mark.parametrize("bad", [0, 777, 1999])
def test_bad_values_are_located_in_every_part_of_the_data(bad):
    value = torch.zeros(2000, 3)
    check_finite_steps("observation", value, memory=90)
    value[bad, 2] = float("nan")
    value[1999, 1] = float("inf")
    with raises(ValueError, "'observation'", f"step {bad}"):
        check_finite_steps("observation", value, memory=90)


def test_options_that_cannot_be():
    for wrong in (-0.1, 1.1, float("nan"), True, "abc"):
        with raises(ValueError, "probability"):
            WithheldHistory(wrong)
    refuses(lambda: WithheldHistory(0.5)(TensorDict({}, [3])), KeyError, "ActionWindow")
    for name in ("observation_steps", "chunk_length", "prediction_length", "history_length"):
        value = int(name in ("prediction_length", "history_length"))  # less than the chunk
        with raises(ValueError, name, value):
            ActionWindow(steps([3]), **{"chunk_length": 2, name: value})
    with raises(ValueError, "batch_size", 0):
        window_replay_buffer(steps([20]), PastPrior(2), batch_size=0)
