"""HDF5 files, whose contents are checked before they are read.

A file can refer to other files on the machine for its contents, and declare more than it stores, which HDF5
reads as zeros. :func:`member` opens everything, and refuses both.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import pairwise, product
from math import ceil, prod
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from warmprior.data import checks
from warmprior.data.checks import DatasetError
from warmprior.data.formats.heaps import open_checked
from warmprior.io.extras import require

if TYPE_CHECKING:
    import h5py

CHUNK_BYTES = 2**28  # HDF5 unpacks whole chunks, even to read a few rows
AGAIN = "Copy or download it again."
MAX_SOFT_LINKS = 16
LEAVE_OUT = "Rebuild or remove the demo, or leave it out with a mask."

_COPY = "Other files are not read: copy the data into this file."


def reading(parent: h5py.Group, name: str) -> AbstractContextManager[None]:
    """Turn any error inside into a DatasetError that names the file and the object below ``parent``."""
    return checks.reading(place_of(parent, name), AGAIN)


def names(group: h5py.Group) -> list[str]:
    """Return the names in a group, sorted, and check that each occurs once."""
    with reading(group, ""):
        listed = sorted(group)
    if twice := [name for name, following in pairwise(listed) if name == following]:
        raise DatasetError(f"{place_of(group)} has the name {twice[0]!r} twice, so another is lost. {AGAIN}")
    return listed


def member(
    parent: h5py.Group, name: str, kind: Literal["group", "dataset"] | None = None
) -> h5py.Group | h5py.Dataset | None:
    """Open a group or dataset below ``parent`` that is fully stored in this file; ``None`` without one."""
    with reading(parent, name):
        item = follow(parent, name)
        if item is None:
            return None
        actual = "group" if isinstance(item, require("h5py", "sim").Group) else "dataset"
        if kind not in (None, actual):
            raise DatasetError(f"{place_of(parent, name)} is a {actual}, not a {kind}; rebuild the file")
        if actual == "dataset":
            _check_stored(item)
        return item


def check_members(parent: h5py.Group, name: str, met: set[int] | None = None) -> None:
    """Raise DatasetError unless what is below ``parent`` is fully stored in this file, with all it holds.

    A group under two names, ``met`` before, is refused: one that holds itself has no end.
    """
    met = set() if met is None else met
    with reading(parent, name):
        item = member(parent, name)
        if isinstance(item, require("h5py", "sim").Group):
            place = require("h5py.h5o", "sim").get_info(item.id).addr
            if place in met:
                raise DatasetError(f"{place_of(parent, name)} is a group with another name as well. {AGAIN}")
            met.add(place)
            for inner in names(item):
                check_members(item, inner, met)
        elif item is not None and item.dtype.hasobject:
            item[()]  # which checks its heaps


def place_of(parent: h5py.Group, name: str = "") -> str:
    """Name an object in errors: the file, and the path in it."""
    path = f"{parent.name}/{name}".strip("/") or "/"
    return f"{parent.file.filename}: {path}"


def follow(node: h5py.Group, name: str, soft_links: int = MAX_SOFT_LINKS) -> h5py.Group | h5py.Dataset | None:
    """Return what has a name below ``node`` in this file, unchecked; ``None`` without one."""
    # Links are followed one by one, with low-level calls: h5py's own, even ``in``, would open other files.
    h5py = require("h5py", "sim")
    for part in name.strip("/").split("/"):
        if not isinstance(node, h5py.Group):
            raise DatasetError(f"{place_of(node)} is a dataset, not a group; rebuild the file")
        links, key = node.id.links, part.encode(errors="surrogateescape")
        if not links.exists(key):
            return None
        kind = links.get_info(key).type
        if kind == h5py.h5l.TYPE_HARD:
            node = node[part]
        elif kind == h5py.h5l.TYPE_SOFT:
            if soft_links == 0:
                raise DatasetError(f"{place_of(node, part)} leads through too many links")
            target = links.get_val(key).decode(errors="surrogateescape")
            start = node.file if target.startswith("/") else node
            node = follow(start, target, soft_links - 1)
            if node is None:
                return None
        else:
            where = links.get_val(key)[0].decode(errors="replace") if kind == h5py.h5l.TYPE_EXTERNAL else ""
            raise DatasetError(f"{place_of(node, part)} is a link to another file {where}. {_COPY}")
    return node


def _check_stored(dataset: h5py.Dataset) -> None:
    """Raise DatasetError unless a dataset's values are all in this file, and can be read within bounds."""
    what = place_of(dataset)
    if dataset.is_virtual or dataset.external:
        raise DatasetError(f"{what} has its values in another file. {_COPY}")
    if not dataset.size:
        return
    places: list[tuple[int, int]] = []  # first byte and size of each stored part in the file
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        complete = stored >= dataset.size * dataset.dtype.itemsize
        if dataset.id.get_offset() is not None:  # a compact one lies in its header
            places.append((dataset.id.get_offset(), stored))
    else:
        chunk_bytes = prod(dataset.chunks) * dataset.dtype.itemsize
        if chunk_bytes > CHUNK_BYTES:
            raise DatasetError(
                f"{what} has chunks of {chunk_bytes:.1e} bytes: h5repack -l makes smaller ones"
            )
        dimensions = list(zip(dataset.shape, dataset.chunks, strict=True))
        complete = dataset.id.get_num_chunks() >= prod(ceil(n / c) for n, c in dimensions)
        if complete:
            parts: dict[tuple[int, ...], tuple[int, int]] = {}
            dataset.id.chunk_iter(lambda p: parts.update({p.chunk_offset: (p.byte_offset, p.size)}))
            places = sorted(parts.values())
            # HDF5 reads a part that is missing in its index as zeros.
            if not all(start in parts for start in product(*(range(0, n, c) for n, c in dimensions))):
                raise DatasetError(f"{what}: its index of chunks is damaged. {AGAIN}")
    ends = [*(first for first, _ in places[1:]), dataset.file.id.get_filesize()]
    if any(first + size > end for (first, size), end in zip(places, ends, strict=bool(places))):
        raise DatasetError(f"{what}: its values overlap, or lie after the file's end. {AGAIN}")
    if not complete:
        raise DatasetError(f"{what} has values that were never written. {LEAVE_OUT}")


@contextmanager
def open_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """Open a file for reading; raise DatasetError if it is none of HDF5's."""
    h5py = require("h5py", "sim")
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name a file of it")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; check the path")
    with ExitStack() as opened:
        try:
            opened.enter_context(h5py.File(path, "r"))  # for HDF5's lock, which the other lacks
            file = opened.enter_context(open_checked(path))
        except BlockingIOError as error:
            raise DatasetError(
                f"{path}: another process has it open to write ({error}): close it there, or wait; on a file "
                "system without locks set HDF5_USE_FILE_LOCKING=FALSE"
            ) from error
        except OSError as error:
            if error.errno is not None:  # the system's reason, not the format's
                raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
            what = f"{path}: not a readable HDF5 file ({path.stat().st_size} bytes; {error})"
            raise DatasetError(f"{what}. {AGAIN}") from error
        yield file
