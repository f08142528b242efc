"""Opening what an HDF5 file holds itself: no other file, nothing that was never written.

It can name other files of the machine as its contents, and declare more than it stores, which HDF5 reads as
zeros. Everything the readers use is opened by :func:`member`, which refuses both.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from math import ceil, prod
from typing import TYPE_CHECKING, Literal

from warmprior.io.extras import require

if TYPE_CHECKING:
    import h5py

CHUNK_BYTES = 2**28  # HDF5 unpacks whole chunks, however few rows are asked for
_MAX_SOFT_LINKS = 16
_AGAIN = "Copy or download the file again."


class DatasetError(ValueError):
    """A demonstration file is not what it should be; the message says where and what to do.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.data import RobomimicExperienceReplay
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "square.hdf5"
        ...     _ = path.write_bytes(b"a download that broke off")
        ...     RobomimicExperienceReplay(path)
        Traceback (most recent call last):
            ...
        warmprior.data.hdf5_members.DatasetError: ...square.hdf5: not a readable HDF5 file (25 bytes; ...
    """


@contextmanager
def reading(parent: h5py.Group, name: str) -> Iterator[None]:
    """Name the file, and the object below ``parent``, in whatever goes wrong inside."""
    try:
        yield
    except DatasetError:
        raise
    except Exception as error:  # HDF5's errors share no base class: OSError, RuntimeError, KeyError...
        raise DatasetError(
            f"{parent.file.filename}: {_full(parent, name)} cannot be read ({error}); copy or "
            "download the file again"
        ) from error


def names(group: h5py.Group) -> list[str]:
    """The names in a group, sorted."""
    with reading(group, ""):
        return sorted(group)


def member(
    parent: h5py.Group, name: str, kind: Literal["group", "dataset"]
) -> h5py.Group | h5py.Dataset | None:
    """Open a group or dataset that the file itself holds, and has written, below ``parent``; or ``None``."""
    with reading(parent, name):
        found = _follow(parent, name, _MAX_SOFT_LINKS)
        if found is None:
            return None
        is_group = isinstance(found, require("h5py", "sim").Group)
        if is_group != (kind == "group"):
            what, wanted = ("a group", "dataset") if is_group else ("a dataset", "group")
            raise DatasetError(
                f"{parent.file.filename}: {_full(parent, name)} is {what} where a {wanted} belongs; "
                "rebuild the file"
            )
        if not is_group:
            _check_stored(found)
        return found


def _full(parent: h5py.Group, name: str) -> str:
    return f"{parent.name}/{name}".strip("/") or "/"


def _follow(node: h5py.Group, name: str, soft_links: int) -> h5py.Group | h5py.Dataset | None:
    # Link by link, by the low-level calls: h5py's own, ``in`` included, would open the other file.
    h5py = require("h5py", "sim")
    path = node.file.filename
    for part in name.strip("/").split("/"):
        if not isinstance(node, h5py.Group):
            raise DatasetError(
                f"{path}: {_full(node, '')} is a dataset where a group belongs; rebuild the file"
            )
        links, key = node.id.links, part.encode(errors="surrogateescape")
        if not links.exists(key):
            return None
        kind = links.get_info(key).type
        if kind == h5py.h5l.TYPE_HARD:
            node = node[part]
        elif kind == h5py.h5l.TYPE_SOFT:
            if soft_links == 0:
                raise DatasetError(f"{path}: {_full(node, part)} leads through too many links")
            target = links.get_val(key).decode(errors="surrogateescape")
            start = node.file if target.startswith("/") else node
            node = _follow(start, target, soft_links - 1)
            if node is None:
                return None
        else:
            where = links.get_val(key)[0].decode(errors="replace") if kind == h5py.h5l.TYPE_EXTERNAL else ""
            raise DatasetError(
                f"{path}: {_full(node, part)} is a link to another file {where}, which is not read: "
                "copy the data into this file"
            )
    return node


def _check_stored(dataset: h5py.Dataset) -> None:
    """Whether a dataset's values are all in this file, and can be read within bounds."""
    what = f"{dataset.file.filename}: {dataset.name[1:]}"
    if dataset.is_virtual or dataset.external:
        how = "is a virtual dataset over" if dataset.is_virtual else "stores its values in"
        raise DatasetError(f"{what} {how} another file, which is not read: copy the data into this file")
    if not dataset.size:
        return
    places: list[tuple[int, int]] = []  # in the file, of the stored parts: first byte and size
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        complete = stored >= dataset.size * dataset.dtype.itemsize
        if dataset.id.get_offset() is not None:  # a compact one lies in its header
            places.append((dataset.id.get_offset(), stored))
    else:
        chunk = prod(dataset.chunks) * dataset.dtype.itemsize
        if chunk > CHUNK_BYTES:
            raise DatasetError(
                f"{what} has shape {dataset.shape} in chunks of {chunk:.1e} bytes, which would have to "
                "be unpacked whole: write it in smaller ones (h5repack -l CHUNK=...)"
            )
        steps = list(zip(dataset.shape, dataset.chunks, strict=True))
        complete = dataset.id.get_num_chunks() >= prod(ceil(n / c) for n, c in steps)
        if complete:
            parts: dict[tuple[int, ...], tuple[int, int]] = {}
            dataset.id.chunk_iter(lambda p: parts.update({p.chunk_offset: (p.byte_offset, p.size)}))
            places = sorted(parts.values())
            # HDF5 reads a part that its index does not find as zeros.
            if not all(start in parts for start in product(*(range(0, n, c) for n, c in steps))):
                raise DatasetError(f"{what}: its index of chunks is damaged. {_AGAIN}")
    ends = [*(first for first, _ in places[1:]), dataset.file.id.get_filesize()]
    if any(first + size > end for (first, size), end in zip(places, ends, strict=bool(places))):
        raise DatasetError(f"{what}: its values overlap, or lie behind the file's end. {_AGAIN}")
    if not complete:
        raise DatasetError(
            f"{what} has shape {dataset.shape}, but some of its values were never written: the recording "
            "was cut short. Rebuild or remove the demo, or leave it out with a mask."
        )
