"""The cache of images: read once, never in part, by several processes, and of limited size."""

import errno
import multiprocessing
import os
import pickle
import time

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("h5py")

import h5py

from tests.errors import missing, raises
from tests.processes import apart
from warmprior.data import DatasetError, image_cache, open_demonstrations
from warmprior.data.formats.hdf5 import RobomimicDemonstrations, RobomimicReader

STEPS = 6


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A file with two demos of a camera, the images of all steps, and the cache's folder."""
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path / "cache"))
    images = np.random.default_rng(0).integers(0, 256, (2, STEPS, 16, 16, 3)).astype(np.uint8)
    with h5py.File(tmp_path / "recorded.hdf5", "w") as file:
        for number, shown in enumerate(images):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"], demo["obs/joints"] = np.ones((STEPS, 2)), np.zeros((STEPS, 2))
            demo["obs/front"] = shown
    whole = torch.from_numpy(images).flatten(0, 1).permute(0, 3, 1, 2)
    return tmp_path / "recorded.hdf5", whole, tmp_path / "cache" / "images"


@pytest.fixture
def read(monkeypatch):
    """The names of the demos whose images were read from files."""
    names, original = [], RobomimicReader.images

    def images(self, demo, key):
        names.append(demo)
        return original(self, demo, key)

    monkeypatch.setattr(RobomimicReader, "images", images)
    return names


def front(path, **options):
    return open_demonstrations(path, **options).steps(images=["front"], storage="memmap")[
        "observation", "front"
    ]


def test_what_decides_about_the_values_is_the_key(recorded, read, monkeypatch):
    path, images, _ = recorded
    assert torch.equal(front(path), images) and len(read) == 2
    assert torch.equal(front(path), images) and len(read) == 2
    others = {"image_size": 10}, {"image_size": 10, "resize": "pad"}, {"demos": 1}
    for count, options in zip((4, 6, 7), others, strict=True):
        for _ in range(2):
            front(path, **options)
            assert len(read) == count
    read.clear()
    elsewhere = path.rename(path.with_name("renamed.hdf5"))
    assert torch.equal(front(elsewhere), images) and not read
    with h5py.File(elsewhere, "a") as file:
        file["data/demo_1/obs/front"][STEPS - 1] = 7
    assert (front(elsewhere)[-1] == 7).all() and len(read) == 2
    monkeypatch.setattr(image_cache, "version", lambda package: "another")
    front(elsewhere)
    assert len(read) == 4


@pytest.mark.parametrize("how", [KeyboardInterrupt, "killed"])
def test_images_that_were_read_in_part_are_never_used(recorded, monkeypatch, how):
    path, images, folder = recorded
    original = RobomimicReader.images

    def breaks_off(self, demo, key):
        yield from original(self, demo, key)
        if demo == "demo_1":
            if how == "killed":
                os._exit(1)
            raise how

    with monkeypatch.context() as patched:
        patched.setattr(RobomimicReader, "images", breaks_off)
        with pytest.raises(EOFError if how == "killed" else how):
            apart(front)(path) if how == "killed" else front(path)
    left = [file for file in folder.iterdir() if file.suffix != ".lock"]
    assert len(left) == (how == "killed") and not list(folder.glob("*.bytes"))
    assert torch.equal(front(path), images)
    assert [file.suffix for file in sorted(folder.iterdir())] == [".bytes", ".lock"]
    (kept,) = folder.glob("*.bytes")
    kept.chmod(0o644)
    os.truncate(kept, 100)
    assert torch.equal(front(path), images)


def test_the_second_of_two_processes_waits_for_the_first(recorded, monkeypatch, tmp_path):
    path, images, _ = recorded
    original = RobomimicReader.images

    def slowly(self, demo, key):
        with open(tmp_path / "log", "a") as log:
            log.write(f"{demo}\n")
        time.sleep(0.3)
        return original(self, demo, key)

    monkeypatch.setattr(RobomimicReader, "images", slowly)
    fork = multiprocessing.get_context("fork")
    both = [fork.Process(target=front, args=(path,)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert torch.equal(front(path), images)
    assert (tmp_path / "log").read_text().split() == ["demo_0", "demo_1"]


def test_another_process_maps_the_same_images_or_is_told_that_they_are_gone(recorded, read):
    """PyTorch would make a file of zeros, and TensorDict send a part of a part as another one."""
    path, images, folder = recorded
    data = front(path)
    whole = TensorDict({"front": data}, [len(data)])
    parts = {
        "whole": (data, images),
        "part": (data[2:], images[2:]),
        "part of a part": (data[2:][1:7], images[3:9]),
        "of steps": (whole[3:][1:]["front"], images[4:]),
    }
    for part, expected in parts.values():
        sent = pickle.dumps(part)
        received = pickle.loads(sent)
        assert torch.equal(received, expected) and torch.equal(
            pickle.loads(pickle.dumps(received[1:])), expected[1:]
        )
        assert len(sent) < images[0].numel()
    sent = [pickle.dumps(part) for part, _ in parts.values()]
    (kept,) = folder.glob("*.bytes")
    kept.unlink()
    for one in sent:
        with raises(FileNotFoundError, kept, "removed"):
            pickle.loads(one)
    assert torch.equal(front(path), images) and len(read) == 4


def test_images_that_vanish_before_they_are_mapped_are_no_zeros(recorded, monkeypatch):
    path, images, folder = recorded
    front(path)
    (kept,) = folder.glob("*.bytes")
    with monkeypatch.context() as patched, raises(OSError, "removed", str(folder)):
        patched.setattr(os, "utime", lambda path: kept.unlink())
        front(path)
    assert torch.equal(front(path), images)


@pytest.mark.parametrize("moment", ["opened", "read"])
def test_a_file_that_is_replaced_while_it_is_read_is_refused(recorded, monkeypatch, moment):
    path, images, folder = recorded
    other = path.with_name("other.hdf5")
    other.write_bytes(path.read_bytes())
    with h5py.File(other, "a") as file:
        file["data/demo_1/obs/front"][0] = 7
    owner, name = (RobomimicDemonstrations, "reader") if moment == "opened" else (RobomimicReader, "images")
    original, before = getattr(owner, name), path.read_bytes()

    def replacing(self, *args):
        other.replace(path)
        return original(self, *args)

    with monkeypatch.context() as patched, raises(DatasetError, "recorded.hdf5", "changed"):
        patched.setattr(owner, name, replacing if moment == "opened" else once(replacing, original))
        front(path)
    assert not list(folder.glob("*.bytes")) and (front(path)[STEPS] == 7).all()
    path.write_bytes(before)
    assert torch.equal(front(path), images)


def once(first, then):
    """A method that is ``first`` at its first call, and ``then`` later."""
    calls = iter([first])
    return lambda self, *args: next(calls, then)(self, *args)


def test_a_full_cache_loses_what_was_used_longest_ago(recorded, read, monkeypatch):
    path, _, folder = recorded
    found = {}
    for age, size in ((3, 10), (4, 11), (2, 12), (0.5, 13)):
        before = {*folder.glob("*.bytes")}
        front(path, image_size=size)
        (found[age],) = {*folder.glob("*.bytes")} - before
        os.utime(found[age], (time.time() - 30 * age * 86_400,) * 2)
    front(path, image_size=10)  # a use keeps it
    later = 2 * STEPS * 3 * 16**2
    monkeypatch.setattr(image_cache, "CACHE_BYTES", later + sum(found[n].stat().st_size for n in (3, 2, 0.5)))
    front(path)
    assert not found[4].exists() and all(found[age].exists() for age in (3, 2, 0.5))
    monkeypatch.setattr(image_cache, "CACHE_BYTES", 0)
    front(path, image_size=9)
    assert not found[2].exists() and all(found[age].exists() for age in (3, 0.5))


def test_a_disk_without_space(recorded, read, monkeypatch):
    def full(file, start, length):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path, _, folder = recorded
    front(path, image_size=8)  # also the space of numbers is reserved
    take = os.posix_fallocate
    size = 2 * STEPS * 3 * 16**2
    monkeypatch.setattr(os, "posix_fallocate", lambda *where: (full if where[2] == size else take)(*where))
    read.clear()
    with raises(OSError, "GB", "recorded.hdf5", str(folder), "free some space", "WARMPRIOR_CACHE"):
        front(path)
    assert not read and len(list(folder.glob("*.bytes"))) == 1


def test_what_fails_in_reading_is_not_the_disk_of_the_cache(recorded, monkeypatch):
    """A file of a folder that cannot be opened any more, once images are written."""
    path, images, folder = recorded
    other, original = path.with_name("second.hdf5"), h5py.File
    other.write_bytes(path.read_bytes())

    def opened(name, *args, **options):
        if name == other and list(folder.glob(".*.tmp")):
            raise OSError(errno.EMFILE, "Unable to open file")
        return original(name, *args, **options)

    with monkeypatch.context() as patched, raises(OSError, other, "Too many open files") as caught:
        patched.setattr(h5py, "File", opened)
        front(path.parent)
    assert missing(str(caught.value), "space") and missing(str(caught.value), "WARMPRIOR_CACHE")
    assert torch.equal(front(path.parent), torch.cat([images, images]))


@pytest.mark.parametrize("step", ["posix_fallocate", "replace"])
def test_a_cache_that_fails_otherwise_says_why(recorded, monkeypatch, step):
    def failing(*args):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    path, _, folder = recorded
    front(path, image_size=8)  # also the space of numbers is reserved
    take, size = os.posix_fallocate, 2 * STEPS * 3 * 16**2
    if step == "posix_fallocate":
        monkeypatch.setattr(os, step, lambda *where: (failing if where[2] == size else take)(*where))
    else:
        monkeypatch.setattr(os, step, failing)
    with raises(OSError, "GB", "recorded.hdf5", folder, "Input/output error", "WARMPRIOR_CACHE") as caught:
        front(path)
    assert missing(str(caught.value), "space")
