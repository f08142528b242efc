"""Images at the size that policies see: decoded and resized once, then kept in a cache on the disk."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from tensordict import MemoryMappedTensor
from torch import Tensor

from warmprior.data.checks import DatasetError
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.io.files import cache_folder, digest_of, reserve, storing, write_atomic
from warmprior.io.progress import progress_bar
from warmprior.modules.resize import resized

FRAMES_VERSION = 1
"""The version of reading here; it is raised whenever the same contents give other images."""

CACHE_BYTES = 50 * 2**30
"""The size from which on images that were not used lately leave the cache."""

LATELY = 30 * 24 * 3600
"""The seconds after the last use in which images stay in the cache, whatever its size."""

COMPLETE = 0o644
"""The mode of a file with all its images; PyTorch maps a file that is gone as a new one of zeros, in 0600."""


def image_shape(index: DatasetIndex) -> tuple[int, int, int, int]:
    """Return the shape of all images of a camera, ``(N, 3, size, size)``."""
    return sum(index.lengths), 3, index.image_size, index.image_size


def read_images(index: DatasetIndex, reader: DemonstrationReader, key: str, out: Tensor) -> None:
    """Read and resize the images of a camera into a tensor, uint8 ``[N, 3, size, size]``."""
    # A bar only for images, which take long because they are unpacked one by one.
    bar = progress_bar(f"read {key} of {index.path.name}", index.demos, unit="demo")
    for demo, (start, stop) in zip(bar, pairwise(np.cumsum([0, *index.lengths])), strict=True):
        images, first = out[start:stop], 0
        for block in reader.images(demo, key):
            part = images[first : first + len(block)]
            part.copy_(resized(block, (index.image_size,) * 2, index.resize)[: len(part)])
            first += len(block)
        if first != len(images):
            raise DatasetError(
                f"{index.path}: demo {demo} has {first} images {key} for {len(images)} steps: record it "
                "again or leave it out"
            )


def cached_images(
    index: DatasetIndex, reader: DemonstrationReader, key: str, digest: str, contents: Callable[[], str]
) -> Tensor:
    """Return the images of a camera as a memory map of the cache, uint8 ``[N, 3, size, size]``.

    The first call for the same contents, demonstrations, size, way of resizing and versions of decoders
    and PyTorch reads them, while other processes that ask for these wait. Images of every format go this way,
    also those that need no decoding: each demonstration of a file has its own array, channels last, so a copy
    is needed anyway, and here all runs share it.

    The cache is the folder ``images`` in ``$WARMPRIOR_CACHE``, or in ``~/.cache/warmprior`` if that is not
    set. When it exceeds 50 GiB after images were added, those used longest ago leave it, but none of the last
    30 days. The whole folder may be removed at any time between runs. The map is shared, so that it may be
    larger than the memory: do not write to it.

    Args:
        index: the index.
        reader: the reader of its values.
        key: the name of the images.
        digest: the digest of what the place held before the reader opened it, see
            :meth:`Demonstrations.contents`.
        contents: returns the digest of what it holds now.

    Raises:
        DatasetError: if images cannot be read, or the place changes meanwhile.
        OSError: if they cannot be stored.
    """
    shape, feature = image_shape(index), index.images.get(key, key)
    options = index.demos, index.lengths, feature, index.image_size, index.resize
    versions = [(package, version(package)) for package in ("torch", *reader.decoders(key))]
    identity = digest_of(FRAMES_VERSION, versions, digest, *options)
    path = cache_folder() / "images" / f"{identity}.bytes"

    def write(temporary: Path) -> None:
        out = MemoryMappedTensor.empty(shape, dtype=torch.uint8, filename=str(temporary))
        reserve(out)
        read_images(index, reader, key, out)
        if contents() != digest:
            raise DatasetError(f"{index.path} changed while it was read: read it again")
        temporary.chmod(COMPLETE)

    needed = f"{torch.Size(shape).numel() / 1e9:.3g} GB of images of {index.path}"
    what, elsewhere = f"{path.parent}: cannot keep {needed}", "another folder (WARMPRIOR_CACHE)"
    with storing(what, path.parent, elsewhere):
        if not _is_complete(path, shape):
            path.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(path.with_suffix(".lock"), mode=0o666):
                if not _is_complete(path, shape):
                    write_atomic(path, write)
                    _clean(path.parent)
        with suppress(OSError):  # of another user, who shares the folder
            os.utime(path)
        return ImageMap.from_filename(path, torch.uint8, shape)


class ImageMap(MemoryMappedTensor):
    """A map of images or of a part of them, which another process opens as the same rows, or not at all."""

    @classmethod
    def from_filename(
        cls, filename: Path, dtype: torch.dtype, shape: Sequence[int], index: Any = None
    ) -> Any:
        """Map a file; ``index`` is the sizes, strides and offset of a part."""
        if not _is_complete(Path(filename), shape):  # an empty file would be made
            raise FileNotFoundError(f"{filename} was removed meanwhile: read the demonstrations again")
        images = super().from_filename(filename, dtype, shape)
        return images if index is None else images._index_wrap(images.as_strided(*index), None)

    def _index_wrap(self, tensor: Tensor, item: Any, check: bool = False) -> Any:
        part = super()._index_wrap(tensor, item, check)
        if isinstance(part, MemoryMappedTensor):  # with an index that also holds for a part of a part
            part.__class__, part.index = type(self), (part.shape, part.stride(), part.storage_offset())
        return part


def _is_complete(path: Path, shape: Sequence[int]) -> bool:
    """Return True unless the file is missing, was never finished, or lost what was written last."""
    try:
        found = path.stat()
    except OSError:
        return False
    return (stat.S_IMODE(found.st_mode), found.st_size) == (COMPLETE, torch.Size(shape).numel())


def _clean(folder: Path) -> None:
    """Remove the files used longest ago, but none used lately, until the others are small enough.

    That includes locks, and what killed processes left. Others may clean at the same time.
    """
    found = []
    for path in folder.iterdir():
        with suppress(OSError):
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    excess = sum(size for _, size, _ in found) - CACHE_BYTES
    for _, size, path in sorted(found):
        with suppress(OSError):
            if excess <= 0 or time.time() - path.stat().st_mtime < LATELY:
                return
            path.unlink()
        excess -= size
