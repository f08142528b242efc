import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises
from warmprior.rl.training import ReplaySegments


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


def test_what_went_in_comes_out_in_order_and_type(tmp_path):
    segments = ReplaySegments(tmp_path / "buffer")
    assert segments.load() is None
    for start, count in ((0, 3), (3, 1), (4, 5)):
        segments.append(batch(count, start))
        if start:
            segments.write()
    segments.write()  # nothing new, no segment
    assert segments.committed == 2
    loaded, expected = ReplaySegments(segments.directory, 2).load(), batch(9)
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
    with raises(ValueError, path.name):
        ReplaySegments(tmp_path, 3).load()
