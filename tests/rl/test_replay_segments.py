"""The replay buffer on disk: what went in comes out, and nothing that was not committed."""

from __future__ import annotations

import tempfile
from pathlib import Path

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from tensordict import TensorDict

from warmprior.rl import ReplaySegments

DTYPES = [torch.float32, torch.float64, torch.int64, torch.bool]


def batch(n, start=0):
    rows = torch.arange(start, start + n)
    return TensorDict(
        {
            "observation": rows.float()[:, None, None].expand(n, 2, 3).clone(),
            ("prior", "delta"): -rows.float()[:, None],
            "next": {"done": rows[:, None] % 2 == 0, ("prior", "anchor"): rows[:, None]},
        },
        [n],
    )


@st.composite
def tensordicts(draw):
    """Nested keys of every depth and type, with rows that differ."""
    paths = draw(
        st.lists(
            st.lists(st.sampled_from(["a", "b", "c.d"]), min_size=1, max_size=3).map(
                lambda path: (*path, "leaf")
            ),
            min_size=1,
            max_size=4,
            unique=True,
        )
    )
    forms = [(draw(st.sampled_from(DTYPES)), draw(st.lists(st.integers(1, 3), max_size=2))) for _ in paths]
    sizes = draw(st.lists(st.lists(st.integers(1, 3), max_size=3), max_size=3))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1_000)))

    def make(n):
        values = {
            path: torch.randint(0, 100, (n, *shape), generator=generator).to(dtype)
            for path, (dtype, shape) in zip(paths, forms, strict=True)
        }
        return TensorDict(values, [n])

    return [[make(n) for n in group] for group in sizes]


@settings(max_examples=40)
@given(tensordicts())
def test_roundtrip_of_any_tensordicts_in_any_number_of_segments(groups):
    with tempfile.TemporaryDirectory() as folder:
        segments = ReplaySegments(Path(folder) / "buffer")
        for group in groups:
            for data in group:
                segments.append(data)
            segments.write()
        loaded = ReplaySegments(segments.directory, segments.committed).load()
    everything = [data for group in groups for data in group]
    assert segments.committed == sum(map(bool, groups))  # nothing new, no segment
    if not everything:
        assert loaded is None
        return
    expected = torch.cat(everything)
    assert loaded.batch_size == expected.batch_size
    assert set(loaded.keys(True, True)) == set(expected.keys(True, True))
    for key, value in expected.items(True, True):
        assert loaded[key].dtype == value.dtype and torch.equal(loaded[key], value)


def test_what_was_not_committed_is_ignored_and_replaced(tmp_path):
    segments = ReplaySegments(tmp_path)
    segments.append(batch(3))
    segments.write()
    committed = segments.committed  # the training state is saved here, and the process dies later:
    segments.append(batch(2, start=50))
    segments.write()
    (tmp_path / ".000002.safetensors.99.tmp").write_bytes(b"torn")
    again = ReplaySegments(tmp_path, committed)
    assert (again.load() == batch(3)).all()
    again.append(batch(4, start=3))
    again.write()
    assert (ReplaySegments(tmp_path, again.committed).load() == batch(7)).all()


@pytest.mark.parametrize("damage", ["missing", "torn"])
def test_a_segment_that_is_gone_is_named(tmp_path, damage):
    segments = ReplaySegments(tmp_path)
    for k in range(3):
        segments.append(batch(2, start=2 * k))
        segments.write()
    path = sorted(tmp_path.iterdir())[1]
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match=rf"{path.name}, a part of the replay buffer.*restore it"):
        ReplaySegments(tmp_path, 3).load()
