"""HDF5's heaps of strings, checked as they are read.

Strings of any length lie in heaps, one after another, each with its size in front. HDF5 walks over them from
size to size: where damage makes one zero it walks on the spot for ever, and Ctrl-C does not end it.
"""

from __future__ import annotations

import io
import os
from collections.abc import Buffer, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, override

from warmprior.data.checks import DatasetError
from warmprior.io.extras import require

if TYPE_CHECKING:
    import h5py

_HEAP = b"GCOL\x01"  # HDF5 refuses other versions
_ALIGNED = 8  # bytes


class _HeapsChecked(io.FileIO):
    """A file that HDF5 reads through Python, and that raises DatasetError for a damaged heap.

    It keeps its position itself, since the system's is shared with forked processes.
    """

    size_bytes = 8
    """The width of sizes in the file."""
    place = 0

    @override
    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        self.place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self.place}.get(
            whence, os.fstat(self.fileno()).st_size
        )
        return self.place

    @override
    def tell(self) -> int:
        return self.place

    @override
    def readinto(self, buffer: Buffer, /) -> int:
        content, count = memoryview(buffer), 0
        while count < len(content):
            new = os.preadv(self.fileno(), [content[count:]], self.place + count)
            if not new:  # h5py would take the rest of the buffer as it is
                raise OSError("it ends early")
            count += new
        if bytes(content[: len(_HEAP)]) == _HEAP:
            self._check_heap(self.place)
        return count

    def _check_heap(self, start: int) -> None:
        length = -(-(8 + self.size_bytes) // _ALIGNED) * _ALIGNED  # of the header of a heap or string
        end, place = start + self._header(start, length)[1], start + length
        while end - place >= length:  # a shorter rest is free
            number, size = self._header(place, length)
            # The free part, number 0, counts its own header.
            step = length + -(-size // _ALIGNED) * _ALIGNED if number else size
            if not length <= step <= end - place:
                raise DatasetError(
                    f"{self.name}: its heap of strings at byte {start} is damaged. Copy or download it again."
                )
            place += step

    def _header(self, place: int, length: int) -> tuple[int, int]:
        """Return the number and the size in a header; bytes behind the end of the file count as 0."""
        header = os.pread(self.fileno(), length, place)
        return int.from_bytes(header[:2], "little"), int.from_bytes(header[8 : 8 + self.size_bytes], "little")


@contextmanager
def open_checked(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading, so that a damaged heap of strings ends in a DatasetError."""
    h5py = require("h5py", "sim")
    with _HeapsChecked(path) as checked, h5py.File(path, "r", driver="fileobj", fileobj=checked) as file:
        checked.size_bytes = file.id.get_create_plist().get_sizes()[1]
        yield file
