import errno
import multiprocessing
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.errors import missing, raises, refuses
from warmprior.io.files import (
    check_writable,
    exclusive,
    read_json,
    read_tensors,
    save_file,
    storing,
    write_atomic,
)

FORK = multiprocessing.get_context("fork")


def test_many_may_write_one_file_at_once(tmp_path):
    path = tmp_path / "file"

    def write(text, temporary):
        temporary.write_text(text[: len(text) // 2])
        time.sleep(0.001)
        with temporary.open("a") as file:
            file.write(text[len(text) // 2 :])

    texts = [str(i) * 1000 for i in range(10)]
    with ThreadPoolExecutor(10) as threads:
        list(threads.map(lambda text: write_atomic(path, partial(write, text)), texts))
    assert path.read_text() in texts and list(tmp_path.iterdir()) == [path]


def _killed_while_writing(path):
    def write(temporary):
        temporary.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)

    write_atomic(path, write)


def _hold(folder, pipe):
    with exclusive(folder):
        pipe.send("in")
        time.sleep(300)


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path):
    path, other = tmp_path / "results", tmp_path / "results.json"
    for each in (path, other):
        process = FORK.Process(target=_killed_while_writing, args=(each,))
        process.start()
        process.join(30)
    assert len(list(tmp_path.iterdir())) == 2
    write_atomic(path, lambda temporary: temporary.write_text("whole"))
    assert sum(name.startswith(".results.json.") for name in os.listdir(tmp_path)) == 1
    assert len(list(tmp_path.iterdir())) == 2
    write_atomic(other, lambda temporary: temporary.write_text("whole"))
    assert sorted(tmp_path.iterdir()) == [path, other]


def test_tensors_are_written_as_any_other_file(tmp_path):
    plain, tensors = tmp_path / "plain", tmp_path / "tensors"
    plain.touch()
    save_file({"a": torch.arange(3)}, tensors, {"note": "kept"})
    assert tensors.stat().st_mode == plain.stat().st_mode
    found, metadata = read_tensors(tensors.read_bytes())
    assert found["a"].tolist() == [0, 1, 2] and metadata == {"note": "kept"}


def test_a_folder_belongs_to_one_process_until_it_ends(tmp_path):
    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=_hold, args=(tmp_path, theirs))
    process.start()
    assert ours.poll(30) and ours.recv() == "in"
    with raises(BlockingIOError, tmp_path), exclusive(tmp_path):
        pass
    process.kill()
    process.join(30)
    with exclusive(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_files_and_folders_that_cannot_be_used_are_named(tmp_path):
    path = tmp_path / "file"
    for content in (b"", b"{", b"[" * 100_000, b'"\xff"'):
        path.write_bytes(content)
        refuses(lambda: read_json(path), ValueError, path, "JSON")
    refuses(lambda: check_writable(path), OSError, path)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EMFILE, errno.EIO])
def test_only_a_lack_of_space_is_called_so(tmp_path, monkeypatch, code):
    """Whatever else the system says is the reason; of files elsewhere, it is not the writing that failed."""
    path, reason = tmp_path / "new" / "file", os.strerror(code)

    def failing(*args):
        raise OSError(code, reason)

    full = code in (errno.ENOSPC, errno.EDQUOT)
    for call in (lambda: write_atomic(path, failing), lambda: check_writable(path.parent)):
        with raises(OSError, path.parent, reason) as caught:
            call()
        assert (not missing(str(caught.value), "space", "free")) == full
        monkeypatch.setattr(os, "fsync", failing)

    def reading(temporary):
        raise OSError(code, reason, str(tmp_path / "data" / "one.hdf5"))

    with raises(OSError, "one.hdf5", reason) as caught:
        write_atomic(path, reading)
    assert caught.value.errno == code and missing(str(caught.value), path)


@pytest.mark.parametrize(
    ("error", "facts"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), ["cannot keep it", "space", "elsewhere"]),
        (OSError(errno.EFBIG, "File too large"), ["cannot keep it", "elsewhere"]),
        (OSError(errno.EACCES, "Permission denied", "kept/file"), ["cannot keep it", "elsewhere"]),
        (OSError(errno.EACCES, "Permission denied", "read/file"), None),
        (ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"), None),
        (FileNotFoundError("a sentence of the library"), None),
        (OSError(errno.EBADF, "Bad file descriptor", 999), ["cannot keep it", "elsewhere"]),
    ],
)
def test_only_what_fails_in_a_folder_is_said_of_it(error, facts):
    with pytest.raises(OSError) as caught, storing("cannot keep it", Path("kept"), "elsewhere"):
        raise error
    if facts is None:
        assert caught.value is error
    else:
        assert not missing(str(caught.value), *facts) and caught.value.__cause__ is error
        assert ("free some space" in str(caught.value)) == (error.errno == errno.ENOSPC)
