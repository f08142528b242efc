"""Fetching robomimic's official files from the Hugging Face hub."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from warmprior.data.hdf5 import DatasetError, open_robomimic
from warmprior.envs.tasks import TASKS
from warmprior.io.extras import require
from warmprior.io.files import file_digest

__all__ = ["REPOSITORIES", "download_robomimic"]

REPOSITORIES = ("robomimic/robomimic_datasets", "amandlek/robomimic")
"""The hub's dataset repositories that hold the files, in the order of trying."""

LIMIT_SECONDS = 3600.0
"""For everything that one call fetches, whatever a server does."""


def download_robomimic(
    task: str,
    style: str = "ph",
    *,
    root: str | Path | None = None,
    endpoint: str | None = None,
    force: bool = False,
) -> Path:
    """Download an official low-dimensional file, unless it is there already.

    The file is ``v1.5/{task}/{style}/low_dim_v15.hdf5`` of the first of :data:`REPOSITORIES` that
    delivers it. Before its path is returned it is compared with the digest that the hub gives, where
    the hub can be reached, and opened; a file that fails is fetched once more.

    Args:
        task: ``lift``, ``can``, ``square``, ``transport`` or ``tool_hang``.
        style: ``"ph"`` (one proficient operator) or ``"mh"`` (six operators).
        root: the folder under which to keep the file; by default the hub client's cache.
        endpoint: address of the hub or of a server like it; by default the hub client's own.
        force: download again even if the file is there.

    Returns:
        The path of the local file.

    Raises:
        ValueError: if there is no official file of the task or style.
        OSError: if no repository delivers a readable file; names every attempt and its cause.
        ImportError: if h5py or huggingface_hub is not installed.

    Examples:
        >>> download_robomimic("square", "mh")  # doctest: +SKIP
        PosixPath('.../v1.5/square/mh/low_dim_v15.hdf5')
        >>> download_robomimic("tool_hang", "mh")
        Traceback (most recent call last):
            ...
        ValueError: tool_hang has no official 'mh' data; it has: ph
    """
    official = {name: spec.official for name, spec in TASKS.items() if spec.official}
    if task not in official:
        raise ValueError(f"no official data for task {task!r}; choose one of {', '.join(official)}")
    if style not in official[task]:
        known = ", ".join(official[task])
        raise ValueError(f"{task} has no official {style!r} data; it has: {known}")
    hub = require("huggingface_hub", "sim")
    require("h5py", "sim")
    name = f"v1.5/{task}/{style}/low_dim_v15.hdf5"
    failures: list[str] = []
    deadline = time.monotonic() + LIMIT_SECONDS
    for repository in REPOSITORIES:
        where = {
            "repo_id": repository,
            "filename": name,
            "repo_type": "dataset",
            "endpoint": endpoint,
        }

        def fetch(anew: bool, where: dict[str, Any] = where) -> Path:
            path = Path(hub.hf_hub_download(**where, local_dir=root, force_download=anew))
            _check(path, _published_digest(hub, where))
            return path

        # The client's failures share no base class: its own errors, those of the HTTP library
        # underneath, and OSError for a broken connection, a full disk or a short file.
        try:
            try:
                return _until(deadline, partial(fetch, force))
            except DatasetError:
                if force:
                    raise
                return _until(deadline, partial(fetch, True))
        except Exception as error:
            reason = str(error).strip() or "no message"
            failures.append(f"{repository}: {type(error).__name__}: {reason}")
            cause = error
    raise OSError(
        f"could not download {name}:\n- "
        + "\n- ".join(failures)
        + "\nCheck the connection; force=True replaces a broken local copy, and a file fetched by "
        "other means can be given by its path."
    ) from cause


def _check(path: Path, digest: str | None) -> None:
    if digest is not None and file_digest(path) != digest:
        raise DatasetError(
            f"{path}: its sha256 is not the {digest} that the hub publishes: it was damaged on the way "
            "or on this disk"
        )
    with open_robomimic(path):
        pass


def _published_digest(hub: Any, where: dict[str, Any]) -> str | None:
    """SHA-256 of a file at the hub; ``None`` if the hub cannot be reached or gives another kind."""
    try:
        etag = hub.get_hf_file_metadata(hub.hf_hub_url(**where), endpoint=where["endpoint"]).etag
    except Exception:  # without a connection, what is there has to do
        return None
    return etag if etag is not None and len(etag) == 64 else None


def _until(deadline: float, call: Callable[[], Path]) -> Path:
    """Call something that may never end; left behind, it ends with the process.

    Raises:
        TimeoutError: if it has not returned by the deadline.
    """
    result: list[Path] = []
    failure: list[BaseException] = []

    def run() -> None:
        try:
            result.append(call())
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=run, name="download", daemon=True)
    thread.start()
    thread.join(max(0.0, deadline - time.monotonic()))
    if failure:
        raise failure[0]
    if not result:
        raise TimeoutError(f"not complete after {LIMIT_SECONDS:.0f} s")
    return result[0]
