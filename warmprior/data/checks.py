"""All formats check their demonstrations by these functions, which raise one error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from warmprior.checks import LARGEST, check_whole_numbers
from warmprior.envs.env_args import declared_actions

LARGE = 1e5
"""The size from which on numbers count as having an offset, which takes the precision of their steps."""

MISFIT = "They do not fit these actions: correct one or the other."


class DatasetError(ValueError):
    """An invalid demonstration file; the message says where it is wrong and what to do.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.data import open_demonstrations
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "square.hdf5"
        ...     _ = path.write_bytes(b"a download that broke off")
        ...     open_demonstrations(path).steps()
        Traceback (most recent call last):
            ...
        warmprior.data.checks.DatasetError: ...square.hdf5: not a readable HDF5 file (25 bytes; ...
    """


def check_env_args(what: str, env_args: Any) -> dict[str, Any]:
    """Raise DatasetError unless there are robomimic's text ``env_name`` and dict ``env_kwargs``."""
    for key, kind in (("env_name", str), ("env_kwargs", dict)):
        if not (isinstance(env_args, dict) and isinstance(env_args.get(key), kind)):
            raise DatasetError(
                f"{what} lacks {key}, or it is not a {kind.__name__}: write it, or remove the description to "
                "train without an environment"
            )
    return env_args


def declared_poses(path: Path, env_args: Mapping[str, Any]) -> tuple[str, str] | None:
    """Call :func:`~warmprior.envs.env_args.declared_actions`; raise DatasetError if it fails."""
    with reading(f"{path}: env_args", MISFIT):
        return declared_actions(env_args)


@contextmanager
def reading(what: str, advice: str) -> Iterator[None]:
    """Turn any error inside into a DatasetError that says what cannot be read, with advice.

    A package that is not installed is no fault of the file.
    """
    try:
        yield
    except (DatasetError, ImportError, MemoryError):
        raise
    except Exception as error:  # errors of h5py, pyarrow and the like, OSError, KeyError for columns, ...
        reason = str(error) or repr(error)  # an assertion has no words
        raise DatasetError(f"{what} cannot be read ({reason}). {advice}") from error


def check_count(path: Path, demos: int | None, available: int) -> None:
    """Raise an error for no demonstrations, or for more than there are."""
    if demos is not None:
        check_whole_numbers(demos=demos)
        if demos > available:
            raise DatasetError(f"{path}: there are {available} demonstrations, fewer than demos={demos}")


def unknown_name_error(where: Any, kind: str, name: str, names: Iterable[str]) -> DatasetError:
    """Return the error for a name that is not among those of its kind."""
    return DatasetError(f"{where}: no {kind} {name!r}; there are {', '.join(names) or 'none'}")


def store_finite(block: np.ndarray, out: np.ndarray, what: str, advice: str, first: int = 0) -> None:
    """Copy numbers to ``out``; raise DatasetError if one is not finite there, or above 1e9."""
    with reading(what, advice), np.errstate(over="ignore"):  # an overflow is infinite: reported below
        out[...] = block.reshape(out.shape)
    usable = np.abs(out) <= LARGEST  # False for NaN
    if not usable.all():
        value, row = out[~usable][0], first + int(np.argmin(usable.all(-1)))
        if np.isfinite(value):
            advice = (
                f"Numbers are at most {LARGEST:g}: subtract an offset (of a time stamp the first), or choose "
                "observations without it."
            )
        raise DatasetError(f"{what} has {value:g} in row {row}. {advice}")
    check_kept(block.reshape(out.shape), out, what)


def check_kept(exact: np.ndarray, kept: np.ndarray, what: str) -> None:
    """Raise DatasetError if a column ``[N]`` of large numbers loses a tenth of its steps, in the median."""
    if exact.dtype == kept.dtype:
        return
    exact, kept = (values.reshape(len(values), -1) for values in (exact, kept))
    largest = np.abs(kept).max(0, initial=0)
    for column in np.flatnonzero(largest >= LARGE):
        before, after = (values[:, column].astype(np.float64) for values in (exact, kept))
        steps, lost = np.abs(np.diff(before)), np.abs(np.diff(after - before))
        moved = steps > 1e-12 * largest[column]  # by more than the last bits of float64
        if moved.any() and np.median(lost[moved]) > 0.1 * np.median(steps[moved]):
            raise DatasetError(
                f"{what} has numbers up to {largest[column]:g} in column {column}, where those of float32 "
                f"are {np.spacing(np.float32(largest[column])):g} apart, too coarse for steps of "
                f"{np.median(steps[moved]):g}: subtract an offset, or leave it out"
            )
