"""Writing files so that a killed process or a full disk never leaves a damaged one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import platform
import re
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    from torch import Tensor

JSON_BYTES = 2**28  # the largest results file is a hundredth of that


def save_file(tensors: dict[str, Tensor], path: Path, metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file; tensors that share memory, such as tied weights, are written once each."""
    from safetensors.torch import save

    own: dict[str, Tensor] = {}
    written: set[int] = set()
    for name, value in tensors.items():
        memory = value.untyped_storage().data_ptr()
        own[name] = value.clone() if memory in written else value.contiguous()
        written.add(memory)
    # The format's own writer leaves a temporary file if the process is killed, and hides it from other users.
    path.write_bytes(save(own, metadata))


def read_tensors(data: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and metadata of a safetensors file, from its bytes.

    The format's own reader opens a path twice, and may find another file the second time.
    """
    from safetensors.torch import load

    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return load(data), header.get("__metadata__", {})


def is_repository(name: str) -> bool:
    """Return True if a text has the form of a repository's name on the hub, ``user/name``.

    Examples:
        >>> from warmprior.io.files import is_repository
        >>> [is_repository(name) for name in ("user/name", "runs/a/b", "../name", "policy", "/tmp/name")]
        [True, False, False, False, False]
    """
    part = r"[A-Za-z0-9_]([A-Za-z0-9._-]*[A-Za-z0-9_])?"
    return bool(re.fullmatch(f"{part}/{part}", name))


def reserve(mapped: Any) -> None:
    """Reserve the space of a tensor that is mapped: writing without it would kill the process (SIGBUS)."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(mapped.filename, "r+b") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, mapped.numel() * mapped.element_size()))


def cache_folder() -> Path:
    """Return the folder of generated files: ``$WARMPRIOR_CACHE`` or ``~/.cache/warmprior``."""
    return Path(os.environ.get("WARMPRIOR_CACHE") or "~/.cache/warmprior").expanduser()


def check_regular(path: Path) -> None:
    """Raise an error where there is no file, or something else: a pipe or a device may never answer."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file; remove it, or choose another folder")


def check_regular_files(folder: Path) -> None:
    """Raise an error for anything in a folder that is neither a folder of its own nor a regular file."""
    for path in folder.rglob("*"):
        if path.is_symlink() or not path.is_dir():  # what is behind a linked folder is not seen here
            check_regular(path)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    check_regular(path)
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(*parts: Any) -> str:
    """Return the SHA-256 of values that JSON can hold."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def as_json(value: Any) -> Any:
    """Return a value as JSON reads it back: tuples become lists, and keys text."""
    return json.loads(json.dumps(value))


def read_json(path: Path) -> Any:
    """Read a JSON file; raise ValueError with its name if it is invalid."""
    check_regular(path)
    if path.stat().st_size > JSON_BYTES:
        raise ValueError(f"{path} is not valid JSON of this library: it has {path.stat().st_size} bytes")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:  # text that is not UTF-8 included
        raise ValueError(f"{path} is not valid JSON: {error}") from error


class StorageError(OSError):
    """Something cannot be stored; the cause is the system's own error."""


@contextlib.contextmanager
def storing(what: str, folder: Path, elsewhere: str = "another folder") -> Iterator[None]:
    """Let errors of the system in a folder, or above it, say what cannot be stored there and why.

    Other errors pass: those of files elsewhere, which are read meanwhile, and sentences of this library. Of
    blocks inside each other, the outer one's words are kept.

    Examples:
        >>> from pathlib import Path
        >>> from warmprior.io.files import storing
        >>> with storing("cannot keep images", Path("cache"), "another cache"):
        ...     raise PermissionError(13, "Permission denied", "cache/images")
        Traceback (most recent call last):
            ...
        warmprior.io.files.StorageError: cannot keep images ([Errno 13] ...): choose another cache
    """
    try:
        yield
    except OSError as error:
        cause = error.__cause__
        reason: Any = cause if isinstance(error, StorageError) and isinstance(cause, OSError) else error
        # A write or a reservation that fails names no file, and neither does a connection.
        full, inside = reason.errno in (errno.ENOSPC, errno.EDQUOT), not isinstance(reason, ConnectionError)
        if isinstance(reason.filename, str | Path):
            named, here = (Path(os.path.abspath(path)) for path in (reason.filename, folder))
            inside = named.is_relative_to(here) or here.is_relative_to(named)
        if reason.errno is None or not inside:
            raise
        advice = "free some space, or choose" if full else "choose"
        raise StorageError(f"{what} ({reason}): {advice} {elsewhere}") from reason


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write(temporary_path)``, then put the result in place in one step.

    A reader, or a process killed at any moment, sees the old file or the new one, never a part. The folder is
    created if needed. The system's error names ``path`` if it cannot be written; others of ``write`` pass.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.io.files import write_atomic
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "new" / "table.md"
        ...     write_atomic(path, lambda temporary: temporary.write_text("done"))
        ...     path.read_text()
        'done'
    """
    # Unique among the threads, processes and machines that may write the same file.
    owner = f"{os.getpid()}.{uuid.uuid4().hex}.{platform.node()}"
    temporary = path.with_name(f".{path.name}.{owner}.tmp")
    try:
        with storing(f"cannot write {path}", path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_stale(path)
            write(temporary)
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):  # a read-only folder never received the file
            temporary.unlink(missing_ok=True)


def _remove_stale(path: Path) -> None:
    """Remove what killed processes left of earlier attempts to write a file."""
    start, end = f".{path.name}.", ".tmp"
    for old in path.parent.iterdir():
        if not (old.name.startswith(start) and old.name.endswith(end)):
            continue
        process, _, node = old.name[len(start) : -len(end)].partition(".")
        if not process.isdecimal():
            continue  # of a file whose name begins like this one's
        # Elsewhere only age tells: no write takes a day.
        here = node.partition(".")[2] == platform.node()
        with contextlib.suppress(OSError):
            if (here and not psutil.pid_exists(int(process))) or time.time() - old.stat().st_mtime > 86_400:
                old.unlink()


def check_writable(directory: Path) -> None:
    """Create a folder and prove that files can be written there, or raise an ``OSError`` that names it."""
    with storing(f"cannot write to {directory}", directory):
        directory.mkdir(parents=True, exist_ok=True)
        # Without a name, where the system can: others may be trying the same folder.
        with tempfile.TemporaryFile(dir=directory) as probe:
            probe.write(b"ok")
            os.fsync(probe.fileno())


@contextlib.contextmanager
def exclusive(directory: Path) -> Iterator[None]:
    """Keep other processes that ask for the same out of a folder; it is created if needed.

    The lock lies on the folder itself: it leaves no file, and ends with the process however that ends.
    Where the file system has no locks there is none.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.io.files import exclusive
        >>> with TemporaryDirectory() as folder, exclusive(Path(folder)):
        ...     with exclusive(Path(folder)):  # whoever comes second
        ...         pass
        Traceback (most recent call last):
            ...
        BlockingIOError: ... is in use by another process: wait, or choose another
    """
    directory.mkdir(parents=True, exist_ok=True)
    folder = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(
                f"{directory} is in use by another process: wait, or choose another"
            ) from None
        except OSError as error:
            warnings.warn(f"{directory} cannot be locked ({error}): use it in one process", stacklevel=3)
        yield
    finally:
        os.close(folder)
