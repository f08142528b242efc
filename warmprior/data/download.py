"""Fetching robomimic's official files from the Hugging Face hub."""

from __future__ import annotations

from pathlib import Path

from warmprior._extras import require
from warmprior.data.hdf5 import open_robomimic
from warmprior.envs.tasks import TASKS

__all__ = ["REPOSITORIES", "download_robomimic"]

REPOSITORIES = ("robomimic/robomimic_datasets", "amandlek/robomimic")
"""The hub's dataset repositories that hold the files, in the order of trying."""


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
    delivers it. It is opened before its path is returned, so a file that was cut short is refused.

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
    for repository in REPOSITORIES:
        # The client's failures share no base class: its own errors, those of the HTTP library
        # underneath, and OSError for a broken connection, a full disk or a short file.
        try:
            path = Path(
                hub.hf_hub_download(
                    repository,
                    name,
                    repo_type="dataset",
                    local_dir=root,
                    endpoint=endpoint,
                    force_download=force,
                )
            )
            with open_robomimic(path):
                return path
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
