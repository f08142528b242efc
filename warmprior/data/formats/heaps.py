"""HDF5's heaps of strings, checked as they are read.

Strings of any length lie in heaps, one after another, each with its size in front. HDF5 walks over them from
size to size: where damage makes one zero it walks on the spot for ever, and Ctrl-C does not end it.
"""

from __future__ import annotations

import io
from collections.abc import Buffer
from pathlib import Path
from typing import TYPE_CHECKING, override

from warmprior.data.index import DatasetError
from warmprior.io.extras import require

if TYPE_CHECKING:
    import h5py

_HEAP = b"GCOL\x01"  # HDF5 refuses other versions
_ALIGNED = 8  # bytes


class _HeapsChecked(io.BufferedReader):
    """A file that HDF5 reads through Python, and that raises DatasetError for a damaged heap."""

    size_bytes = 8
    """The width of sizes in the file."""

    @override
    def readinto(self, buffer: Buffer, /) -> int:
        start, content = self.tell(), memoryview(buffer)
        count = super().readinto(buffer)
        if count < len(content):  # h5py would take the rest of the buffer as it is
            raise OSError("it ends early")
        if bytes(content[: len(_HEAP)]) == _HEAP:
            self._check_heap(start)
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
        """Return the number and the size in a header."""
        self.seek(place)
        header = self.read(length)
        if len(header) < length:
            raise OSError("it ends early")
        return int.from_bytes(header[:2], "little"), int.from_bytes(header[8 : 8 + self.size_bytes], "little")


def open_checked(path: Path) -> h5py.File:
    """Open an HDF5 file for reading, so that a damaged heap of strings ends in a DatasetError."""
    checked = _HeapsChecked(io.FileIO(path))
    file = require("h5py", "sim").File(path, "r", driver="fileobj", fileobj=checked)
    checked.size_bytes = file.id.get_create_plist().get_sizes()[1]
    return file
