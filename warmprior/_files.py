"""Writing files so that a killed process or a full disk never leaves a damaged one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

__all__ = ["check_writable", "load_file", "save_file", "write_atomic"]


def save_file(
    tensors: dict[str, Tensor], path: Path, metadata: dict[str, str] | None = None
) -> None:
    """Write a safetensors file. (Imported here: ``import warmprior`` does not need the package.)

    Raises:
        OSError: if the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file as save

    try:
        save(tensors, path, metadata)
    except SafetensorError as error:
        raise OSError(str(error)) from error


def load_file(path: Path) -> dict[str, Any]:
    """Read the tensors of a safetensors file."""
    from safetensors.torch import load_file as load

    return load(path)


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write(temporary_path)``, then put the result in place in one step.

    A reader, or a process killed at any moment, sees the old file or the new one, never a part.

    Args:
        path: the file to replace; its folder is created if needed.
        write: callable that writes a file at the path it is given.

    Raises:
        OSError: if the file cannot be written, naming ``path``.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(
            f"cannot write {path}: {error}. Free some space or choose another output folder."
        ) from error
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    # A read-only folder never received the file.
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def check_writable(directory: Path) -> None:
    """Create a folder and prove that files can be written there.

    Raises:
        OSError: if not, naming the folder.
    """
    probe = directory / ".write-test"
    write_atomic(probe, lambda temporary: temporary.write_text("ok"))
    probe.unlink()
