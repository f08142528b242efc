"""Training windows against loops in plain Python and against TorchRL's own sequence sampler."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    RandomSampler,
    Sequence,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement

from warmprior import (
    ActionWindow,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreviewPrior,
    Prior,
    window_replay_buffer,
)
from warmprior.transforms.window import check_finite

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]


def steps(lengths, numbers=None):
    """Data in which every entry tells its own episode and step."""
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


def reference(data, prior, observation_steps, i):
    """Section 3 for one step, with Python's own lists."""
    episode = data["episode"].tolist()
    inside = [j for j in range(len(data)) if episode[j] == episode[i]]
    first, last = inside[0], inside[-1]
    horizon, length = prior.chunk_length, prior.prediction_length
    action, observation = data["action"], data["observation"]
    recent = [max(i - back, first) for back in reversed(range(observation_steps))]
    future = range(i, i + length)
    target = torch.stack([action[min(j, last)] for j in future])
    mean: list[torch.Tensor | None] = [None] * length
    if isinstance(prior, PastPrior) and i - horizon >= first:
        mean = [action[i - horizon + tau] for tau in range(horizon)]
    if isinstance(prior, PreviewPrior):
        mean = [target[tau] if tau < horizon else None for tau in range(length)]
    return (
        torch.stack([observation[j] for j in recent]),
        target,
        torch.tensor([j > last for j in future]),
        mean,
    )


def check(batch, data, prior, observation_steps):
    for row in batch:
        observation, target, pad, mean = reference(
            data, prior, observation_steps, int(row["frame"])
        )
        assert torch.equal(row["observation"], observation)
        assert torch.equal(row["vla_action", "chunk"], target)
        assert torch.equal(row["action_is_pad"], pad)
        warm, loc = row["prior", "warm"], row["prior", "loc"]
        assert warm.dtype == torch.bool and warm.shape == (prior.prediction_length, 1)
        assert warm.squeeze(-1).tolist() == [m is not None for m in mean]
        for tau, expected in enumerate(mean):
            if expected is not None:
                assert torch.equal(loc[tau], expected)
            else:
                assert (loc[tau] == 0).all()  # nothing leaks through cold positions


@pytest.mark.parametrize("horizon", [1, 3, 8])
@pytest.mark.parametrize("prior_class", PRIORS)
def test_every_step_of_short_episodes(prior_class, horizon):
    data = steps([1, 2, 3, 5, 9, 17], numbers=[4, 0, 7, 2, 11, 3])
    prior = prior_class(horizon)
    window = ActionWindow(data, prior)
    check(window(TensorDict({"frame": torch.arange(len(data))}, [len(data)])), data, prior, 2)


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=6),
    horizon=st.integers(1, 6),
    observation_steps=st.integers(1, 4),
    prior_class=st.sampled_from(PRIORS),
)
def test_random_episodes(lengths, horizon, observation_steps, prior_class):
    data = steps(lengths)
    prior = prior_class(horizon)
    window = ActionWindow(data, prior, observation_steps=observation_steps)
    batch = window(TensorDict({"frame": torch.arange(len(data))}, [len(data)]))
    check(batch, data, prior, observation_steps)


@pytest.mark.parametrize("shape", [(), (6,), (6, 1), (2, 3)])
def test_shapes_of_the_sample(shape):
    data = steps([4, 5])
    prior = PastPrior(2)
    frame = torch.randint(0, 9, shape)
    batch_size = shape[:1] if shape == (6, 1) else shape
    out = ActionWindow(data, prior)(TensorDict({"frame": frame}, batch_size))
    assert out["vla_action", "chunk"].shape == (*batch_size, 2, 2)
    assert out["observation"].shape == (*batch_size, 2, 3)
    assert out["action_is_pad"].shape == (*batch_size, 2)
    assert out["prior", "warm"].shape == (*batch_size, 2, 1)
    check(out.reshape(-1), data, prior, 2)


@pytest.mark.parametrize("horizon", [1, 4])
def test_agrees_with_torchrl_s_sequences(horizon):
    """``Sequence`` reads ``H`` steps before the anchor and ``2H`` from it: the same actions."""
    lengths = [1, 3, 12, 25]
    data = steps(lengths)
    done = torch.zeros(len(data), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(data)),
        sampler=RandomSampler(),
        batch_size=200,
        sample_unit=Sequence(
            length=2 * horizon, burn_in=horizon, episode_boundary="pad", done_key=("next", "done")
        ),
    )
    stored = data.clone()
    stored["next"] = TensorDict({"done": done, "terminated": done}, [len(data)])
    buffer.extend(stored)
    sample = buffer.sample().reshape(-1, 3 * horizon)
    valid = sample["validity_mask"].reshape(sample.shape)
    anchor = sample["anchor_index"][:, 0].reshape(-1)
    assert len(set(anchor.tolist())) > 20
    preview = ActionWindow(data, PreviewPrior(horizon))(
        TensorDict({"frame": anchor}, [len(anchor)])
    )
    past = ActionWindow(data, PastPrior(horizon))(TensorDict({"frame": anchor}, [len(anchor)]))
    future = valid[:, horizon:]
    assert torch.equal(future, ~preview["action_is_pad"])
    target = preview["vla_action", "chunk"]
    assert torch.equal(target[future], sample["action"][:, horizon:][future])
    history = valid[:, :horizon].all(-1)
    assert torch.equal(history, past["prior", "warm"].squeeze(-1).all(-1))
    assert torch.equal(past["prior", "loc"][history], sample["action"][:, :horizon][history])
    assert torch.equal(past["prior", "warm"].any(1), past["prior", "warm"].all(1))


def stored(kind, data, folder):
    storage = (
        LazyTensorStorage(len(data))
        if kind == "tensor"
        else LazyMemmapStorage(len(data), scratch_dir=folder)
    )
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=32)
    buffer.extend(data)
    return buffer


@pytest.mark.parametrize("kind", ["tensor", "memmap"])
def test_data_out_of_a_replay_buffer(kind, tmp_path):
    data = steps([3, 7, 2])
    prior = PastPrior(2)
    source = stored(kind, data, tmp_path)[:]
    batch = window_replay_buffer(source, prior, batch_size=64).sample()
    check(batch, data, prior, 2)


@pytest.mark.parametrize("kind", ["tensor", "memmap"])
def test_window_as_the_transform_of_another_buffer(kind, tmp_path):
    data = steps([3, 7, 2])
    data["frame"] = torch.arange(len(data))
    data["weight"] = torch.rand(len(data))
    buffer = stored(kind, data, tmp_path)
    prior = PreviewPrior(2)
    buffer.append_transform(ActionWindow(data, prior))
    batch = buffer.sample()
    check(batch, data, prior, 2)
    assert torch.equal(batch["weight"], data["weight"][batch["frame"]])  # the rest stays


def test_memmapped_tensordict(tmp_path):
    data = steps([3, 7, 2])
    mapped = data.memmap(tmp_path)
    check(window_replay_buffer(mapped, PastPrior(2), batch_size=64).sample(), data, PastPrior(2), 2)


def test_epochs_visit_every_step_once():
    data = steps([3, 7, 2])
    buffer = window_replay_buffer(
        data, PastPrior(2), batch_size=4, sampler=SamplerWithoutReplacement()
    )
    seen = [i for batch in buffer for i in batch["frame"].tolist()]
    assert sorted(seen) == list(range(12))


def test_border_windows_are_sampled_like_all_others():
    data = steps([5] * 20)
    generator = torch.Generator().manual_seed(0)
    buffer = window_replay_buffer(data, PastPrior(4), batch_size=20_000, generator=generator)
    counts = torch.bincount(buffer.sample()["frame"], minlength=100).float()
    # Expected 200 each, standard deviation 14.
    assert counts.min() > 200 - 5 * 14.1 and counts.max() < 200 + 5 * 14.1


def test_generator_fixes_steps_and_withheld_means():
    data = steps([20, 30])
    prior = PastPrior(2, cold_probability=0.5)

    def draw(seed):
        generator = torch.Generator().manual_seed(seed)
        buffer = window_replay_buffer(data, prior, batch_size=50, generator=generator)
        return torch.cat([buffer.sample() for _ in range(3)])

    one, same, other = draw(1), draw(1), draw(2)
    assert torch.equal(one["frame"], same["frame"])
    assert torch.equal(one["prior", "warm"], same["prior", "warm"])
    assert not torch.equal(one["frame"], other["frame"])


def test_cold_probability_withholds_whole_windows():
    data = steps([60] * 5)
    share = 0.25
    prior = PreviewPrior(4, cold_probability=share)
    generator = torch.Generator().manual_seed(0)
    batch = window_replay_buffer(data, prior, batch_size=10_000, generator=generator).sample()
    warm = batch["prior", "warm"][:, :4, 0]
    assert torch.equal(warm.any(1), warm.all(1)) and not batch["prior", "warm"][:, 4:].any()
    assert abs((~warm[:, 0]).float().mean() - share) < 0.025  # five standard errors


def test_a_user_s_prior_sees_only_its_own_episode():
    """What a subclass may read: the history inside the episode, zeros where there is none."""
    seen = []

    class Spy(PastPrior):
        name = "spy-for-this-test"

        def training_mean(self, history, history_valid, target):
            seen.append((history.clone(), history_valid.clone()))
            return super().training_mean(history, history_valid, target)

    data = steps([3, 4])
    ActionWindow(data, Spy(2))(TensorDict({"frame": torch.arange(7)}, [7]))
    del Prior._registry["spy-for-this-test"]
    history, valid = seen[0]
    assert valid.tolist() == [
        [False, False],
        [False, True],
        [True, True],
        [False, False],
        [False, True],
        [True, True],
        [True, True],
    ]
    assert (history[~valid] == 0).all()
    assert torch.equal(history[5], data["action"][3:5])


def test_renamed_keys_and_nested_observation():
    data = steps([3, 4])
    renamed = TensorDict(
        {
            "state": {"low": data["observation"]},
            "move": data["action"],
            "demo": data["episode"],
        },
        [7],
    )
    window = ActionWindow(
        renamed,
        PastPrior(2),
        frame_key="step",
        observation_key=("state", "low"),
        action_key="move",
        episode_key="demo",
    )
    out = window(TensorDict({"step": torch.arange(7)}, [7]))
    expected = ActionWindow(data, PastPrior(2))(TensorDict({"frame": torch.arange(7)}, [7]))
    assert torch.equal(out["state", "low"], expected["observation"])
    assert torch.equal(out["vla_action", "chunk"], expected["vla_action", "chunk"])


@pytest.mark.parametrize("key", ["observation", "action"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_bad_values_are_located(key, value):
    data = steps([3, 4])
    data[key][4, 1] = value
    with pytest.raises(ValueError, match=f"'{key}' holds NaN or Inf, first at step 4"):
        ActionWindow(data, PastPrior(2))


@pytest.mark.parametrize("key", ["observation", "action", "episode"])
def test_missing_entry(key):
    data = steps([3, 4])
    del data[key]
    with pytest.raises(KeyError, match=f"the data lack '{key}'"):
        ActionWindow(data, PastPrior(2))


def test_episodes_in_pieces():
    data = steps([3, 4])
    data["episode"] = torch.tensor([0, 0, 1, 1, 0, 2, 2])
    with pytest.raises(ValueError, match="steps of episode 0 are not contiguous"):
        ActionWindow(data, PastPrior(2))


def test_empty_or_batched_data():
    data = steps([3, 4])
    with pytest.raises(ValueError, match=r"flat steps \[N\] with N > 0"):
        ActionWindow(data[:0], PastPrior(2))
    with pytest.raises(ValueError, match="flat steps"):
        ActionWindow(steps([3, 3]).reshape(2, 3), PastPrior(2))


def test_no_frame():
    window = ActionWindow(steps([3, 4]), PastPrior(2))
    with pytest.raises(KeyError, match="index of each sampled step under 'frame'"):
        window(TensorDict({"other": torch.arange(3)}, [3]))


@pytest.mark.parametrize("steps_", [0, -1])
def test_bad_observation_steps(steps_):
    with pytest.raises(ValueError, match="observation_steps"):
        ActionWindow(steps([3]), PastPrior(2), observation_steps=steps_)


def test_data_larger_than_memory_are_never_copied(tmp_path):
    """Checks, statistics and samples of a file allocate a fraction of what it holds."""
    wide = TensorDict(
        {
            "observation": torch.empty(20_000, 800),  # 64 MB
            "action": torch.empty(20_000, 7),
            "episode": torch.empty(20_000, dtype=torch.int64),
        },
        [20_000],
    ).memmap_like(tmp_path)
    prior = PastPrior(4)
    with torch.profiler.profile(
        activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True
    ) as profile:
        Normalizer.fit(wide)
        window_replay_buffer(wide, prior, batch_size=64).sample()
    largest = max(event.self_cpu_memory_usage for event in profile.events())
    assert 0 < largest < 64e6 / 3


@pytest.mark.parametrize("bad", [0, 777, 1999])
def test_bad_values_are_located_in_every_part_of_the_data(bad):
    value = torch.zeros(2000, 3)
    check_finite("observation", value, memory=90)
    value[bad, 2] = float("nan")
    value[1999, 1] = float("inf")
    with pytest.raises(ValueError, match=f"'observation' holds NaN or Inf, first at step {bad}$"):
        check_finite("observation", value, memory=90)
